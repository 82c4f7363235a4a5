"""The service as a process: bus, centre, clock, signals, health, and what survives it."""
