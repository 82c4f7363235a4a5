"""Gaussian mixtures as arrays: one (`Mixture`), or one per track for many tracks at once (`Mixtures`).

    f(x) = sum_c w_c N(x; m_c, P_c)

The sum of the weights is the mass: 1 for a probability density, the expected number for an intensity.
`Mixtures` is batch-last (see `linalg`), padded to the most components with weight 0, and keeps log weights,
so that a product of densities that hardly overlap does not vanish. No element's bits depend on the others.

First-order powers and products follow Li-2nd (49)-(51).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats
from fusion_service.errors import FusionError
from fusion_service.linalg import total

__all__ = [
    "LOG_2PI",
    "DensityError",
    "Mixture",
    "Mixtures",
    "log_gaussian",
    "log_sum",
    "moments",
    "power_product",
]

CONDITION = 1e8
"""Largest variance inflation factor that is inverted in float64."""
LOG_2PI = float(np.log(2.0 * np.pi))


class DensityError(FusionError, ValueError):
    """What is no mixture, or a reduction that cannot be done: one line that says what and why."""


@dataclass(frozen=True, slots=True, init=False)
class Mixture:
    """One Gaussian mixture, checked and copied. Raises DensityError for what is none."""

    weights: Floats
    """(C,), not negative, with a positive sum; that of a density is 1"""
    means: Floats
    """(C, n)"""
    covariances: Floats
    """(C, n, n), symmetric positive definite"""

    def __init__(self, weights: ArrayLike, means: ArrayLike, covariances: ArrayLike) -> None:
        for name, given in (("weights", weights), ("means", means), ("covariances", covariances)):
            try:
                value = np.array(given, dtype=np.float64)
            except (TypeError, ValueError) as error:
                raise DensityError(f"{name} are not an array of numbers: {error}") from None
            if not np.isfinite(value).all():
                raise DensityError(f"{name} are not finite")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        w, x, P = self.weights, self.means, self.covariances
        if w.ndim != 1 or x.ndim != 2 or not x.size or len(w) != len(x) or P.shape != (*x.shape, x.shape[1]):
            raise DensityError(f"weights {w.shape}, means {x.shape}, covariances {P.shape}: expected C, C n, C n n")
        if not ((w >= 0.0).all() and w.sum() > 0.0):
            raise DensityError("weights must not be negative and must have a positive sum")
        scale = np.sqrt(np.abs(np.einsum("cii->ci", P)))
        if (np.abs(P - P.swapaxes(1, 2)) > 1e-9 * scale[:, :, None] * scale[:, None, :]).any():
            raise DensityError("a covariance is not symmetric")
        if not linalg.is_positive_definite(linalg.to_last(P, 2)).all():
            raise DensityError("a covariance is not positive definite")

    @property
    def mass(self) -> float:
        """Sum of the weights."""
        return float(self.weights.sum())

    def log_pdf(self, x: ArrayLike) -> Floats:
        """log f (...) at x (..., n)."""
        points = np.asarray(x, dtype=np.float64)
        flat = linalg.to_last(points, 1)
        return Mixtures.of([self]).log_pdf(flat[..., None])[:, 0].reshape(points.shape[:-1])

    def pdf(self, x: ArrayLike) -> Floats:
        """f (...) at x (..., n)."""
        return np.asarray(np.exp(self.log_pdf(x)))

    def moments(self) -> tuple[Floats, Floats]:
        """Mean (n,) and covariance (n, n) of the normalised density."""
        mean, covariance = Mixtures.of([self]).moments()
        return mean[:, 0], covariance[..., 0]

    def draw(self, size: int, seed: int) -> Floats:
        """Samples (size, n) of the normalised density."""
        rng = np.random.default_rng(seed)
        which = rng.choice(len(self.weights), size=size, p=self.weights / self.mass)
        z = rng.standard_normal((size, self.means.shape[1]))
        out: Floats = self.means[which]
        L = np.linalg.cholesky(self.covariances)
        for c in range(len(L)):
            at = which == c
            out[at] += z[at] @ L[c].T
        return out


@dataclass(frozen=True, slots=True)
class Mixtures:
    """B mixtures of up to C components, batch-last; trusted. Padding has log weight -inf and finite moments."""

    log_weights: Floats
    """(C, B)"""
    means: Floats
    """(n, C, B)"""
    covariances: Floats
    """(n, n, C, B)"""

    @classmethod
    def of(cls, mixtures: Sequence[Mixture]) -> Mixtures:
        """One batch of mixtures of one state dimension; DensityError if they have several, or none is given."""
        if len({m.means.shape[1] for m in mixtures}) != 1:
            raise DensityError("one batch needs mixtures of one state dimension")
        counts = np.array([len(m.weights) for m in mixtures])
        weights, means, P = (
            np.concatenate([getattr(m, name) for m in mixtures]) for name in ("weights", "means", "covariances")
        )
        return cls.from_rows(weights, means, P, counts)

    @classmethod
    def from_rows(cls, weights: Floats, means: Floats, covariances: Floats, counts: NDArray[np.integer]) -> Mixtures:
        """From components in rows (R,), (R, n), (R, n, n), the first counts[0] >= 1 of them the first track's."""
        sizes = np.asarray(counts, dtype=np.intp)
        step = np.arange(sizes.max(initial=1))[:, None]
        rows = np.cumsum(sizes) - sizes + np.minimum(step, sizes - 1)
        with np.errstate(divide="ignore"):
            log_weights = np.where(step < sizes, np.log(weights)[rows], -np.inf)
        return cls(
            log_weights,
            np.ascontiguousarray(means[rows].transpose(2, 0, 1)),
            np.ascontiguousarray(covariances[rows].transpose(2, 3, 0, 1)),
        )

    @classmethod
    def joined(cls, parts: Sequence[Mixtures]) -> Mixtures:
        """One batch of several."""
        C = max(len(p.log_weights) for p in parts)
        wide = []
        for p in parts:
            index = np.minimum(np.arange(C), len(p.log_weights) - 1)
            logs = np.where((np.arange(C) < len(p.log_weights))[:, None], p.log_weights[index], -np.inf)
            wide.append((logs, p.means[:, index], p.covariances[:, :, index]))
        return cls(*(np.concatenate(arrays, axis=-1) for arrays in zip(*wide, strict=True)))

    def rows(self) -> tuple[Floats, Floats, Floats, NDArray[np.uint16]]:
        """The inverse of `from_rows`, padding left out."""
        keep = ~np.isneginf(self.log_weights.T)
        return (
            np.exp(self.log_weights.T[keep]),
            self.means.transpose(2, 1, 0)[keep],
            self.covariances.transpose(3, 2, 0, 1)[keep],
            keep.sum(axis=1).astype(np.uint16),
        )

    def __len__(self) -> int:
        return int(self.log_weights.shape[1])

    def __getitem__(self, index: int) -> Mixture:
        weights, means, covariances, _ = self.take(np.array([index])).rows()
        return Mixture(weights, means, covariances)

    def take(self, index: NDArray[np.integer] | Bools) -> Mixtures:
        """The mixtures at `index`."""
        return Mixtures(self.log_weights[:, index], self.means[..., index], self.covariances[..., index])

    @property
    def weights(self) -> Floats:
        """(C, B)."""
        return np.asarray(np.exp(self.log_weights))

    @property
    def log_mass(self) -> Floats:
        """Log of the sum of the weights (B,)."""
        return log_sum(self.log_weights)

    def scaled(self, log_factor: Floats) -> Mixtures:
        """Every mixture times exp(log_factor (B,))."""
        return Mixtures(self.log_weights + log_factor, self.means, self.covariances)

    def normalised(self) -> Mixtures:
        """Every mixture scaled to mass 1."""
        return self.scaled(-self.log_mass)

    def moments(self) -> tuple[Floats, Floats]:
        """Mean (n, B) and covariance (n, n, B) of the normalised densities."""
        w = np.exp(self.log_weights - self.log_mass)
        first = self.means[:, :1]
        mean = total((w * (self.means - first)).swapaxes(0, 1)) + first[:, 0]
        d = self.means - mean[:, None]
        spread = w * (self.covariances + linalg.outer(d, d))
        return mean, total(np.moveaxis(spread, 2, 0))

    def log_pdf(self, x: Floats) -> Floats:
        """log f (S, B) at x (n, S, B), or at the same points x (n, S, 1) for all."""
        L, d = linalg.ldl(self.covariances)
        parts = [
            self.log_weights[c] + log_gaussian(x - self.means[:, None, c], L[:, :, None, c], d[:, None, c])
            for c in range(len(self.log_weights))
        ]
        return log_sum(np.stack(parts))


