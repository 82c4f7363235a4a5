"""A local multi-target tracker: Bernoulli tracks with nearly constant velocity, JIPDA, adaptive starts.

One scan at a time: predict, associate all returns with all tracks at once (`association`), update, start a
track from what the tracks leave unexplained, drop what is improbable. It is IPDA (Musicki, Evans and
Stankovic 1994) with joint association, and the marginal Poisson multi-Bernoulli filter (Williams 2015)
with births where returns fall: a return that no track claims starts one with existence
unused * birth / (birth + clutter), both intensities per unit of measurement space and scan.

A track is reported once its existence has passed `confirm` (and, if so configured, once it has moved), until
it falls below `drop`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg, motion
from schemas import Motion
from sensor_clients.filters.association import Association, associate, gate_probability, likelihood, update
from sensor_clients.filters.measurement import STATE, Floats, MeasurementModel, predict_measurement

__all__ = ["LocalTracker", "Report", "TrackerConfig"]

MOVING = 0.5
"""Speed, m/s, below which a track has no course."""


@dataclass(frozen=True, slots=True)
class TrackerConfig:
    """motion of the targets; survival: probability that a target lives on for one second; sigma_speed:
    standard deviation per axis of a new track's velocity, m/s; gate: squared Mahalanobis distance;
    confirm, drop: existence at which a track is first reported and at which it ends, for a tentative track
    `drop_tentative`; max_sigma: a track whose position is less certain than this (m, along the worst of
    its axes) ends; merge: squared distance of two tracks, under the sum of their covariances and `extent`^2 (m2)
    on each axis of the place, below which the younger ends: returns of one large target; hull: length and beam, m, of
    the largest: half of them as standard deviations along and across the elder's course, in the place of `extent`, so
    that a `merge` of 4 means no farther apart than the hull (one that lies still: a circle of that area); min_way,
    min_speed: a track is reported once it has been so far, m, from where it started, beyond two standard deviations,
    and as long as that makes this speed over its age, m/s (0: at once); cubature: CKF, else EKF."""

    motion: Motion
    survival: float
    sigma_speed: float
    gate: float = 16.0
    confirm: float = 0.95
    drop: float = 0.3
    drop_tentative: float = 0.01
    max_sigma: float = math.inf
    merge: float = 0.0
    extent: float = 0.0
    hull: tuple[float, float] | None = None
    min_way: float = 0.0
    min_speed: float = 0.0
    cubature: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """Confirmed tracks at one time: ids (T,) u64, means (C, 4), covariances (C, 4, 4), existence (T,),
    updated (T,) i64 time of the last scan in which the track probably was seen, ns. C = T, but for mixtures,
    which have counts (T,) u16 components each with weights (C,)."""

    time: int
    ids: NDArray[np.uint64]
    means: Floats
    covariances: Floats
    existence: Floats
    updated: NDArray[np.int64]
    counts: NDArray[np.uint16] | None = None
    weights: Floats | None = None

    def fields(self) -> dict[str, Any]:
        """What `TrackPublisher.tracks` takes of it."""
        names = ("ids", "means", "covariances", "existence", "updated", "counts", "weights")
        return {"space": STATE, "complete": True} | {
            name: value for name in names if (value := getattr(self, name)) is not None
        }


class LocalTracker:
    """Tracks of one sensor. Not for several threads.

    Columns, one entry per track, in the order of their age: ids (T,) i64, never used twice; means (4, T),
    covariances (4, 4, T), existence (T,); first (2, T): where it started; farthest (T,): how far from there
    it has been, m, less two standard deviations; born, updated (T,) i64 ns; confirmed (T,).
    """

    columns: ClassVar[tuple[str, ...]] = (
        *("ids", "means", "covariances", "existence"),
        *("first", "farthest", "born", "updated", "confirmed"),
    )

    def __init__(self, config: TrackerConfig) -> None:
        self.config = config
        self.time: int | None = None
        self.ids: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self.means: Floats = np.zeros((4, 0))
        self.covariances: Floats = np.zeros((4, 4, 0))
        self.existence: Floats = np.zeros(0)
        self.first: Floats = np.zeros((2, 0))
        self.farthest: Floats = np.zeros(0)
        self.born: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self.updated: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self.confirmed: NDArray[np.bool_] = np.zeros(0, dtype=np.bool_)
        self._next = 1

    def predict(self, time: int) -> None:
        """Move all tracks on to `time`, ns. ValueError if that is back in time."""
        dt = 0.0 if self.time is None else (time - self.time) * 1e-9
        self._move(dt)
        self.existence = self.existence * self.config.survival**dt
        self.time = time

    def step(
        self,
        time: int,
        returns: Floats,
        model: MeasurementModel,
        clutter: Floats,
        birth: Floats,
        detection: Callable[[Floats], Floats],
        hidden: Callable[[Floats], NDArray[np.bool_]] | None = None,
    ) -> Floats:
        """One scan at `time`, ns: returns (2, M), with the intensities of clutter and of first returns of new
        targets at each (M,), per unit of measurement space; `detection` gives the probability (T,) that a
        target at a place (2, T) is seen: 0 outside the field of view, where tracks end; `hidden`, which places
        (2, T) are such that what is seen there proves nothing new: what is not reported begins anew there.

        Returns the probability (M,) that each return is of no reported track."""
        config = self.config
        self.predict(time)
        found = self._correct(returns, model, clutter + birth, detection)
        self.existence = found.existence
        claimed = np.where(self.reported(), found.existence, 0.0) @ found.weights
        self.updated = np.where(found.missed < 0.5, time, self.updated)
        self._prune()
        self._start(returns, model, found.unused * birth / (clutter + birth))
        if hidden is not None:
            self._begin_anew(hidden(self.means[:2]) & ~self.reported(), time)
        self.farthest = np.maximum(self.farthest, self._way(model))
        self.confirmed = self.confirmed | (self.existence >= config.confirm)
        return np.asarray(1.0 - claimed)

    def reported(self) -> NDArray[np.bool_]:
        """Which tracks (T,) are confirmed and on the move."""
        age = ((self.time or 0) - self.born) * 1e-9
        way = np.maximum(self.config.min_way, self.config.min_speed * age)
        return np.asarray(self.confirmed & (self.farthest >= way))

    def report(self, time: int | None = None) -> Report:
        """The tracks to report, at the time of the last step, or predicted on to `time`, ns."""
        chosen = self.reported()
        means, covariances = self.means[:, chosen], self.covariances[..., chosen]
        now = self.time or 0
        if time is not None and time != now:
            dt = np.full(means.shape[1], (time - now) * 1e-9)
            means, covariances = motion.predict(self.config.motion, STATE, means, covariances, dt)
            now = time
        return Report(
            now,
            self.ids[chosen].astype(np.uint64),
            np.ascontiguousarray(means.T),
            np.ascontiguousarray(covariances.transpose(2, 0, 1)),
            self.existence[chosen],
            self.updated[chosen],
        )

    def _move(self, dt: float) -> None:
        """Predict the densities by `dt` s."""
        self.means, self.covariances = motion.predict(
            self.config.motion, STATE, self.means, self.covariances, np.full(len(self.ids), dt)
        )

    def _correct(
        self, returns: Floats, model: MeasurementModel, intensity: Floats, detection: Callable[[Floats], Floats]
    ) -> Association:
        """End the tracks that cannot be seen, associate the returns with the others and update their densities."""
        config = self.config
        p = detection(self.means[:2])
        self._keep(p > 0)
        p = p[p > 0] * gate_probability(config.gate, len(returns))
        prediction = predict_measurement(model, self.means, self.covariances, returns, config.cubature)
        found = associate(likelihood(prediction, config.gate), self.existence, p, intensity)
        self.means, self.covariances = update(self.means, self.covariances, prediction, found.weights, found.missed)
        return found

    def _born(self, returns: Floats, model: MeasurementModel) -> dict[str, Any]:
        """The columns of the densities of new tracks, one from each return (d, M)."""
        means, covariances = self._still(*model.locate(returns))
        return {"means": means, "covariances": covariances, "first": means[:2]}

    def _still(self, place: Floats, spread: Floats) -> tuple[Floats, Floats]:
        """States (4, M) of mean velocity 0 at `place` (2, M), and covariances (4, 4, M) given its `spread`."""
        covariances = np.zeros((4, 4, *place.shape[1:]))
        covariances[:2, :2] = spread
        covariances[2, 2] = covariances[3, 3] = self.config.sigma_speed**2
        return np.concatenate([place, np.zeros_like(place)]), covariances

    def _way(self, model: MeasurementModel) -> Floats:
        """How far (T,) each track surely is from where it started, m."""
        return np.asarray(np.hypot(*(self.means[:2] - self.first)) - 2 * self._worst_sigma())

    def _start(self, returns: Floats, model: MeasurementModel, existence: Floats) -> None:
        chosen = existence >= self.config.drop_tentative
        count = int(chosen.sum())
        born = self._born(np.ascontiguousarray(returns[:, chosen]), model)
        new = born | {
            "ids": np.arange(self._next, self._next + count),
            "existence": existence[chosen],
            "farthest": np.zeros(count),
            "born": np.full(count, self.time, dtype=np.int64),
            "updated": np.full(count, self.time, dtype=np.int64),
            "confirmed": np.zeros(count, dtype=np.bool_),
        }
        for name, values in new.items():
            setattr(self, name, np.concatenate([getattr(self, name), values], axis=-1))
        self._next += count

    def _begin_anew(self, some: NDArray[np.bool_], time: int) -> None:
        """Nothing that `some` tracks (T,) have done counts."""
        self.first = np.where(some, self.means[:2], self.first)
        self.born = np.where(some, time, self.born)
        self.confirmed = self.confirmed & ~some
        self.farthest = np.where(some, 0.0, self.farthest)

    def _worst_sigma(self) -> Floats:
        """Standard deviation (T,) of the place along its worst axis, m."""
        P = self.covariances
        return np.asarray(np.sqrt((P[0, 0] + P[1, 1]) / 2 + np.hypot((P[0, 0] - P[1, 1]) / 2, P[0, 1])))

    def _prune(self) -> None:
        config = self.config
        floor = np.where(self.confirmed, config.drop, config.drop_tentative)
        self._keep((self.existence >= floor) & (self._worst_sigma() <= config.max_sigma))
        if config.merge and len(self.ids) > 1:
            i, j = np.triu_indices(len(self.ids), 1)
            spread = self.covariances[..., i] + self.covariances[..., j]
            spread[:2, :2] += self._extent(i)
            apart = linalg.quadratic(spread, self.means[:, i] - self.means[:, j])
            keep = np.ones(len(self.ids), dtype=np.bool_)
            for first, second in zip(i[apart < config.merge], j[apart < config.merge], strict=True):
                keep[second] &= not keep[first]
            self._keep(keep)

    def _extent(self, at: NDArray[np.intp]) -> Floats:
        """How far from the tracks `at` (K,) returns of the same target may lie, as covariances (2, 2, K)."""
        if self.config.hull is None:
            return np.asarray(self.config.extent**2 * np.eye(2)[..., None])
        half, beam = (size / 2 for size in self.config.hull)
        v = self.means[2:4, at]
        speed = np.hypot(*v)
        course = np.stack([v, np.stack([-v[1], v[0]])], axis=1) / np.maximum(speed, 1e-6)
        known = speed >= MOVING
        along, across = (np.where(known, size**2, half * beam) for size in (half, beam))
        return np.asarray(
            along * linalg.outer(course[:, 0], course[:, 0]) + across * linalg.outer(course[:, 1], course[:, 1])
        )

    def _keep(self, chosen: NDArray[np.bool_]) -> None:
        if not chosen.all():
            for name in self.columns:
                setattr(self, name, getattr(self, name)[..., chosen])
