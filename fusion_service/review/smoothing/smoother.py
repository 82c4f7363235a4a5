"""Fixed-interval smoothing of many objects at once, by two filters in information form (Fraser and Potter 1969).

    forward    M = F^-T Y F^-1,  Y' = (I + M Q)^-1 M,  y' = (I + M Q)^-1 F^-T y,    then  Y' + L,  y' + y
    backward   N = Z + L,        Z' = F' (I + N Q)^-1 N F,  z' = F' (I + N Q)^-1 (z + y)
    together   P_s = (Y + Z)^-1,  x_s = P_s (y + z)

with Y of all until a time and Z of all after it. It is the smoother of Rauch, Tung and Striebel, and needs
no covariance where nothing is known yet: an object begins with what its first measurement tells.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.motion import transition
from fusion_service.review.snapshots import Times
from schemas import Motion

__all__ = ["UNKNOWN", "smooth"]

UNKNOWN = 1e6
"""m, m/s: standard deviation of what nobody has told, before or after."""


def smooth(
    times: Times, y: Floats, L: Floats, begin: NDArray[np.intp], motion: Motion, space: tuple[str, ...]
) -> tuple[Floats, Floats]:
    """Means (K, O, n) and covariances (K, O, n, n) of O objects at times (K,), ns, ascending, from y (K, O, n) and
    L (K, O, n, n), zeros where nothing came; begin (O,): the first time of each. motion: linear, of constant velocity.
    Before the first time of an object its rows are no use."""
    count, _, n = y.shape
    steps = [_between(times, k, motion, space) for k in range(1, count)]
    I, Y, v = np.eye(n), np.zeros_like(L[:1][0]), np.zeros_like(y[:1][0])
    information, vectors = np.zeros_like(L), np.zeros_like(y)
    for k in range(count):
        if k:
            F, Q = steps[k - 1]
            back = np.linalg.inv(F)
            M = back.T @ Y @ back
            S = np.linalg.inv(I + M @ Q)
            Y, v = _even(S @ M), (S @ (v @ back)[..., None])[..., 0]
            early = k <= begin
            Y[early], v[early] = 0.0, 0.0
        Y, v = Y + L[k], v + y[k]
        information[k], vectors[k] = Y, v
    means, covariances = np.zeros_like(y), np.zeros_like(L)
    Z, z = np.zeros_like(Y), np.zeros_like(v)
    for k in range(count - 1, -1, -1):
        if k < count - 1:
            F, Q = steps[k]
            N = Z + L[k + 1]
            S = np.linalg.inv(I + N @ Q)
            Z, z = _even(F.T @ S @ N @ F), (S @ (z + y[k + 1])[..., None])[..., 0] @ F
        P = np.linalg.inv(information[k] + Z + I / UNKNOWN**2)
        covariances[k] = _even(P)
        means[k] = (P @ (vectors[k] + z)[..., None])[..., 0]
    return means, covariances


def _between(times: Times, k: int, motion: Motion, space: tuple[str, ...]) -> tuple[Floats, Floats]:
    dt = np.array([(int(times[k]) - int(times[k - 1])) / 1e9])
    F, Q = transition(motion, space, np.zeros((len(space), 1)), dt)
    return F[..., 0], Q[..., 0]


def _even(P: Floats) -> Floats:
    return 0.5 * (P + P.swapaxes(-1, -2))