def log_sum(logs: Floats) -> Floats:
    """log sum exp over the first axis, in its order; -inf where there is nothing."""
    top = logs.max(axis=0)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(top + np.log(total(np.exp(logs - top))))


def log_gaussian(offset: Floats, L: Floats, d: Floats) -> Floats:
    """log N(offset; 0, L diag(d) L') for offset (n, ...), L (n, n, ...), d (n, ...) of `linalg.ldl`, broadcast."""
    n = len(offset)
    rows: list[Floats] = []
    square: Floats = np.zeros(())
    with np.errstate(all="ignore"):
        for k in range(n):
            row = offset[k]
            for j in range(k):
                row = row - L[k, j] * rows[j]
            rows.append(row)
            square = square + row * row / d[k]
        return -0.5 * (square + total(np.log(d)) + n * LOG_2PI)


def moments(
    means: Floats, covariances: Floats, weights: Floats | None, counts: NDArray[np.uint16] | None
) -> tuple[Floats, Floats]:
    """Mean (T, n) and covariance (T, n, n) of each track's mixture of `counts` (T,) components.

    means (C, n), covariances (C, n, n), weights (C,), which sum to 1 per track up to rounding and are
    normalised here. Without weights or counts every track is one Gaussian and is returned as it is.
    A component that is not finite spoils its own track only.
    """
    if weights is None or counts is None or not len(counts):
        return means, covariances
    sizes = counts.astype(np.intp)
    starts = np.cumsum(sizes) - sizes
    with np.errstate(all="ignore"):
        share = weights / np.repeat(np.add.reduceat(weights, starts), sizes)
        mean = np.add.reduceat(share[:, None] * means, starts)
        offset = means - np.repeat(mean, sizes, axis=0)
        spread = covariances + offset[:, :, None] * offset[:, None, :]
        return mean, np.add.reduceat(share[:, None, None] * spread, starts)


