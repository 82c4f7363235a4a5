"""What it takes to follow vessels from a ship in a harbour, whatever its sensor gives: clutter that is learned,
detection by range, one scan after the other; and where the numbers of a sensor come from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Protocol

import numpy as np

from sensor_clients.events import Parameter
from sensor_clients.filters import LocalTracker, MeasurementModel, TrackerConfig
from sensor_clients.filters.measurement import Floats
from sensor_clients.playback.shadow import Shade, cast

__all__ = ["SECOND", "TUNED", "ClutterMap", "follow", "parameters"]

SECOND = 10**9

TUNED = "tuned on scenarios 2, 3, 5, 13, 16"


class Sensor(Protocol):
    """latency, s: how long ago a return with this time stamp was true; detection: range, m, and probability that a
    vessel is seen, linear between; births: intensity of vessels seen for the first time."""

    @property
    def latency(self) -> float: ...
    @property
    def detection(self) -> tuple[tuple[float, float], ...]: ...
    @property
    def births(self) -> float: ...


class ClutterMap:
    """Intensity of false returns, learned from those that no reported track claims, what lies still among them:
    a gamma prior of `prior` (1/m2 and scan) worth `scans` scans, and a Gaussian kernel of `sigma` m about every
    return since. `angles`: the returns are bearings, (1, M) rad, and so are the units."""

    def __init__(self, prior: float, sigma: float, scans: float, angles: bool = False) -> None:
        self._prior, self._sigma, self._scans, self._angles = prior, sigma, scans, angles
        self._places: Floats = np.zeros((1 if angles else 2, 0))
        self._weights: Floats = np.zeros(0)
        self._learned = 0

    def intensity(self, places: Floats) -> Floats:
        """Intensity (M,) at places (2, M)."""
        away = places[:, :, None] - self._places[:, None]
        if self._angles:
            away = (away + np.pi) % (2 * np.pi) - np.pi
        squared = np.sum(away**2, axis=0)
        kernel = np.exp(-0.5 * squared / self._sigma**2) / (2 * np.pi * self._sigma**2) ** (len(places) / 2)
        return np.asarray((self._prior * self._scans + kernel @ self._weights) / (self._scans + self._learned))

    def learn(self, returns: Floats, unused: Floats) -> None:
        """One scan's returns (2, M) with the probability (M,) of each that it is of no reported track."""
        self._places = np.concatenate([self._places, returns], axis=1)
        self._weights = np.concatenate([self._weights, unused])
        self._learned += 1


def follow(
    tracker: LocalTracker,
    clutter_map: ClutterMap,
    sensor: Sensor,
    time: int,
    own: Floats,
    returns: Floats,
    model: MeasurementModel,
    *,
    beyond: float | None = None,
    shade: Shade | None = None,
) -> None:
    """One scan stamped `time`, ns, of a ship at `own` (2,), m: returns (d, M) as `model` takes them. beyond: the
    probability of detection farther than `sensor.detection` tells (None: its last); shade: what the vessels that the
    tracker reports hide of one another (None: nothing)."""
    ranges, probabilities = np.array(sensor.detection).T
    true = time - round(sensor.latency * SECOND)
    shadows = None
    if shade is not None:
        tracker.predict(true)
        chosen = tracker.reported()
        shadows = cast(own, tracker.means[:, chosen], tracker.covariances[..., chosen], shade)

    def detection(place: Floats) -> Floats:
        p = np.asarray(np.interp(np.hypot(*(place - own[:, None])), ranges, probabilities, right=beyond))
        return p if shade is None or shadows is None else np.where(shadows.over(place), p * shade.seen, p)

    clutter = clutter_map.intensity(returns)
    births = np.full(len(clutter), sensor.births)
    hidden = None if shadows is None else shadows.unproven
    unused = tracker.step(true, returns, model, clutter, births, detection, hidden)
    clutter_map.learn(returns, unused)


def parameters(sensor: Any, config: TrackerConfig, sources: Mapping[str, str]) -> list[Parameter]:
    """One row per number of the sensor and of its tracker's `config`, each with its source, or else `TUNED`."""
    rows = [
        Parameter(f"{sensor.name} {field.name}", str(getattr(sensor, field.name)), sources.get(field.name, TUNED))
        for field in fields(sensor)
        if field.name not in ("name", "sensor_id", "tracker")
    ]
    rows.append(Parameter(f"{sensor.name} tracker motion", f"{config.motion.kind}, q = {config.motion.q:g}", TUNED))
    names = [field.name for field in fields(config) if field.name not in ("motion", "cubature")]
    return rows + [
        Parameter(f"{sensor.name} tracker {name}", str(getattr(config, name)), sources.get(f"tracker {name}", TUNED))
        for name in names
    ]
