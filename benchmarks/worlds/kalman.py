"""Local trackers as sensors have them: a Kalman filter for every target, all targets of a sensor at once.

Nearly constant velocity with white acceleration noise of intensity q (Bar-Shalom, Li, Kirubarajan, 2001, 6.2), position
measured with the standard deviation sigma on each axis. So the errors of a track are correlated in time, and where the
target moves as declared its covariance is honest: the centre gets from it what it gets from a real tracker.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Filtered", "filtered", "transition"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Filtered:
    """K scans of J columns: id (K, J), 0 where there is no track; mean (K, J, 4), covariance (K, J, 4, 4) of
    (x, y, vx, vy); updated (K, J), time of the last measurement, s."""

    id: NDArray[np.uint64]
    mean: Floats
    covariance: Floats
    updated: Floats


def transition(dt: float, q: float) -> tuple[Floats, Floats]:
    """F and Q (4, 4) of nearly constant velocity over `dt` s, states (x, y, vx, vy)."""
    eye = np.eye(2)
    F = np.kron(np.array([[1.0, dt], [0.0, 1.0]]), eye)
    return F, q * np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), eye)


def filtered(
    times: Floats, measured: Floats, sigma: float, q: float, speed: float, drop: int, rng: np.random.Generator
) -> Filtered:
    """Tracks of what is measured (K, J, 2) at `times` (K,), NaN where a scan has no measurement of a column.

    A track begins with its first measurement, velocity 0 with standard deviation `speed`; it is predicted through
    scans without one and ends with the `drop`th in a row; what comes back is a new track. Ids are 1, 2, ... in the
    order of beginning, at random within a scan, so that the same number means nothing at two sensors.
    """
    scans, columns = measured.shape[:2]
    out = Filtered(
        np.zeros((scans, columns), dtype=np.uint64),
        np.zeros((scans, columns, 4)),
        np.zeros((scans, columns, 4, 4)),
        np.zeros((scans, columns)),
    )
    mean, covariance = np.zeros((columns, 4)), np.zeros((columns, 4, 4))
    first = np.diag([sigma**2, sigma**2, speed**2, speed**2])
    noise = sigma**2 * np.eye(2)
    ids, missed, updated = np.zeros(columns, dtype=np.uint64), np.zeros(columns, dtype=int), np.zeros(columns)
    given = 0
    for k, time in enumerate(times.tolist()):
        F, Q = transition(time - times[max(k - 1, 0)], q)
        live = np.flatnonzero(ids)
        mean[live] = mean[live] @ F.T
        covariance[live] = F @ covariance[live] @ F.T + Q
        hit = np.isfinite(measured[k, :, 0])
        old, new = np.flatnonzero(hit & (ids > 0)), np.flatnonzero(hit & (ids == 0))
        gain = covariance[old][:, :, :2] @ np.linalg.inv(covariance[old][:, :2, :2] + noise)
        mean[old] += np.einsum("jab,jb->ja", gain, measured[k, old] - mean[old][:, :2])
        left = np.eye(4) - np.pad(gain, ((0, 0), (0, 0), (0, 2)))
        covariance[old] = left @ covariance[old] @ left.swapaxes(1, 2) + sigma**2 * gain @ gain.swapaxes(1, 2)
        mean[new] = np.pad(measured[k, new], ((0, 0), (0, 2)))
        covariance[new] = first
        ids[new] = given + 1 + rng.permutation(len(new)).astype(np.uint64)
        given += len(new)
        missed = np.where(hit, 0, missed + 1)
        updated[hit] = time
        ids[missed >= drop] = 0
        out.id[k], out.mean[k], out.covariance[k], out.updated[k] = ids, mean, covariance, updated
    return out
