"""Components of the state that a density does not have.

The picture has one state space; a source may tell less of it: places without velocity, a plane without height. What is
missing stands in a row, or a global track, as **padding**: mean 0, no correlation, and a sigma (`SIGMA`) so large that
it is no information to any rule in information form (what it takes from a known component is below 1e-9 of that). A
component is unknown exactly where its sigma is `schemas.UNKNOWN_SIGMA` or more, whoever has put it there, so
nothing else has to be remembered of it: two densities have in common what the sum of their covariances knows. x and y
are always known.

The factorisations of `linalg` are indifferent to the scale of each component, so padding costs no digits. But nothing
may depend on its size: gates take the degrees of freedom that are in common, log-determinants count a missing component
as any plausible value of it (`plausible`), the prediction leaves it out (`predict_known`), and rules never see a
component that none of their sources has (`fuse_known` in `blocks`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints, all_of, any_of, filled
from fusion_service.geodesy import transform
from fusion_service.motion import predict
from schemas import UNKNOWN_SIGMA, Frame, Height, Motion

__all__ = ["AXES", "PLACED", "SIGMA", "Unknown", "apart", "brought", "patterns", "predict_known", "transformed"]

SIGMA = dict.fromkeys(("x", "y"), np.inf) | {name: 1e3 * sigma for name, sigma in UNKNOWN_SIGMA.items()}
"""Of a component that is not known: m, m/s, m/s2, rad/s. Of x and y, which always are, without meaning."""
PLAUSIBLE_HEIGHT = 1e4
PLAUSIBLE_TURN = 0.3
AXES = (("x", "vx"), ("y", "vy"), ("z", "vz"))
PLACED = ("still", "ou")
"""Kinds of motion that say of a place alone how it moves."""


@dataclass(frozen=True, slots=True, eq=False)
class Unknown:
    """Of a space of n components: limit (n,), the variance from which each is unknown; pad (n,), its variance where it
    is; plausible (n,), the variance of what it may be. limits: the index and the limit of each that may be unknown."""

    space: tuple[str, ...]
    limit: Floats
    pad: Floats
    plausible: Floats
    limits: tuple[tuple[int, float], ...]

    @classmethod
    def of(cls, space: tuple[str, ...], speed: float = 100.0, acceleration: float = 20.0) -> Unknown:
        """speed, acceleration: one sigma of what targets may have, m/s, m/s2."""
        return _unknown(tuple(space), speed, acceleration)

    def known(self, covariance: Floats) -> NDArray[np.bool_]:
        """Which components (n, ...) of densities with `covariance` (n, n, ...) are known."""
        known = np.empty(covariance.shape[1:], dtype=np.bool_)
        known.fill(True)
        for k, limit in self.limits:
            known[k] = ~(covariance[k, k] >= limit)
        return known

    def told(self, covariance: Floats) -> Floats:
        """Covariances (n, n, ...) as they are published: padding that is just large enough to be known as such, so that
        readers lose no more digits by it than they must. What has become unknown, by noise, is correlated with nothing
        then: less variance would not bear it."""
        known = self.known(covariance)
        if all_of(known):
            return covariance
        out, diagonal = np.where(known[:, None] & known[None], covariance, 0.0), range(len(covariance))
        out[diagonal, diagonal] = np.where(
            known, covariance[diagonal, diagonal], self.limit.reshape(-1, *(1,) * (known.ndim - 1))
        )
        return out

    def shared(self, means: Floats, covariances: Floats) -> tuple[Floats, Floats]:
        """Densities (n, B, N) and (n, n, B, N) of which those of an element are alike (0 +- 1, on its own) in each
        component that one of its N does not know."""
        both = np.asarray(self.known(covariances).all(axis=-1, keepdims=True))
        alike = np.where(both[:, None] & both[None], covariances, 0.0)
        diagonal = range(len(means))
        alike[diagonal, diagonal] = np.where(both, alike[diagonal, diagonal], 1.0)
        return np.where(both, means, 0.0), alike

    def common(self, spread: Floats) -> tuple[Ints, Floats]:
        """Of pairs with the sum of covariances `spread` (n, n, K): how many components both know (K,), and what to add
        (K,) to log det `spread` so that the others count as plausible values."""
        count, more = filled(spread.shape[2:], len(spread), np.intp), np.zeros(spread.shape[2:])
        if not any_of(spread.diagonal() >= self.limit):
            return count, more
        for k, (limit, plausible) in enumerate(zip(self.limit, self.plausible, strict=True)):
            missing = spread[k, k] >= limit
            if missing.any():
                count -= missing
                more = np.where(missing, more + np.log(plausible / np.where(missing, spread[k, k], 1.0)), more)
        return count, more


@lru_cache(maxsize=256)
def _unknown(space: tuple[str, ...], speed: float, acceleration: float) -> Unknown:
    likely = {"x": 1.0, "y": 1.0, "z": PLAUSIBLE_HEIGHT, "turn_rate": PLAUSIBLE_TURN}
    likely |= dict.fromkeys(("vx", "vy", "vz"), max(speed, 1e-3))
    likely |= dict.fromkeys(("ax", "ay", "az"), max(acceleration, 1e-3))
    sigma = np.array([SIGMA[name] for name in space])
    plausible = np.array([likely[name] for name in space])
    limit = np.array([UNKNOWN_SIGMA.get(name, np.inf) for name in space])
    finite = tuple((k, one) for k, one in enumerate((limit**2).tolist()) if one < np.inf)
    return Unknown(space, limit**2, sigma**2, plausible**2, finite)


def patterns(known: Bools) -> Iterator[tuple[Ints, Any]]:
    """The columns of `known` (n, B) by what they know: (indices of the components (m,), columns (some of B,)), in a
    fixed order. Where all know all, the columns are a slice."""
    if known.all():
        yield np.arange(len(known)), slice(None)
        return
    kinds, which = np.unique(known, axis=1, return_inverse=True)
    for number, kind in enumerate(kinds.T):
        yield np.flatnonzero(kind), np.flatnonzero(which.reshape(-1) == number)


def brought(mean: Floats, covariance: Floats, space: tuple[str, ...], unknown: Unknown) -> tuple[Floats, Floats]:
    """Densities (m, ...), (m, m, ...) of `space` in that of `unknown`: marginalised, and padded."""
    if space == unknown.space:
        return mean, covariance
    old = np.array([space.index(name) for name in unknown.space if name in space], dtype=np.intp)
    if len(old) == len(unknown.space):
        return mean[old], covariance[np.ix_(old, old)]
    new = np.array([k for k, name in enumerate(unknown.space) if name in space], dtype=np.intp)
    n, batch = len(unknown.space), mean.shape[1:]
    means, covariances = np.zeros((n, *batch)), np.zeros((n, n, *batch))
    means[new] = mean[old]
    for k in np.setdiff1d(np.arange(n), new):
        covariances[k, k] = unknown.pad[k]
    covariances[np.ix_(new, new)] = covariance[np.ix_(old, old)]
    return means, covariances


def predict_known(
    motion: Motion,
    space: tuple[str, ...],
    mean: Floats,
    covariance: Floats,
    known: Bools,
    dt: Floats,
    unknown: Unknown,
    speed: float,
    age: NDArray[np.float64] | float = 0.0,
    frame: Frame | None = None,
) -> tuple[Floats, Floats]:
    """B densities of C components, mean (m, C, B) and covariance (m, m, C, B) in `space`, of which `known` (m, B) are
    known, `dt` (B,) seconds later in the space of `unknown`.

    Each moves in the space of what it knows; a place whose velocity is not known, though the other space has it, has
    besides gone at some speed (one sigma, m/s, on each axis) since `age` (B,) seconds before: speed^2 ((age + dt)^2 -
    age^2) is added to its variance, so that many short steps give what one long one does.
    """
    ages = np.broadcast_to(age, dt.shape)

    def moved(names: tuple[str, ...], x: Floats, P: Floats, gone: Floats, since: Floats) -> tuple[Floats, Floats]:
        m, shape = len(names), x.shape
        gaps = gone if shape[1] == 1 else np.tile(gone, shape[1])
        one, spread = predict(motion, names, x.reshape(m, -1), P.reshape(m, m, -1), gaps, frame)
        spread = spread.reshape(m, *shape)
        for place, velocity in AXES:
            if velocity in unknown.space and place in names and velocity not in names and motion.kind not in PLACED:
                k = names.index(place)
                spread[k, k] += speed**2 * gone * (gone + 2.0 * since)
        return brought(one.reshape(shape), spread, names, unknown)

    if all_of(known):
        return moved(space, mean, covariance, dt, ages)
    out_mean = np.empty((len(unknown.space), *mean.shape[1:]))
    out_covariance = np.empty((len(unknown.space), *out_mean.shape))
    for some, at in patterns(known):
        names = tuple(space[k] for k in some.tolist())
        part = mean[some][..., at], covariance[np.ix_(some, some)][..., at]
        out_mean[..., at], out_covariance[..., at] = moved(names, *part, dt[at], ages[at])
    return out_mean, out_covariance


def transformed(
    means: Floats,
    covariances: Floats,
    space: tuple[str, ...],
    frame: Frame,
    target: Frame,
    height: Height | None = None,
) -> tuple[Floats, Floats]:
    """`geodesy.transform` of densities (C, n), (C, n, n): what one does not know is left out, and padded again, so that
    an unknown height spreads over nothing else. Raises `FrameError`."""
    if frame == target:
        return means, covariances
    unknown = Unknown.of(space)
    known = unknown.known(covariances.transpose(1, 2, 0))
    if known.all():
        return transform(means, covariances, space, frame, target, height)
    out_mean, out_covariance = np.zeros_like(means), np.zeros_like(covariances)
    out_covariance[:, range(len(space)), range(len(space))] = unknown.pad
    for some, at in patterns(known):
        names, place, square = tuple(space[k] for k in some.tolist()), np.ix_(at, some), np.ix_(at, some, some)
        out_mean[place], out_covariance[square] = transform(
            means[place], covariances[square], names, frame, target, height
        )
    return out_mean, out_covariance


def apart(spread: Floats, offset: Floats, unknown: Unknown) -> tuple[Floats, Floats, Ints]:
    """d2, log det and degrees of freedom (K,) of pairs at `offset` (n, K), the sum of their covariances being `spread`
    (n, n, K): over what both know."""
    count, more = unknown.common(spread)
    return linalg.quadratic(spread, offset), linalg.logdet(spread) + more, count
