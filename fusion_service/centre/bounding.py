"""What stands for a covariance union that rounding does not let be found: larger, but above all that it is to be above.

With x the mean of the means and U_i = P_i + (x - x_i)(x - x_i)', each of the U_i is at most their sum, since all are
positive semidefinite. Where the sum is singular to working precision, n times its diagonal is above it, and is not.
"""

from __future__ import annotations

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats

__all__ = ["union_bound"]


def union_bound(means: Floats, covariances: Floats) -> tuple[Floats, Floats]:
    """Mean (n, B) and covariance (n, n, B) above the U_i of k sources (k, n, B), (k, n, n, B)."""
    k, n = means.shape[:2]
    spread = means - means[0]
    x = spread[0].copy()
    for one in spread[1:]:
        x += one
    x /= k
    total = np.zeros_like(covariances[0])
    for one, covariance in zip(spread, covariances, strict=True):
        total += covariance + linalg.outer(x - one, x - one)
    flat = ~linalg.is_positive_definite(total)
    if flat.any():
        diagonal = range(n)
        wide = np.zeros_like(total)
        wide[diagonal, diagonal] = n * total[diagonal, diagonal]
        total = np.where(flat, wide, total)
    return means[0] + x, total
