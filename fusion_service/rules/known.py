"""Fusion of two sources whose cross-covariance is known (Bar-Shalom and Campo 1986).

With J the joint covariance of both errors, [P_1, P_12; P_12', P_2], and H = [I; I]:

    P^-1 = H' J^-1 H,    x = P H' J^-1 [x_1; x_2]

which is x = x_1 + (P_1 - P_12)(P_1 + P_2 - P_12 - P_12')^-1 (x_2 - x_1): the best linear unbiased estimate.
"""

import numpy as np

from fusion_service import linalg
from fusion_service.linalg import FloatArray
from fusion_service.rules.sources import Result, Sources, condition


def bar_shalom_campo(
    sources: Sources, weights: FloatArray | None, influence: bool, *, cross_covariance: FloatArray
) -> Result:
    """`cross_covariance` (n, n, B) is E[e_1 e_2']. A joint covariance that is not positive definite is refused."""
    n = len(sources.means)
    J = np.empty((2 * n, 2 * n, *sources.means.shape[2:]), sources.means.dtype)
    J[:n, :n], J[n:, n:] = sources.covariances[:, :, 0], sources.covariances[:, :, 1]
    J[:n, n:], J[n:, :n] = cross_covariance, cross_covariance.swapaxes(0, 1)
    inverse, _, margin = linalg.sweep(J)
    worst = np.where(margin > 1e-14, condition(J, inverse), np.inf)
    first = inverse[:n, :n] + inverse[n:, :n]
    second = inverse[:n, n:] + inverse[n:, n:]
    M = first + second
    P = linalg.inverse(M)
    gain = linalg.product(P, second)
    mean = sources.means[:, 0] + linalg.matvec(gain, sources.spread[:, 1])
    share = None
    if influence:
        second_share = linalg.trace(gain) / n
        share = np.stack([1.0 - second_share, second_share])
    nan = np.full_like(sources.means[0], np.nan)
    return Result(
        mean, P, nan, share, np.maximum(np.maximum(sources.condition, worst), condition(M, P)), np.zeros_like(worst)
    )
