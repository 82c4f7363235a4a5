"""What every rule works on and gives back: one block of fusions, batch-last, factorised once."""

from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats
from fusion_service.linalg import condition
from fusion_service.rules.base.matrices import weighted_sum

__all__ = ["Result", "Sources", "alone", "weighted_mean", "weighted_product"]


@dataclass(frozen=True, slots=True)
class Sources:
    """N Gaussians per fusion. float64 on the fast road, longdouble on the safe one."""

    means: Floats  # (n, N, B)
    covariances: Floats  # (n, n, N, B)
    information: Floats  # (n, n, N, B), the inverses
    dets: Floats  # (N, B), of the covariances
    condition: Floats  # (B,), see `condition`
    definite: Bools  # (B,), every covariance is positive definite and of condition < 1e14
    start: Floats | None = None  # (N, B), weights that may do, NaN where there are none: see `ci.from_start`

    @classmethod
    def of(cls, means: Floats, covariances: Floats, start: Floats | None = None) -> Self:
        """From the layout of `fuse_last`: means (N, n, B), covariances (N, n, n, B)."""
        P = covariances.transpose(1, 2, 0, 3)
        A, dets, least = linalg.inverse_det(P)
        worst = np.maximum.reduce(condition(P, A), axis=0)
        definite = (np.minimum.reduce(least, axis=0) > 0.0) & (worst < 1e14)
        if not definite.all():
            P = np.where(definite, P, np.nan)  # stops every iteration at once
            A = np.where(definite, A, np.nan)
        return cls(means.transpose(1, 0, 2), P, A, dets, worst, definite, start)

    def take(self, some: Any) -> Self:
        """Some elements of the batch (a mask or indices)."""
        columns: list[Any] = [getattr(self, one.name) for one in fields(self)]
        taken: list[Any] = [None if column is None else column[..., some] for column in columns]
        return type(self)(*taken)

    def without_start(self) -> Self:
        """The same, to be weighed anew."""
        return replace(self, start=None)

    @property
    def count(self) -> int:
        """N."""
        return int(self.means.shape[1])

    @property
    def fast(self) -> bool:
        """Whether this is the fast road, in float64."""
        return self.covariances.dtype == np.float64

    @property
    def uniform(self) -> Floats:
        """Equal weights (N, B)."""
        return np.full_like(self.means[0], 1.0 / self.count)

    @property
    def spread(self) -> Floats:
        """The means relative to the first source's, so that their size costs no digits."""
        return self.means - self.means[:, :1]


@dataclass(frozen=True, slots=True)
class Result:
    """One block, fused."""

    mean: Floats  # (n, B)
    covariance: Floats  # (n, n, B)
    weights: Floats  # (N, B)
    influence: Floats | None  # (N, B)
    condition: Floats  # (B,): rounding errors of the inputs, as they reach the result
    gap: Floats  # (B,): of the weights, 0 where they are not optimised

    def overwrite(self, at: Any, other: "Result") -> None:
        """Put what `other` has in the place of the elements `at`."""
        for one in fields(self):
            mine = getattr(self, one.name)
            if mine is not None:
                mine[..., at] = getattr(other, one.name)


def alone(sources: Sources, influence: bool) -> Result:
    """One source, as it is."""
    one = np.ones_like(sources.means[0])
    return Result(
        sources.means[:, 0],
        sources.covariances[:, :, 0],
        one,
        one if influence else None,
        sources.condition,
        np.zeros_like(sources.condition),
    )


def weighted_mean(sources: Sources, scale: Floats | None = None) -> Floats:
    """sum_i scale_i P_i^-1 (x_i - x_0), (n, B)."""
    A, x = sources.information, sources.means
    y = np.zeros_like(x[:, 0])
    for i in range(1, sources.count):
        term = linalg.matvec(A[:, :, i], x[:, i] - x[:, 0])
        y += term if scale is None else term * scale[i]
    return y


def weighted_product(sources: Sources, scale: Floats | None) -> tuple[Floats, Floats, Floats]:
    """Mean, covariance and condition of the product of N(x_i, P_i / scale_i): P^-1 = sum scale_i P_i^-1.

    `scale` (N, B), or None for ones.
    """
    M = weighted_sum(sources.information, scale)
    P = linalg.inverse(M)
    mean = linalg.matvec(P, weighted_mean(sources, scale))
    mean += sources.means[:, 0]
    return mean, P, np.maximum(sources.condition, condition(M, P))
