"""Bearings without range as what a client can publish: places on the plane that are uncertain along the line of sight.

A direction finder, a camera or a passive array knows the bearing of a target and next to nothing of its range. Sent as
tracks of `x`, `y` alone it is information across the line of sight; two such sources that see one target from different
places make a position of it, in the centre, by any rule.

* `along_sight`: one Gaussian per bearing, for ranges from `near` to `far`, all equally likely. Its sigma across is that
  of the bearing at `far`: true at the far end, cautious nearer by.
* `by_range`: a mixture per bearing, one component for each interval of range, edges in a constant ratio, all of equal
  weight (Peach 1995): range uniform in its logarithm, and the sigma across is each interval's own. It is nearer to the
  truth where `far` is many times `near`; set `mixture_rule` in the centre if it should stay a mixture in fusion.

Bearings are in rad, clockwise from north (+y), places in m in the frame of `origin`. NumPy only.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["THINNEST", "ByRange", "along_sight", "by_range"]

Floats = NDArray[np.float64]
THINNEST = 1e-6
"""The least sigma across, by that along: what is thinner is refused on its way (WIRE.md: not-positive-definite)."""


class ByRange(NamedTuple):
    """What `TrackPublisher.tracks` takes of T bearings in C intervals: counts (T,), weights (T*C,), means (T*C, 2),
    covariances (T*C, 2, 2)."""

    counts: NDArray[np.uint16]
    weights: Floats
    means: Floats
    covariances: Floats


def along_sight(
    origin: ArrayLike, bearing: ArrayLike, sigma: ArrayLike, near: float, far: float
) -> tuple[Floats, Floats]:
    """Means (T, 2), m, and covariances (T, 2, 2) of targets in `bearing` (T,) from `origin` (2,) or (T, 2), rad with
    standard deviation `sigma` (T,) or one, at a range from `near` to `far`, m. `ValueError` if these fit no target."""
    angle, error = _angles(bearing, sigma, near, far)
    place = _origins(origin, len(angle))
    sight = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    along = np.full(len(angle), (far - near) / math.sqrt(12.0))
    return place + 0.5 * (near + far) * sight, _long(sight, along, far * error)


def by_range(
    origin: ArrayLike, bearing: ArrayLike, sigma: ArrayLike, near: float, far: float, components: int = 8
) -> ByRange:
    """The same as mixtures of so many components. A centre keeps 8 by default (`max_components`)."""
    if components < 1:
        raise ValueError(f"{components} components: at least one is needed")
    if not near > 0.0:
        raise ValueError(f"near is {near:g} m: intervals in a constant ratio need more than 0")
    angle, error = _angles(bearing, sigma, near, far)
    count = len(angle)
    place = np.repeat(_origins(origin, count), components, axis=0)
    sight = np.repeat(np.stack([np.sin(angle), np.cos(angle)], axis=-1), components, axis=0)
    edges = near * (far / near) ** (np.arange(components + 1) / components)
    middle, width = np.tile((edges[:-1] + edges[1:]) / 2, count), np.tile(np.diff(edges), count)
    return ByRange(
        np.full(count, components, dtype=np.uint16),
        np.full(count * components, 1.0 / components),
        place + middle[:, None] * sight,
        _long(sight, width / math.sqrt(12.0), middle * np.repeat(error, components)),
    )


def _angles(bearing: ArrayLike, sigma: ArrayLike, near: float, far: float) -> tuple[Floats, Floats]:
    angle = np.atleast_1d(np.asarray(bearing, dtype=np.float64))
    error = np.broadcast_to(np.asarray(sigma, dtype=np.float64), angle.shape)
    if not (np.isfinite(angle).all() and np.isfinite(error).all() and (error > 0.0).all()):
        raise ValueError("bearings and their sigma must be finite numbers, sigma more than 0 rad")
    if not 0.0 <= near < far < math.inf:
        raise ValueError(f"ranges from {near:g} to {far:g} m: near must be 0 or more, and far beyond it")
    return angle, error


def _origins(origin: ArrayLike, count: int) -> Floats:
    return np.array(np.broadcast_to(np.asarray(origin, dtype=np.float64), (count, 2)))


def _long(sight: Floats, along: Floats, across: Floats) -> Floats:
    """Covariances (R, 2, 2) of sigma `along` the unit vectors `sight` (R, 2) and `across` them."""
    across = np.maximum(across, THINNEST * along)
    normal = np.stack([sight[:, 1], -sight[:, 0]], axis=-1)
    out = along[:, None, None] ** 2 * sight[:, :, None] * sight[:, None, :]
    return np.asarray(out + across[:, None, None] ** 2 * normal[:, :, None] * normal[:, None, :])
