"""The product of Gaussians, from the layout of the faces into it, as loops: what `rules.naive` does, to the bit.

Nothing is kept between but `LANES` fusions, so that memory is gone through once; of a large batch that is most of the
time.
"""

from __future__ import annotations

import numpy as np

from fusion_service.compiled.either import Floats
from fusion_service.compiled.kernels import LANES, invert

__all__ = ["product_of_all"]

MOST = 1e14
"""Condition of a covariance beyond which it counts as none: see `rules.base.block.Sources`."""


def product_of_all(x: Floats, P: Floats, mean: Floats, covariance: Floats, condition: Floats) -> None:
    """Of means x (B, N, n) and covariances P (B, N, n, n): mean (B, n), covariance (B, n, n) and condition (B,) of
    their product; the condition is NaN where a covariance is not positive definite, or not symmetric to the bit."""
    size, N, n = x.shape
    A, Q, M, R = np.zeros((N, n, n, LANES)), np.zeros((n, n, LANES)), np.zeros((n, n, LANES)), np.zeros((n, n, LANES))
    y, det, margin, least = np.zeros((n, LANES)), np.zeros(LANES), np.zeros(LANES), np.zeros(LANES)
    worst, one = np.zeros(LANES), np.zeros(LANES)
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        for i in range(N):
            for b in range(w):
                for r in range(n):
                    for c in range(r + 1):
                        Q[r, c, b] = P[s + b, i, r, c]
            inverse = A[i]
            invert(Q, inverse, det, margin, least)
            _condition(Q, inverse, one, w)
            for b in range(w):
                known = one[b] if least[b] > 0.0 and one[b] < MOST else np.nan
                for r in range(1, n):
                    for c in range(r):
                        if P[s + b, i, r, c] != P[s + b, i, c, r]:
                            known = np.nan
                worst[b] = known if i == 0 or known > worst[b] or known != known else worst[b]
        for r in range(n):
            for c in range(r + 1):
                to, row = M[r, c], A[0, r, c]
                for b in range(w):
                    to[b] = row[b] + 0.0
                for i in range(1, N):
                    row = A[i, r, c]
                    for b in range(w):
                        to[b] += row[b]
        invert(M, R, det, margin, least)
        _summed(A, x[s : s + w], y, one)
        _condition(M, R, one, w)
        for b in range(w):
            known = one[b]
            condition[s + b] = worst[b] if worst[b] > known or worst[b] != worst[b] else known
        for r in range(n):
            for k in range(n):
                row, other = R[r, k], y[k]
                for b in range(w):
                    term = row[b] * other[b]
                    one[b] = term if k == 0 else one[b] + term
            for b in range(w):
                mean[s + b, r] = one[b] + x[s + b, 0, r]
        for b in range(w):
            for r in range(n):
                for c in range(n):
                    covariance[s + b, r, c] = R[r, c, b]


def _condition(P: Floats, A: Floats, out: Floats, w: int) -> None:
    """`linalg.condition` of the first w."""
    for k in range(len(P)):
        row, other = P[k, k], A[k, k]
        for b in range(w):
            value = row[b] * other[b]
            out[b] = value if k == 0 or value > out[b] or value != value else out[b]


def _summed(A: Floats, x: Floats, y: Floats, one: Floats) -> None:
    """`rules.base.block.weighted_mean`: y (n, .) of A (N, n, n, .) and x (w, N, n)."""
    w, N, n = x.shape
    for r in range(n):
        to = y[r]
        to[:] = 0.0
        for i in range(1, N):
            for k in range(n):
                row = A[i, r, k]
                for b in range(w):
                    term = row[b] * (x[b, i, k] - x[b, 0, k])
                    one[b] = term if k == 0 else one[b] + term
            for b in range(w):
                to[b] += one[b]
