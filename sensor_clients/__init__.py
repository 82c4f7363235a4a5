"""Clients of the fusion centre: the publishing kit, local trackers, simulated and recorded sensors."""
