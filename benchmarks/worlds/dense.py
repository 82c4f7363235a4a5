"""Worlds where targets are near each other: formations, crossings, parallel lanes, splits and joins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.worlds.world import Path, Scan, Sensor, World, grid, observe, scan_times, straight, world

__all__ = ["crossing", "formation", "joins", "lanes", "splits"]

Floats = NDArray[np.float64]

PAIR = 2000.0
"""Between groups that have nothing to do with each other, m."""


def formation(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """Targets in line abreast at 15 m/s, gap as said; "rough": sensors so rough that the local sigma stays at 4.7 m."""
    gap = float(variant.split()[1])
    sigma, q = (10.0, 0.5) if "rough" in variant else (4.7, 0.3)
    count, seconds = (30, 15.0) if quick else (120, 60.0)
    places = np.stack([gap * np.arange(count), np.zeros(count)], axis=1)
    path = straight(places, np.tile([0.0, 15.0], (count, 1)))
    sensors = [Sensor(name, sigma, q) for name in ("a", "b")]
    feeds = [(sensor, observe(sensor, path, seconds, rng)) for sensor in sensors]
    return world("formation", variant, path, seconds, feeds, 3 * sigma, fresh=True)


def crossing(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """Twenty pairs, 2 km from each other, whose paths cross at mid-time at the angle said; 15 m/s."""
    half = np.radians(float(variant.split()[0])) / 2
    pairs, seconds = (5, 20.0) if quick else (20, 60.0)
    centres = np.repeat(grid(pairs, PAIR), 2, axis=0)
    side = np.tile([1.0, -1.0], pairs)
    velocities = 15.0 * np.stack([np.full(2 * pairs, np.cos(half)), side * np.sin(half)], axis=1)
    path = straight(centres - velocities * seconds / 2, velocities)
    sensors = [Sensor("a", 10.0, 0.5), Sensor("b", 10.0, 0.5, phase=0.3)]
    feeds = [(sensor, observe(sensor, path, seconds, rng)) for sensor in sensors]
    return world("crossing", variant, path, seconds, feeds, 40.0)


def lanes(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """Lanes side by side, the gap as said, ten targets each that overtake those beside them at 1 to 3 m/s."""
    gap = float(variant.split()[0])
    lane, seconds = np.repeat(np.arange(3), 3 if quick else 10), 20.0 if quick else 90.0
    along = np.tile(60.0 * np.arange(len(lane) // 3), 3) + rng.uniform(-15, 15, len(lane))
    places = np.stack([along, gap * lane], axis=1)
    speed = 15.0 + 2.0 * lane + rng.uniform(-0.3, 0.3, len(lane))
    path = straight(places, np.stack([speed, np.zeros(len(lane))], axis=1))
    sensors = [Sensor("a", 6.0, 0.1), Sensor("b", 6.0, 0.1, phase=0.3)]
    feeds = [(sensor, observe(sensor, path, seconds, rng)) for sensor in sensors]
    return world("lanes", variant, path, seconds, feeds, 20.0)


def splits(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """Source b has two tracks of every target for 20 s, the second at another end of it, 12 m from the first."""
    count, seconds = (4, 20.0) if quick else (20, 90.0)
    courses = rng.uniform(0, 2 * np.pi, count)
    path = straight(grid(count, PAIR), 8.0 * np.stack([np.cos(courses), np.sin(courses)], axis=1))
    a, b = Sensor("a", 6.0, 0.5), Sensor("b", 6.0, 0.5, phase=0.3)
    times = scan_times(b, seconds)
    begin = 8.0 if quick else 30.0 + rng.uniform(0, 20, count)
    double = (times[:, None] >= begin) & (times[:, None] < begin + (6.0 if quick else 20.0))
    aft = path(times)[..., :2] - 12.0 * np.stack([np.cos(courses), np.sin(courses)], axis=1)
    second = np.where(double[..., None], aft, np.nan)
    feeds = [
        (a, observe(a, path, seconds, rng)),
        (b, observe(b, path, seconds, rng, also=(second, np.arange(count)))),
    ]
    return world("splits", variant, path, seconds, feeds, 40.0)


def joins(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """Pairs that come together to 5 m, stay so and part again; "unresolved": source b has one track of each pair
    meanwhile, between the two, and gives a new id to the second when they part."""
    pairs, seconds = (3, 30.0) if quick else (15, 90.0)
    path = _meeting(grid(pairs, PAIR), seconds)
    a, b = Sensor("a", 6.0, 0.5), Sensor("b", 6.0, 0.5, phase=0.3)
    if variant != "unresolved":
        feeds = [(sensor, observe(sensor, path, seconds, rng)) for sensor in (a, b)]
        return world("joins", variant, path, seconds, feeds, 30.0)

    def two(times: Floats, states: Floats) -> NDArray[np.bool_]:
        apart = np.linalg.norm(states[:, 0::2, :2] - states[:, 1::2, :2], axis=2) > 20.0
        return np.stack([np.ones_like(apart), apart], axis=2).reshape(len(times), -1)

    def blurred(times: Floats) -> Floats:
        states = path(times)
        pair = states.reshape(len(times), -1, 2, 4)
        middle = np.repeat(pair.mean(axis=2), 2, axis=1)
        one = two(times, states)[:, 1::2]
        return np.where(np.repeat(one, 2, axis=1)[..., None], states, middle)

    scans = [_last_gone(scan) for scan in observe(b, blurred, seconds, rng, seen=lambda t, _: two(t, path(t)))]
    feeds = [(a, observe(a, path, seconds, rng)), (b, scans)]
    return world("joins", variant, path, seconds, feeds, 30.0)


def _meeting(centres: Floats, seconds: float) -> Path:
    """Two targets about each of `centres` at 10 m/s along x: 100 m apart across, 5 m in the middle third, 100 m."""

    def path(times: Floats) -> Floats:
        third = seconds / 3
        outside = np.clip(np.abs(times - seconds / 2) - third / 2, 0.0, None) / third
        turn = np.pi * outside
        offset = 2.5 + 47.5 * (1 - np.cos(turn)) / 2
        rate = 47.5 * np.sin(turn) / 2 * np.pi / third * np.sign(times - seconds / 2)
        along = np.broadcast_to(10.0 * (times - seconds / 2), (2, len(times)))
        side = np.array([1.0, -1.0])[:, None]
        one = np.stack([along, side * offset, np.full_like(along, 10.0), side * rate], axis=2).swapaxes(0, 1)
        shift = np.pad(centres, ((0, 0), (0, 2)))
        return (one[:, None] + shift[None, :, None]).reshape(len(times), -1, 4)

    return path


def _last_gone(scan: Scan) -> Scan:
    """Without the tracks that have no measurement in this scan: what is not resolved is not coasted."""
    kept = scan.updated == scan.time
    columns = ("id", "target", "mean", "covariance", "updated")
    return replace(scan, **{name: getattr(scan, name)[kept] for name in columns})
