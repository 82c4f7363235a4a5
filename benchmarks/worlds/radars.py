"""The three radars of `sensor_clients` (Sharma 6.4) as a world; what their tracks are tracks of, nobody says."""

from __future__ import annotations

import numpy as np

from benchmarks.worlds.world import Told, World
from schemas import Motion
from sensor_clients.scenarios import three_radars as scenario
from studies.missions import told, truths

__all__ = ["three_radars"]

SECOND = 10**9
CUTOFF = 5000.0
"""As in the study of the three radars, m."""


def three_radars(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """Twenty targets seen by radars hundreds of km away in heavy clutter for 300 s, a report of each every 10 s; the
    picture is in radar 1's frame and its state space."""
    said = told(scenario.three_radars(variant), int(rng.integers(2**31)))
    latency = SECOND // 10
    by_time = {truth.time: truth for truth in truths(scenario.three_radars(variant))}
    times = np.array([scenario.START + 10 * k * SECOND for k in range(1, 31)], dtype=np.int64)
    truth = np.stack([by_time[int(time)].means[:, :2] for time in times])
    everything = tuple(Told(message.sent + latency, message) for message in said)
    config = {"frame": scenario.RADARS["radar1"], "period": 10.0, "coast": 25.0, "motion": Motion("cv", 10.0)}
    return World("three radars", variant, times, truth, everything, CUTOFF, config)
