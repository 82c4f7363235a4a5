"""Equal-weight covariance intersection of the rows of groups, and of all but each of them, as loops: the additions,
multiplications and divisions of `centre.consensus` in the same order, so the same bits (see `kernels`).
"""

from __future__ import annotations

import numpy as np

from fusion_service.compiled.either import Floats, Places
from fusion_service.compiled.kernels import LANES, invert

__all__ = ["intersect"]


def intersect(
    x: Floats, P: Floats, rows: Places,
    mean: Floats, covariance: Floats, margin: Floats, others_mean: Floats, others: Floats, others_margin: Floats,
) -> None:  # fmt: skip
    """Of rows x (n, M), P (n, n, M) in groups `rows` (G, k), k >= 2: mean (n, G) and covariance (n, n, G) of each; for
    each row (n, M), (n, n, M) of the others of its group.

    margin (G,), others_margin (M,): the least pivot, relative to its variance, of what was inverted for it; NaN where
    the result is not finite.
    """
    n, (size, k) = len(x), rows.shape
    Y, R = np.zeros((k, n, n, LANES)), np.zeros((k, n, n, LANES))
    y, r = np.zeros((k, n, LANES)), np.zeros((k, n, LANES))
    least, m, V = np.empty(LANES), np.empty(LANES), np.zeros((n, n, LANES))
    L, l, S, t = np.zeros((n, n, LANES)), np.zeros((n, LANES)), np.zeros((n, n, LANES)), np.zeros((n, LANES))
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        for j in range(k):
            _turned(x, P, rows[s : s + w, j], Y[j], y[j], V, m)
            _lowered(least, m, j == 0)
        if k > 2:
            R[k - 2], r[k - 2] = Y[k - 1], y[k - 1]
            for j in range(k - 2, 0, -1):
                _sum(R[j], r[j], Y[j], y[j], R[j - 1], r[j - 1])
        for j in range(k):
            at = rows[s : s + w, j]
            if k == 2:
                _copied(x, P, rows[s : s + w, 1 - j], at, others_mean, others, others_margin)
            else:
                if j == 0:
                    S[:], t[:] = R[0], r[0]
                elif j == k - 1:
                    S[:], t[:] = L, l
                else:
                    _sum(L, l, R[j], r[j], S, t)
                _solved(S, t, least, float(k - 1), at, V, m, others_mean, others, others_margin)
            if j == 0:
                L[:], l[:] = Y[0], y[0]
            else:
                _sum(L, l, Y[j], y[j], L, l)
        _solved(L, l, least, float(k), np.arange(s, s + w), V, m, mean, covariance, margin)


def _turned(x: Floats, P: Floats, at: Places, Y: Floats, y: Floats, V: Floats, m: Floats) -> None:
    """Information Y (n, n, LANES) and vector y (n, LANES) of some rows, and the margin m (LANES,) of the inversion."""
    n, w = len(x), len(at)
    for i in range(n):
        for j in range(i + 1):
            to, row = V[i, j], P[i, j]
            for b in range(w):
                to[b] = row[at[b]]
    invert(V, Y, np.empty(LANES), m, np.empty(LANES))
    for i in range(n):
        to = y[i]
        for j in range(n):
            factor, row = Y[i, j], x[j]
            if j == 0:
                for b in range(w):
                    to[b] = factor[b] * row[at[b]]
            else:
                for b in range(w):
                    to[b] += factor[b] * row[at[b]]


def _lowered(least: Floats, m: Floats, first: bool) -> None:
    for b in range(LANES):
        least[b] = m[b] if first or m[b] < least[b] or m[b] != m[b] else least[b]


def _sum(A: Floats, a: Floats, B: Floats, b: Floats, to: Floats, vector: Floats) -> None:
    n = len(a)
    for i in range(n):
        row, one, other = vector[i], a[i], b[i]
        for c in range(LANES):
            row[c] = one[c] + other[c]
        for j in range(n):
            row, one, other = to[i, j], A[i, j], B[i, j]
            for c in range(LANES):
                row[c] = one[c] + other[c]


def _copied(x: Floats, P: Floats, of: Places, at: Places, mean: Floats, covariance: Floats, margin: Floats) -> None:
    n = len(x)
    for b in range(len(at)):
        margin[at[b]] = 1.0
    for i in range(n):
        for b in range(len(at)):
            mean[i, at[b]] = x[i, of[b]]
        for j in range(n):
            for b in range(len(at)):
                covariance[i, j, at[b]] = P[i, j, of[b]]


def _solved(
    S: Floats, t: Floats, least: Floats, count: float, at: Places, V: Floats, m: Floats,
    mean: Floats, covariance: Floats, margin: Floats,
) -> None:  # fmt: skip
    """S^-1 t and count S^-1 into the places `at` (w,), and the margin of it."""
    n, w = len(t), len(at)
    invert(S, V, np.empty(LANES), m, np.empty(LANES))
    for b in range(w):
        margin[at[b]] = least[b] if least[b] < m[b] or least[b] != least[b] else m[b]
    for i in range(n):
        for b in range(w):
            value = V[i, 0, b] * t[0, b]
            for j in range(1, n):
                value += V[i, j, b] * t[j, b]
            mean[i, at[b]] = value
            if not np.isfinite(value):
                margin[at[b]] = np.nan
        for j in range(n):
            for b in range(w):
                value = V[i, j, b] * count
                covariance[i, j, at[b]] = value
                if not np.isfinite(value):
                    margin[at[b]] = np.nan
