"""Moments of densities by importance sampling from Gaussians, for many at once, seeded.

Batch-last. No element's bits depend on the others: all use the same normal draws, and sums over samples are by halves.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats

__all__ = ["draws", "halved_sum", "sampled_moments"]


def draws(n: int, samples: int, seed: int) -> Floats:
    """About `samples` seeded standard normal vectors (n, S), S even, in pairs z and -z, with exactly unit covariance.

    So the mean and the covariance of a Gaussian come out exactly, and the error of other moments is smaller.
    """
    half = np.random.default_rng(seed).standard_normal((n, max(samples // 2, n + 1)))
    L = np.linalg.cholesky(half @ half.T / half.shape[1])
    z = np.linalg.solve(L, half)
    return np.concatenate([z, -z], axis=1)


def sampled_moments(
    means: Floats, covariances: Floats, log_ratio: Callable[[Floats], Floats], z: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Log mass (B,), mean (n, B) and covariance (n, n, B) of exp(log_ratio(x)) N(x; means, covariances).

    And the number of effective samples (B,). Importance sampling from the Gaussians (n, B), (n, n, B) themselves at
    the `draws` z (n, S), self-normalised (Sharma (59), (60)); log_ratio takes x (n, S, B) and returns (S, B). Unbiased
    where the ratio is bounded, up to the 1/S of a ratio of averages.
    """
    n, S = z.shape
    L, d = linalg.ldl(covariances)
    step = linalg.matvec(L[:, :, None], z[..., None] * np.sqrt(d)[:, None])
    logs = log_ratio(means[:, None] + step)
    top = logs.max(axis=0)
    w = np.exp(logs - np.where(np.isfinite(top), top, 0.0))
    mass = halved_sum(w)
    with np.errstate(all="ignore"):
        mean = np.stack([halved_sum(w * row) / mass for row in step])
        covariance = np.empty_like(covariances)
        for i in range(n):
            weighted = w * (step[i] - mean[i])
            for j in range(i + 1):
                covariance[i, j] = covariance[j, i] = halved_sum(weighted * (step[j] - mean[j])) / mass
        return top + np.log(mass / S), means + mean, covariance, mass * mass / halved_sum(w * w)


def halved_sum(a: Floats) -> Floats:
    """Sum over the first axis by halves, in an order that does not depend on the batch."""
    while len(a) > 1:
        odd, half = len(a) % 2, len(a) // 2
        b = a[:half] + a[half : 2 * half]
        if odd:
            b[0] += a[-1]
        a = b
    out: Floats = a[0]
    return out
