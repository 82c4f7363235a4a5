"""Simulated worlds: truth, sensors, clutter, and the local tracker of each sensor."""
