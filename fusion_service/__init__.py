"""The fusion service: association, fusion rules, the centre, its daemon, recorder and commands."""
