"""What every rule works on and gives back: one block of fusions, batch-last, factorised once."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.linalg import FloatArray


@dataclass(frozen=True, slots=True)
class Sources:
    """N Gaussians per fusion. float64 on the fast road, longdouble on the safe one."""

    means: FloatArray  # (n, N, B)
    covariances: FloatArray  # (n, n, N, B)
    information: FloatArray  # (n, n, N, B), the inverses
    dets: FloatArray  # (N, B), of the covariances
    condition: FloatArray  # (B,), see `condition`
    definite: NDArray[np.bool_]  # (B,), every covariance is positive definite and of condition < 1e14

    @classmethod
    def of(cls, means: FloatArray, covariances: FloatArray) -> Self:
        """From the layout of `fuse_last`: means (N, n, B), covariances (N, n, n, B)."""
        P = covariances.transpose(1, 2, 0, 3)
        A, dets, least = linalg.inverse_det(P)
        worst = np.maximum.reduce(condition(P, A), axis=0)
        definite = (np.minimum.reduce(least, axis=0) > 0.0) & (worst < 1e14)
        if not definite.all():
            P = np.where(definite, P, np.nan)  # stops every iteration at once
            A = np.where(definite, A, np.nan)
        return cls(means.transpose(1, 0, 2), P, A, dets, worst, definite)

    @property
    def count(self) -> int:
        return int(self.means.shape[1])

    @property
    def fast(self) -> bool:
        return self.covariances.dtype == np.float64

    @property
    def uniform(self) -> FloatArray:
        """Equal weights (N, B)."""
        return np.full_like(self.means[0], 1.0 / self.count)

    @property
    def spread(self) -> FloatArray:
        """The means relative to the first source's, so that their size costs no digits."""
        return self.means - self.means[:, :1]


@dataclass(frozen=True, slots=True)
class Result:
    """One block, fused."""

    mean: FloatArray  # (n, B)
    covariance: FloatArray  # (n, n, B)
    weights: FloatArray  # (N, B)
    influence: FloatArray | None  # (N, B)
    condition: FloatArray  # (B,): rounding errors of the inputs, as they reach the result
    gap: FloatArray  # (B,): of the weights, 0 where they are not optimised


def condition(P: FloatArray, A: FloatArray) -> FloatArray:
    """max_k P_kk A_kk for A = P^-1: the largest variance inflation factor.

    Whatever the units of the components, the condition number of the correlation matrix lies between this
    and n^2 times this, and an inverse computed by elimination is the exact inverse of some P + dP with
    A + dA within a factor 1 +- n^2 eps condition of A, as quadratic forms. Such factors pass through
    sums, so the condition of the matrices inverted on the way tells how good a fused result is.
    """
    out: FloatArray = P[0, 0] * A[0, 0]
    for k in range(1, len(P)):
        np.maximum(out, P[k, k] * A[k, k], out=out)
    return out


def weighted_sum(A: FloatArray, scale: FloatArray | None = None) -> FloatArray:
    """sum_i scale_i A_i (n, n, B) of A (n, n, N, B): the lower triangle, which is all that is read of it."""
    M = np.empty_like(A[:, :, 0])
    for k in range(len(M)):
        terms = A[k, : k + 1] if scale is None else A[k, : k + 1] * scale
        np.add(terms[:, 0], terms[:, 1] if A.shape[2] > 1 else 0.0, out=M[k, : k + 1])
        for i in range(2, A.shape[2]):
            M[k, : k + 1] += terms[:, i]
    return M


def weighted_mean(sources: Sources, scale: FloatArray | None = None) -> FloatArray:
    """sum_i scale_i P_i^-1 (x_i - x_0), (n, B)."""
    A, x = sources.information, sources.means
    y = np.zeros_like(x[:, 0])
    for i in range(1, sources.count):
        term = linalg.matvec(A[:, :, i], x[:, i] - x[:, 0])
        y += term if scale is None else term * scale[i]
    return y


def weighted_product(sources: Sources, scale: FloatArray | None) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean, covariance and condition of the product of N(x_i, P_i / scale_i): P^-1 = sum scale_i P_i^-1.

    `scale` (N, B), or None for ones.
    """
    M = weighted_sum(sources.information, scale)
    P = linalg.inverse(M)
    mean = linalg.matvec(P, weighted_mean(sources, scale))
    mean += sources.means[:, 0]
    return mean, P, np.maximum(sources.condition, condition(M, P))
