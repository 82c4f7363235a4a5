"""What each new version of a local track adds to the one before it: an equivalent measurement.

With P_- the old version predicted with the motion of its tracker to the time of the new one, P, and x_-, x likewise,

    dY = P^-1 - P_-^-1,    dy = P^-1 x - P_-^-1 x_-

is what a linear-Gaussian tracker has put in: H' R^-1 H and H' R^-1 z of its measurement, whatever it knew before. So
it is independent of all that was fused before, and another filter may take it as a measurement (equivalent
measurements, or tracklets: Frenkel 1995; Drummond 1997; Bar-Shalom, Willett, Tian, Tracking and Data Fusion, 2011,
9.3). It is exact for one measurement; of several between two versions the process noise of the tracker between them
goes into all, and a second tracker's knows the same noise: near it.

The tracker's own innovation is in it, x - x_-, whose covariance is P_- - P if the tracker is what it says. That does
not take another source to test.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, cast

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats
from fusion_service.centre.tracks import taken
from fusion_service.centre.versions import Versions

__all__ = ["Increments", "increments"]

NEGATIVE = 0.04
"""How far below zero, relative to the information there was, an increment may be: rounding, frames that turn, and a
process noise that is declared a tenth too small."""
RIDGE = 0.05
"""Of P_-, added to P_- - P, which has the rank of the measurement only: directions in which less than that is gained
count for little, so that a process noise declared a tenth too large does not count as freedom."""
DEFINITE = 1e-14
"""Margin from which a covariance is positive definite, as in `linalg`."""
LITTLE = 0.5
"""An innovation of less freedom says nothing."""
LARGEST = 50.0
"""No innovation counts for more, per degree of freedom: one of a manoeuvre says little of all the others."""


@dataclass(frozen=True, slots=True, eq=False)
class Increments:
    """Of K versions: information dY (n, n, K); vector (n, K), P^-1 (x - x_-), so that the innovation of dy beside any
    state m is vector + dY (x_- - m). innovation (K,): normalised square of the tracker's own, to be compared with its
    freedom (K,), its expectation. sound (K,): finite, and dY is not negative."""

    information: Floats
    vector: Floats
    innovation: Floats
    freedom: Floats
    sound: Bools

    def take(self, at: Any) -> Increments:
        """The given ones (indices or a mask)."""
        return cast(Increments, taken(self, at))


def increments(versions: Versions) -> Increments:
    """The increments of versions."""
    n, count = versions.mean.shape
    out = Increments(
        np.empty((n, n, count)), np.empty((n, count)), np.empty(count), np.empty(count), np.empty(count, dtype=np.bool_)
    )
    for part in linalg.blocks(n, count):
        for one, column in zip(fields(out), _of_block(versions.take(part)), strict=True):
            getattr(out, one.name)[..., part] = column
    return out


def _of_block(versions: Versions) -> tuple[Floats, Floats, Floats, Floats, Bools]:
    """The columns of the increments of some versions."""
    before, after = versions.predicted_covariance, versions.covariance
    with np.errstate(all="ignore"):
        old, _, first = linalg.sweep(before)
        new, _, second = linalg.sweep(after)
        information = new - old
        step = versions.mean - versions.predicted_mean
        vector = linalg.matvec(new, step)
        gained = before - after
        ridged = gained + RIDGE * before
        inverse, _, third = linalg.sweep(ridged)
        freedom = linalg.inner(inverse, gained)
        innovation = np.minimum(linalg.quadratic(ridged, step), LARGEST * np.maximum(freedom, 1.0))
        sound = (np.minimum(first, second) > 0) & np.isfinite(vector).all(axis=0)
        sound &= np.isfinite(information).all(axis=(0, 1))
        sound &= linalg.is_positive_definite(information + NEGATIVE * old)
        judged = np.isfinite(innovation) & np.isfinite(freedom) & (third > DEFINITE)
        counted = judged & (freedom > LITTLE)
    return information, vector, np.where(counted, innovation, 0.0), np.where(counted, freedom, 0.0), sound & judged
