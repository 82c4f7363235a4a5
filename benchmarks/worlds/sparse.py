"""Worlds of what is not seen, or seen where nothing is: clutter, detection, partial coverage, mixed rates."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarks.worlds.faulty import cruising
from benchmarks.worlds.world import FALSE, Sensor, World, flickers, observe, scan_times, straight, world

__all__ = ["clutter", "detection", "overlap", "rates"]

Floats = NDArray[np.float64]

AREA = 10_000.0
"""Side of the square of clutter, m."""


def clutter(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """So many false local tracks in each scan of each of two sources, in 10 km x 10 km, each there for two scans on the
    average and dropped after two misses; 20 targets, detected with .9."""
    number = float(variant.split()[0])
    count, seconds = (5, 20.0) if quick else (20, 60.0)
    path = cruising(rng, count)
    feeds = []
    for sensor in (
        Sensor("a", 15.0, 0.5, detection=0.9, drop=2, range=20_000.0),
        Sensor("b", 15.0, 0.5, phase=0.5, detection=0.9, drop=2, range=20_000.0),
    ):
        false = flickers(rng, len(scan_times(sensor, seconds)), number, AREA, 2.0, sensor.drop)
        also = (false, np.full(false.shape[1], FALSE))
        feeds.append((sensor, observe(sensor, path, seconds, rng, also=also)))
    return world("clutter", variant, path, seconds, feeds, 60.0)


def detection(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """20 targets detected with the probability said by two sources that drop a track after two misses, and begin a new
    one, under a new id, with the next detection."""
    share = float(variant.split()[1])
    count, seconds = (5, 20.0) if quick else (20, 120.0)
    path = cruising(rng, count)
    feeds = []
    for name, phase in (("a", 0.0), ("b", 0.5)):
        sensor = Sensor(name, 10.0, 0.5, phase=phase, detection=share, drop=2, range=20_000.0)
        feeds.append((sensor, observe(sensor, path, seconds, rng)))
    return world("detection", variant, path, seconds, feeds, 60.0)


def overlap(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """Targets that go from where only source a sees to where both see, to where only b sees; at 40 m/s."""
    count, seconds = (4, 30.0) if quick else (20, 120.0)
    half = seconds * 40.0 / 6
    starts = np.stack([rng.uniform(-3.5, -2.0, count) * half, 300.0 * np.arange(count)], axis=1)
    path = straight(starts, np.tile([40.0, 0.0], (count, 1)))
    reach = 20_000.0
    a = Sensor("a", 10.0, 0.5, range=reach, place=(half - reach, 0.0), drop=2)
    b = Sensor("b", 10.0, 0.5, phase=0.5, range=reach, place=(reach - half, 0.0), drop=2)

    feeds = [(sensor, observe(sensor, path, seconds, rng, seen=partial(_within, sensor))) for sensor in (a, b)]
    return world("overlap", variant, path, seconds, feeds, 60.0)


def _within(sensor: Sensor, times: Floats, states: Floats) -> NDArray[np.bool_]:
    """Which of the states (K, T, 4) are in the declared coverage."""
    there: NDArray[np.bool_] = np.linalg.norm(states[..., :2] - np.array(sensor.place), axis=2) <= (sensor.range or 0.0)
    return there


def rates(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """15 targets seen at the rates said, Hz, each source with its own; "unsaid": without a SensorInfo."""
    count, seconds = (3, 40.0) if quick else (15, 180.0)
    path = cruising(rng, count)
    feeds = []
    for k, word in enumerate(variant.removesuffix(" unsaid").removesuffix(" Hz").split(", ")):
        period, informs = 1 / float(word), not variant.endswith("unsaid")
        sensor = Sensor("abc"[k], 10.0, 0.1, period, min(0.2 * k + 0.1, period), informs=informs)
        feeds.append((sensor, observe(sensor, path, seconds, rng)))
    return world("rates", variant, path, seconds, feeds, 60.0)
