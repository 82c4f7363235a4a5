"""Worlds of sources that go wrong: ids used again or swapped, outlier scans, late messages, registration bias."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.worlds.world import FALSE, Path, Scan, Sensor, World, grid, observe, straight, world

__all__ = ["bias", "ids_again", "latencies", "outliers"]

Floats = NDArray[np.float64]


def cruising(rng: np.random.Generator, count: int, gap: float = 2000.0, speed: float = 10.0) -> Path:
    """Targets `gap` m apart at constant velocities, the speed as said, any course."""
    courses = rng.uniform(0, 2 * np.pi, count)
    return straight(grid(count, gap), speed * np.stack([np.cos(courses), np.sin(courses)], axis=1))


def ids_again(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """ "one source": the only source gives the ids of five of its ten targets to things 50 km away, and loses those
    targets. "a swaps", "b swaps": one of two sources, a and b, swaps the ids of five pairs of targets 500 m apart."""
    at, seconds = (8.0, 20.0) if quick else (40.0, 90.0)
    a, b = Sensor("a", 10.0, 0.5), Sensor("b", 10.0, 0.5, phase=0.3)
    if variant != "one source":
        path = cruising(rng, 10, gap=500.0, speed=3.0)
        begin = {"a": seconds, "b": seconds, variant[0]: at}
        feeds = [(one, [_swapped(s, begin[one.name]) for s in observe(one, path, seconds, rng)]) for one in (a, b)]
        return world("id re-use", variant, path, seconds, feeds, 60.0)
    return _far_away(a, at, seconds, rng)


def _far_away(a: Sensor, at: float, seconds: float, rng: np.random.Generator) -> World:
    near, shift = cruising(rng, 10), np.array([50_000.0, 0.0, 0.0, 0.0])

    def path(times: Floats) -> Floats:
        far = np.where(times[:, None, None] >= at, near(times)[:, :5] + shift, np.nan)
        return np.concatenate([near(times), far], axis=1)

    def seen(times: Floats, states: Floats) -> NDArray[np.bool_]:
        lost = (times[:, None] >= at) & (np.arange(states.shape[1]) < 5)
        return np.isfinite(states[..., 0]) & ~lost

    scans = _again(observe(replace(a, drop=1), path, seconds, rng, seen=seen))
    return world("id re-use", "one source", path, seconds, [(a, scans)], 60.0)


def _swapped(scan: Scan, at: float) -> Scan:
    """After `at` the targets 0 and 1, 2 and 3, ... go under each other's ids."""
    if scan.time <= at:
        return scan
    other = {int(target): int(one) for target, one in zip(scan.target, scan.id, strict=True)}
    ids = np.array([other[int(target) ^ 1] for target in scan.target], dtype=np.uint64)
    return _sorted(replace(scan, id=ids))


def _again(scans: Sequence[Scan]) -> list[Scan]:
    """The targets from 10 on go under the ids that the targets 0 to 4 had."""
    first = {int(target): int(one) for target, one in zip(scans[0].target, scans[0].id, strict=True)}
    out = []
    for scan in scans:
        ids = [first[int(t) - 10] if t >= 10 else int(one) for t, one in zip(scan.target, scan.id, strict=True)]
        out.append(_sorted(replace(scan, id=np.array(ids, dtype=np.uint64))))
    return out


def _sorted(scan: Scan) -> Scan:
    order = np.argsort(scan.id, kind="stable")
    columns = ("id", "target", "mean", "covariance", "updated")
    return replace(scan, **{name: getattr(scan, name)[order] for name in columns})


def outliers(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """One scan far off, once established: all tracks of source a by 300 m (a reports every 10 s), or by 10 km (1
    Hz)."""
    slow = "slow" in variant
    count, seconds = (4, 30.0) if quick else (20, 120.0)
    a = Sensor("a", 10.0, 0.5, period=10.0 if slow and not quick else 1.0)
    b = Sensor("b", 10.0, 0.5, phase=0.3)
    path = cruising(rng, count, gap=30_000.0)
    shift = np.array([300.0 if slow else 10_000.0, 0.0, 0.0, 0.0])
    off = seconds / 2 if quick else 60.0
    scans = [
        replace(scan, mean=scan.mean + shift, target=np.full_like(scan.target, FALSE)) if scan.time == off else scan
        for scan in observe(a, path, seconds, rng)
    ]
    return world("outliers", variant, path, seconds, [(a, scans), (b, observe(b, path, seconds, rng))], 60.0)


def latencies(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """Late sources under a lateness of 5 s: 10 Hz and .9 s late, alone or beside a prompt one; 1 Hz and 4 s late."""
    count, seconds = (3, 15.0) if quick else (15, 60.0)
    path = cruising(rng, count)
    late = Sensor("late", 10.0, 0.5, period=0.1, latency=0.9)
    sensors = {
        "10 Hz, .9 s late": [late],
        "10 Hz, .9 s late; 1 Hz": [late, Sensor("prompt", 10.0, 0.5)],
        "1 Hz, 4 s late; 1 Hz": [Sensor("late", 10.0, 0.5, latency=4.0), Sensor("prompt", 10.0, 0.5, phase=0.3)],
    }[variant]
    feeds = [(sensor, observe(sensor, path, seconds, rng)) for sensor in sensors]
    return world("latencies", variant, path, seconds, feeds, 60.0)


def bias(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """25 targets, two sources of local sigma 6 m, the second displaced by a constant, as said, for 600 s."""
    count, seconds = (5, 60.0) if quick else (25, 600.0)
    path = cruising(rng, count, gap=3000.0, speed=5.0)
    a = Sensor("a", 12.0, 0.5)
    b = replace(a, name="b", phase=0.5, bias=(float(variant.split()[0]), 0.0))
    feeds = [(sensor, observe(sensor, path, seconds, rng)) for sensor in (a, b)]
    return world("bias", variant, path, seconds, feeds, 100.0)
