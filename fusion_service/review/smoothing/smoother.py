"""Fixed-interval smoothing of many objects at once (Rauch, Tung, Striebel 1965), measurements in information form.

    forward     P^-1 = P_pred^-1 + L,    x = x_pred + P (y - L x_pred)
    backward    G = P F' P_pred'^-1,     x_s = x + G (x_s' - x_pred'),    P_s = P + G (P_s' - P_pred') G'

Nothing is known before an object's first measurement: it begins with what its first `y`, `L` tell, and a velocity that
may be anything up to `UNKNOWN` where they tell none.
"""

from __future__ import annotations

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.motion import transition
from fusion_service.review.snapshots import Times
from schemas import Motion

__all__ = ["smooth"]

UNKNOWN = 1e6
"""m, m/s: standard deviation of what nobody has told."""


def smooth(
    times: Times,
    y: Floats,
    L: Floats,
    begin: np.ndarray[tuple[int], np.dtype[np.intp]],
    motion: Motion,
    space: tuple[str, ...],
) -> tuple[Floats, Floats]:
    """Means (K, O, n) and covariances (K, O, n, n) of O objects at times (K,), ns, ascending, from y (K, O, n) and
    L (K, O, n, n), zeros where nothing came; begin (O,): the first time of each. Before it they are no use."""
    count, objects, n = y.shape
    means, covariances = np.zeros_like(y), np.zeros_like(L)
    ahead_x, ahead_P = np.zeros_like(y), np.zeros_like(L)
    moves = np.zeros((count, n, n))
    x, P = np.zeros((objects, n)), np.tile(UNKNOWN**2 * np.eye(n), (objects, 1, 1))
    blank = x.copy(), P.copy()
    for k in range(count):
        dt = (int(times[k]) - int(times[k - 1])) / 1e9 if k else 0.0
        F, Q = (part[..., 0] for part in transition(motion, space, np.zeros((n, 1)), np.array([dt])))
        moves[k] = F
        fresh = (k <= begin)[:, None]
        x = np.where(fresh, blank[0], x @ F.T)
        P = np.where(fresh[..., None], blank[1], F @ P @ F.T + Q)
        ahead_x[k], ahead_P[k] = x, P
        told = np.flatnonzero(L[k].any(axis=(1, 2)))
        if len(told):
            A = L[k, told]
            P[told] = np.linalg.inv(np.linalg.inv(P[told]) + A)
            P[told] = 0.5 * (P[told] + P[told].swapaxes(-1, -2))
            x[told] += (P[told] @ (y[k, told] - (A @ x[told, :, None])[..., 0])[..., None])[..., 0]
        means[k], covariances[k] = x, P
    for k in range(count - 2, -1, -1):
        G = covariances[k] @ moves[k + 1].T @ np.linalg.inv(ahead_P[k + 1])
        G[k < begin] = 0.0
        means[k] += (G @ (means[k + 1] - ahead_x[k + 1])[..., None])[..., 0]
        covariances[k] += G @ (covariances[k + 1] - ahead_P[k + 1]) @ G.swapaxes(-1, -2)
    return means, covariances
