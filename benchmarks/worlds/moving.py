"""Worlds of manoeuvres: aircraft that turn at 3 to 5 g, a boat that turns 30 degrees a second, at 1 Hz."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.worlds.world import Path, Sensor, World, grid, observe, world

__all__ = ["manoeuvres"]

Floats = NDArray[np.float64]

G = 9.81
KINDS = {
    "aircraft 3 g": (250.0, 3 * G / 250.0, 30.0, 900.0),
    "aircraft 5 g": (250.0, 5 * G / 250.0, 30.0, 2400.0),
    "aircraft 5 g, small q": (250.0, 5 * G / 250.0, 30.0, 50.0),
    "boat 30 deg/s": (10.0, np.radians(30.0), 5.0, 27.0),
    "boat 30 deg/s, small q": (10.0, np.radians(30.0), 5.0, 1.0),
}
"""Speed, m/s, turn rate, rad/s, sigma of a measured position, m, and q, m2/s3: about a2 times the period, or far
less."""


def manoeuvres(variant: str, rng: np.random.Generator, quick: bool) -> World:
    """Ten targets that fly straight and turn by turns: left and right by 180 degrees, at their own times."""
    speed, rate, sigma, q = KINDS[variant]
    count, seconds = (3, 25.0) if quick else (10, 90.0)
    path = _turning(grid(count, 20_000.0), rng, speed, rate, seconds)
    sensors = [Sensor("a", sigma, q, speed=speed), Sensor("b", sigma, q, phase=0.5, speed=speed)]
    feeds = [(sensor, observe(sensor, path, seconds, rng)) for sensor in sensors]
    return world("manoeuvres", variant, path, seconds, feeds, 20 * sigma)


def _turning(places: Floats, rng: np.random.Generator, speed: float, rate: float, seconds: float) -> Path:
    """Targets from `places` (T, 2): straight for 10 to 20 s, then a half turn, and so on. On a fine grid of time, and
    linear in it."""
    fine = np.arange(0.0, seconds + 1.0, 0.01)
    course = np.zeros((len(fine), len(places)))
    for target in range(len(places)):
        time, side, turn = rng.uniform(8, 15), 1.0, np.pi / rate
        heading = np.full(len(fine), rng.uniform(0, 2 * np.pi))
        while time < seconds:
            heading += side * rate * np.clip(fine - time, 0.0, turn)
            time, side = time + turn + rng.uniform(10, 20), -side
        course[:, target] = heading
    velocity = speed * np.stack([np.cos(course), np.sin(course)], axis=2)
    moved = places + np.concatenate([np.zeros((1, len(places), 2)), np.cumsum(velocity[:-1], axis=0) * 0.01])
    states = np.concatenate([moved, velocity], axis=2)

    def path(times: Floats) -> Floats:
        index = np.clip(np.round(times / 0.01).astype(int), 0, len(fine) - 1)
        at: Floats = states[index]
        return at

    return path
