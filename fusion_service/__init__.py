"""The fusion service: association, fusion rules, the centre, its daemon, recorder and commands."""

__version__ = "0.8.0"
