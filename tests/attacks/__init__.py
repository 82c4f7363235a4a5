"""Attacks on the bus, each against an open hub, where it works, and a secured one, where it must not:
`python -m tests.attacks`."""