def power_product(sources: Sequence[Mixtures], powers: Floats) -> Mixtures:
    """prod_i f_i^{powers_i}, each power to first order: of a sum the sum of the powers (Li-2nd (49)-(51)).

    powers (N, B), not negative. Components: one for each choice of a component from every source, the last
    source's running fastest. Exact where a power is 1 or a mixture has one component. Between 0 and 1 the first
    order drops the cross terms and is too large, everywhere: (a + b)^w <= a^w + b^w. A power of 0 is the factor 1.
    Log weights are NaN where a matrix is so ill-conditioned (`linalg.condition` above `CONDITION`) that the result
    could be wrong by more than about 1e-6.
    """
    N, n, B = len(sources), len(sources[0].means), len(sources[0])
    sizes = [len(f.log_weights) for f in sources]
    factors = []
    bad = np.zeros(B, dtype=np.bool_)
    with np.errstate(all="ignore"):
        for i, (f, w) in enumerate(zip(sources, powers, strict=True)):
            A, det, _ = linalg.sweep(f.covariances)
            bad = bad | ((_beyond(f.covariances, A) & (f.log_weights > -np.inf)).any(axis=0) & (w > 0.0))
            log_weights = w * (f.log_weights - 0.5 * (np.log(det) + n * LOG_2PI))
            only = np.where(np.arange(len(A[0, 0]))[:, None] == 0, 0.0, -np.inf)
            log_weights = np.where(w > 0.0, np.where(f.log_weights > -np.inf, log_weights, -np.inf), only)
            shape = [1] * i + [sizes[i]] + [1] * (N - 1 - i) + [B]
            factors.append((log_weights.reshape(shape), f.means.reshape(n, *shape), (w * A).reshape(n, n, *shape)))
        first = factors[0][1]
        everything = (*sizes, B)
        log_weights = np.zeros(everything)
        information, y = np.zeros((n, n, *everything)), np.zeros((n, *everything))
        for i, (own, x, A) in enumerate(factors):
            log_weights = log_weights + own
            information += A
            if i:
                y += linalg.matvec(np.broadcast_to(A, information.shape), x - first)
        P, det, _ = linalg.sweep(information)
        bad |= (_beyond(information, P) & (log_weights > -np.inf)).reshape(-1, B).any(axis=0)
        offset = linalg.matvec(P, y)
        log_weights += 0.5 * (n * LOG_2PI - np.log(det))
        for _, x, A in factors:
            d = first + offset - x
            log_weights -= 0.5 * total(d * linalg.matvec(np.broadcast_to(A, information.shape), d))
    log_weights = np.where(bad, np.nan, log_weights)
    return Mixtures(log_weights.reshape(-1, B), (first + offset).reshape(n, -1, B), P.reshape(n, n, -1, B))


def _beyond(P: Floats, A: Floats) -> Bools:
    """Where (...) P with inverse A is beyond `CONDITION`, or no covariance."""
    worst = linalg.condition(P, A)
    return np.asarray(~((worst <= CONDITION) & (worst >= 0.5)))
