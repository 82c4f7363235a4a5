"""The Kalman filter, batch last: means (n, B), covariances (n, n, B).

    predict   x' = F x,  P' = F P F' + Q
    update    S = H P H' + R,  K = P H' S^-1,  x' = x + K (z - H x),  P' = P - K S K'

The batch may be tracks, Monte Carlo runs, or both. F, H, Q and R may be one matrix for the whole batch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fusion_service import linalg
from sensor_clients.filters.measurement import Floats

__all__ = ["Estimate", "correct", "predict", "update"]


class Estimate(NamedTuple):
    """Gaussian states: mean (n, B) and covariance (n, n, B)."""

    mean: Floats
    covariance: Floats


def predict(state: Estimate, F: Floats, Q: Floats) -> Estimate:
    """One step of x' = F x + w, w ~ N(0, Q): F and Q (n, n), or (n, n, B)."""
    return Estimate(linalg.matvec(F, state.mean), linalg.congruence(F, state.covariance) + _whole(Q))


def update(state: Estimate, H: Floats, R: Floats, z: Floats) -> Estimate:
    """Take in measurements z (d, B) = H x + v, v ~ N(0, R): H (d, n) or (d, n, B), R (d, d) or (d, d, B)."""
    cross = linalg.product(state.covariance, _whole(H).swapaxes(0, 1))
    S = linalg.congruence(H, state.covariance) + _whole(R)
    return correct(state, z - linalg.matvec(H, state.mean), S, cross)


def correct(state: Estimate, innovation: Floats, S: Floats, cross: Floats) -> Estimate:
    """The linear update by an innovation (d, B) of covariance S (d, d, B), whose covariance with the state is
    `cross` (n, d, B). S is read as symmetric."""
    K = linalg.product(cross, linalg.inverse(S))
    return Estimate(state.mean + linalg.matvec(K, innovation), state.covariance - linalg.congruence(K, S))


def _whole(a: Floats) -> Floats:
    return a[..., None] if a.ndim == 2 else np.asarray(a)
