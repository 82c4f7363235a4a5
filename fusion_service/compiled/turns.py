"""Jacobi's rotations of many symmetric matrices, as loops: what `rules.weights.pencil` does in NumPy, to the bit."""

from __future__ import annotations

import numpy as np

from fusion_service.compiled.either import Floats
from fusion_service.compiled.kernels import LANES

__all__ = ["jacobi"]


def jacobi(floor: Floats, limits: Floats, X: Floats) -> None:
    """Turn X (m, n, B), of which the first n rows are symmetric matrices, until these are diagonal; the other rows are
    turned along. Where the square of an entry is not above limits[0] times the product of its diagonal entries and
    floor (B,) it is left; limits[1] sweeps at most."""
    m, n, size = X.shape
    small, most = limits[0], int(limits[1])
    old = np.empty((4, LANES))
    rate, cosine, sine, busy = np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES)
    W = np.empty((m, n, LANES))
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        least = floor[s : s + w]
        for i in range(m):
            for j in range(n):
                W[i, j, :w] = X[i, j, s : s + w]
        for _ in range(most):
            turned = False
            for p in range(n):
                for q in range(p + 1, n):
                    entry, x, y, square = old[0], old[1], old[2], old[3]
                    entry[:w], x[:w], y[:w] = W[p, q, :w], W[p, p, :w], W[q, q, :w]
                    some = 0
                    for b in range(w):
                        square[b] = entry[b] * entry[b]
                        busy[b] = 1.0 if square[b] > small * abs(x[b] * y[b]) + least[b] else 0.0
                        some += busy[b] > 0.0
                    if some == 0:
                        continue
                    turned = True
                    for b in range(w):
                        half = 0.5 * (y[b] - x[b])
                        away = half + np.copysign(np.sqrt(half * half + square[b]), half)
                        t = entry[b] / away if busy[b] > 0.0 else 0.0
                        rate[b] = t
                        cosine[b] = 1.0 / np.sqrt(1.0 + t * t)
                        sine[b] = t * cosine[b]
                    for i in range(m):
                        one, other = W[i, p], W[i, q]
                        for b in range(w):
                            first, second = one[b], other[b]
                            one[b] = cosine[b] * first - sine[b] * second
                            other[b] = sine[b] * first + cosine[b] * second
                    for i in range(n):
                        W[p, i, :w] = W[i, p, :w]
                        W[q, i, :w] = W[i, q, :w]
                    one, other, cross, again = W[p, p], W[q, q], W[p, q], W[q, p]
                    for b in range(w):
                        change = rate[b] * entry[b]
                        one[b] = x[b] - change
                        other[b] = y[b] + change
                        cross[b] = 0.0 if busy[b] > 0.0 else entry[b]
                        again[b] = cross[b]
            if not turned:
                break
        for i in range(m):
            for j in range(n):
                to, row = X[i, j, s : s + w], W[i, j]
                for b in range(w):
                    to[b] = row[b] + 0.0
