"""Local trackers whose tracks are Gaussian mixtures: joint IPDA over components instead of over single Gaussians.

A track has C components with weights mu_m, each with its own density l_ij^m of return j and probability p_m of
detection. Return j is associated (`association`) by what the whole track says of it,

    p = sum_m mu_m p_m,   l_ij = sum_m mu_m p_m l_ij^m / p,

and given that it is the track's, component m is the true one with probability mu_m p_m l_ij^m / (p l_ij), given
that the track was missed with mu_m (1 - p_m) / (1 - p). With b_ij the weight of return j, b_i0 of none,

    mu_m' = b_i0 mu_m (1 - p_m) / (1 - p) + sum_j b_ij mu_m p_m l_ij^m / (p l_ij),

and component m is updated by its own share of each b, moment-matched as a single Gaussian would be: PDA for a bank
of filters (Bar-Shalom, Kirubarajan and Lin 2005), with IPDA's existence. How the components come to be and how they
move is the matter of the trackers built on it (`imm`, `bearing`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from fusion_service import linalg
from sensor_clients.filters.association import Association, associate, gate_probability, likelihood, update
from sensor_clients.filters.measurement import Floats, MeasurementModel, predict_measurement
from sensor_clients.filters.tracker import LocalTracker, Report, TrackerConfig

__all__ = ["MixtureTracker", "moments"]

NEGLIGIBLE = 1e-3
"""Components of less weight are not reported."""


def moments(weights: Floats, means: Floats, covariances: Floats) -> tuple[Floats, Floats]:
    """Mean (n, T) and covariance (n, n, T) of mixtures: weights (C, T), means (n, C, T), covariances (n, n, C, T)."""
    mean = np.einsum("ct,act->at", weights, means)
    away = means - mean[:, None]
    spread = np.einsum("ct,abct->abt", weights, covariances) + np.einsum("ct,act,bct->abt", weights, away, away)
    return mean, linalg.symmetrise(spread)


class MixtureTracker(LocalTracker):
    """Tracks of `size` components each; `means` and `covariances` are the moments of the whole.

    Further columns: weights (C, T), summing to 1 over C; parts (4, C, T) and spreads (4, 4, C, T): the components.
    """

    columns: ClassVar[tuple[str, ...]] = (*LocalTracker.columns, "weights", "parts", "spreads")

    def __init__(self, config: TrackerConfig, size: int) -> None:
        super().__init__(config)
        self.weights: Floats = np.zeros((size, 0))
        self.parts: Floats = np.zeros((4, size, 0))
        self.spreads: Floats = np.zeros((4, 4, size, 0))

    def _moved(self, dt: float) -> tuple[Floats, Floats, Floats]:
        """Weights, parts and spreads `dt` s later."""
        raise NotImplementedError

    def _move(self, dt: float) -> None:
        self.weights, self.parts, self.spreads = self._moved(dt)
        self.means, self.covariances = moments(self.weights, self.parts, self.spreads)

    def _correct(
        self, returns: Floats, model: MeasurementModel, intensity: Floats, detection: Callable[[Floats], Floats]
    ) -> Association:
        C, T = self.weights.shape
        p = detection(self.parts[:2].reshape(2, -1)).reshape(C, T)
        seen = np.any(p > 0, axis=0)
        self._keep(np.asarray(seen))
        T, p = int(seen.sum()), p[:, seen] * gate_probability(self.config.gate, len(returns))
        flat = predict_measurement(
            model, self.parts.reshape(4, -1), self.spreads.reshape(4, 4, -1), returns, self.config.cubature
        )
        density = likelihood(flat, self.config.gate).reshape(C, T, returns.shape[1])
        hit = self.weights * p
        total = hit.sum(axis=0)
        joint = hit[..., None] * density
        whole = joint.sum(axis=0)
        found = associate(whole / total[:, None], self.existence, total, intensity)
        by_return = joint * (found.weights / np.where(whole > 0, whole, 1.0))
        by_none = self.weights * (1 - p) * (found.missed / (1 - total))
        after = by_return.sum(axis=-1) + by_none
        safe = np.maximum(after, 1e-300)
        parts, spreads = update(
            self.parts.reshape(4, -1),
            self.spreads.reshape(4, 4, -1),
            flat,
            (by_return / safe[..., None]).reshape(C * T, returns.shape[1]),
            (by_none / safe).ravel(),
        )
        self.weights = after / after.sum(axis=0)
        self.parts, self.spreads = parts.reshape(4, C, T), spreads.reshape(4, 4, C, T)
        self.means, self.covariances = moments(self.weights, self.parts, self.spreads)
        return found

    def _born(self, returns: Floats, model: MeasurementModel) -> dict[str, Any]:
        weights, parts, spreads = self._components(returns, model)
        means, covariances = moments(weights, parts, spreads)
        whole = {"means": means, "covariances": covariances, "first": means[:2]}
        return whole | {"weights": weights, "parts": parts, "spreads": spreads}

    def _components(self, returns: Floats, model: MeasurementModel) -> tuple[Floats, Floats, Floats]:
        """Weights (C, M), parts (4, C, M) and spreads (4, 4, C, M) of new tracks from returns (d, M)."""
        raise NotImplementedError

    def report(self, time: int | None = None) -> Report:
        """The tracks to report as mixtures, at the time of the last step, or predicted on to `time`, ns."""
        now = self.time or 0
        weights, parts, spreads = self._moved(0.0 if time is None else (time - now) * 1e-9)
        chosen = self.reported()
        kept = (weights[:, chosen] >= NEGLIGIBLE).T
        shares = np.where(kept, weights[:, chosen].T, 0.0)
        shares /= shares.sum(axis=1, keepdims=True)
        return replace(
            super().report(),
            time=now if time is None else time,
            means=np.ascontiguousarray(parts[..., chosen].transpose(2, 1, 0)[kept]),
            covariances=np.ascontiguousarray(spreads[..., chosen].transpose(3, 2, 0, 1)[kept]),
            counts=kept.sum(axis=1).astype(np.uint16),
            weights=shares[kept],
        )
