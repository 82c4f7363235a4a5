"""A GM-PHD filter (Vo and Ma 2006) with births where returns fall (Ristic, Clark, Vo and Vo 2012).

The intensity D(x) = sum_i w_i N(x; m_i, P_i) integrates over a place to the expected number of targets in it. Over
dt seconds every weight shrinks by the probability of survival and every component moves. A scan Z then gives

    D'(x) = (1 - p) D(x) + sum_z [ b(z) N(x; z) + sum_i p_i w_i l_i(z) N(x; m_i(z), P_i(z)) ] / L(z),
    L(z) = clutter(z) + b(z) + sum_i p_i w_i l_i(z),

p_i the probability of detection at m_i, l_i(z) the density of return z under component i, b(z) the intensity, in
measurement space, of first returns of targets not there before: a target is taken to be seen when it appears, its
component is what the return alone tells. A component outside the field of view (p = 0) ends there: the mass is the
expected number of targets inside. Then components below `prune` are dropped, those close to a heavier one are merged
into it with their moments kept, and of more than `cap` the heaviest stay. What is dropped is lost from the mass: at
most `prune` times the number dropped, and that is the clutter's share of births not seen again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np

from fusion_service import linalg, motion
from schemas import Motion
from sensor_clients.filters.association import gate_probability, likelihood
from sensor_clients.filters.measurement import STATE, Floats, MeasurementModel, predict_measurement

__all__ = ["GmPhdFilter", "PhdConfig", "merge"]


@dataclass(frozen=True, slots=True)
class PhdConfig:
    """motion, survival (for one second), sigma_speed, gate, cubature as in `TrackerConfig`; prune: least weight;
    merge: squared Mahalanobis distance, by the heavier's covariance, below which components become one; cap: most
    components; report: least weight of a component that is told to others, who have no use for a return's first
    guess: what it leaves out is about the births of one scan."""

    motion: Motion
    survival: float
    sigma_speed: float
    gate: float = 16.0
    prune: float = 1e-4
    merge: float = 4.0
    cap: int = 600
    report: float = 0.01
    cubature: bool = True


class GmPhdFilter:
    """The intensity of one sensor: weights (C,), means (4, C), covariances (4, 4, C), in `STATE`."""

    def __init__(self, config: PhdConfig) -> None:
        self.config = config
        self.time: int | None = None
        self.weights: Floats = np.zeros(0)
        self.means: Floats = np.zeros((4, 0))
        self.covariances: Floats = np.zeros((4, 4, 0))

    @property
    def mass(self) -> float:
        """The expected number of targets."""
        return float(self.weights.sum())

    def step(
        self,
        time: int,
        returns: Floats,
        model: MeasurementModel,
        clutter: Floats,
        birth: Floats,
        detection: Callable[[Floats], Floats],
    ) -> None:
        """One scan at `time`, ns; the arguments are those of `LocalTracker.step`. ValueError if back in time."""
        config = self.config
        self._predict(time)
        p = detection(self.means[:2])
        inside = p > 0
        w, p = self.weights[inside], p[inside] * gate_probability(config.gate, len(returns))
        means = np.ascontiguousarray(self.means[:, inside])
        covariances = np.ascontiguousarray(self.covariances[..., inside])
        prediction = predict_measurement(model, means, covariances, returns, config.cubature)
        joint = (p * w)[:, None] * likelihood(prediction, config.gate)
        total = clutter + birth + joint.sum(axis=0)
        share = joint / total
        i, z = np.nonzero(share >= config.prune)
        gain, S = prediction.gain[..., i], prediction.covariance[..., i]
        place, spread = model.locate(returns)
        new = np.zeros((4, 4, returns.shape[1]))
        new[:2, :2] = spread
        new[[2, 3], [2, 3]] = config.sigma_speed**2
        self.weights = np.concatenate([(1 - p) * w, share[i, z], birth / total])
        self.means = np.concatenate(
            [
                means,
                means[:, i] + linalg.matvec(gain, prediction.innovations[:, i, z]),
                np.concatenate([place, np.zeros_like(place)]),
            ],
            axis=1,
        )
        shrunk = linalg.symmetrise(covariances[..., i] - linalg.congruence(gain, S))
        self.covariances = np.concatenate([covariances, shrunk, new], axis=2)
        self._reduce()

    def report(self) -> dict[str, Any]:
        """What `TrackPublisher.intensity` takes of it: the components of at least weight `report`."""
        told = self.weights >= self.config.report
        return {
            "space": STATE,
            "weights": self.weights[told],
            "means": np.ascontiguousarray(self.means[:, told].T),
            "covariances": np.ascontiguousarray(self.covariances[..., told].transpose(2, 0, 1)),
        }

    def _predict(self, time: int) -> None:
        dt = 0.0 if self.time is None else (time - self.time) * 1e-9
        steps = np.full(len(self.weights), dt)
        self.means, self.covariances = motion.predict(self.config.motion, STATE, self.means, self.covariances, steps)
        self.weights = self.weights * self.config.survival**dt
        self.time = time

    def _reduce(self) -> None:
        config = self.config
        kept = self.weights >= config.prune
        parts = merge(self.weights[kept], self.means[:, kept], self.covariances[..., kept], config.merge)
        heaviest = np.argsort(-parts[0], kind="stable")[: config.cap]
        self.weights, self.means, self.covariances = (np.ascontiguousarray(part[..., heaviest]) for part in parts)


def merge(weights: Floats, means: Floats, covariances: Floats, distance: float) -> tuple[Floats, Floats, Floats]:
    """Components, heaviest first: each takes in all the lighter ones whose means lie within the squared distance
    (m_i - m)' P^-1 (m_i - m) of it, P its own covariance, and keeps their joint mass, mean and covariance.

    weights (C,), means (n, C), covariances (n, n, C); C may be 0.
    """
    order = np.argsort(-weights, kind="stable")
    w, m, P = weights[order], np.ascontiguousarray(means[:, order]), np.ascontiguousarray(covariances[..., order])
    precision = linalg.inverse(P)
    owner = np.full(len(w), -1)
    for i in range(len(w)):
        if owner[i] < 0:
            free = i + np.flatnonzero(owner[i:] < 0)
            away = m[:, free] - m[:, i, None]
            near = np.einsum("af,ab,bf->f", away, precision[..., i], away) < distance
            owner[free[near]] = i
            owner[i] = i
    heads, group = np.unique(owner, return_inverse=True)
    mass: Floats = np.bincount(group, w, len(heads)).astype(np.float64)

    def mean_of(values: Floats) -> Floats:
        rows = (w * values).reshape(prod(values.shape[:-1]), len(w))
        sums = np.stack([np.bincount(group, row, len(heads)) for row in rows])
        return np.asarray(sums.reshape(*values.shape[:-1], -1) / mass)

    mean = mean_of(m)
    away = m - mean[:, group]
    return mass, mean, linalg.symmetrise(mean_of(P + linalg.outer(away, away)))
