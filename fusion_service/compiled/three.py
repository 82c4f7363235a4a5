"""Covariance intersection of three, by det, from weights to begin with, as loops: the additions, multiplications and
divisions of `rules.ci` and `rules.weights.active` in the same order, so the same bits (see `kernels`).

It is element after element: of few fusions, each of which needs another number of steps, there is nothing to share.
"""

from __future__ import annotations

import numpy as np

from fusion_service.compiled.either import Floats

__all__ = ["from_start_of_three"]

WEIGHTS = 3


def from_start_of_three(
    A: Floats, x: Floats, bound: Floats, start: Floats, limits: Floats,
    mean: Floats, covariance: Floats, weights: Floats, share: Floats, condition: Floats, gap: Floats, found: Floats,
) -> None:  # fmt: skip
    """Of the informations A (n, n, 3, B), means x (n, 3, B), condition of the sources `bound` (B,) and weights `start`
    (3, B): mean (n, B), covariance (n, n, B), weights and influences (3, B), condition and gap (B,) of the result.

    limits (5,): gap up to which weights are kept, and to which better ones are sought; number of steps; ridge; size of
    a step that is taken whole. found (B,): 0 where there are no weights to begin with, or better ones are not found
    from there, and nothing else is written.
    """
    n, size = len(x), x.shape[2]
    M, P, D = np.empty((n, n)), np.empty((n, n)), np.empty((n, n, WEIGHTS))
    y, g, w = np.empty(n), np.empty(WEIGHTS), np.empty(WEIGHTS)
    F, H, c, s = np.empty((n, n, WEIGHTS)), np.empty((WEIGHTS, WEIGHTS)), np.empty(WEIGHTS), np.empty(WEIGHTS)
    for b in range(size):
        for i in range(n):
            for j in range(n):
                for k in range(WEIGHTS):
                    D[i, j, k] = A[i, j, k, b]
        for k in range(WEIGHTS):
            w[k] = start[k, b]
        left = _looked_at(D, w, M, P, g)
        good = left <= limits[0]
        if not good:
            total = (w[0] + w[1]) + w[2]
            for k in range(WEIGHTS):
                w[k] = w[k] / total
            if w[0] >= 0.0 and w[1] >= 0.0 and w[2] >= 0.0 and (w[0] + w[1]) + w[2] > 0.5:
                good = _sought(D, w, M, P, g, F, H, c, s, limits)
        found[b] = 1.0 if good else 0.0
        if not good:
            continue
        left = (w[0] * g[0] + w[1] * g[1]) + w[2] * g[2] - min(g[0], g[1], g[2])
        gap[b] = 0.0 if left <= limits[0] else left
        for i in range(n):
            y[i] = 0.0
            for k in range(1, WEIGHTS):
                term = D[i, 0, k] * (x[0, k, b] - x[0, 0, b])
                for j in range(1, n):
                    term += D[i, j, k] * (x[j, k, b] - x[j, 0, b])
                y[i] += term * w[k]
        worst = M[0, 0] * P[0, 0]
        for i in range(n):
            value = P[i, 0] * y[0]
            for j in range(1, n):
                value += P[i, j] * y[j]
            mean[i, b] = value + x[i, 0, b]
            for j in range(n):
                covariance[i, j, b] = P[i, j]
            worst = _larger(worst, M[i, i] * P[i, i])
        condition[b] = _larger(bound[b], worst)
        for k in range(WEIGHTS):
            weights[k, b] = w[k]
            share[k, b] = -g[k] * w[k] / n


def _larger(a: float, b: float) -> float:
    """The larger; what is not a number, if one is."""
    return a if a > b or a != a else b


def _looked_at(D: Floats, w: Floats, M: Floats, P: Floats, g: Floats) -> float:
    """M (n, n), lower triangle, P = M^-1 and the slopes g (3,) of weights w (3,); their gap, not a number where one of
    the slopes is not."""
    n = len(M)
    for i in range(n):
        for j in range(i + 1):
            M[i, j] = (D[i, j, 0] * w[0] + D[i, j, 1] * w[1]) + D[i, j, 2] * w[2]
    _inverted(M, P)
    for k in range(WEIGHTS):
        value = P[0, 0] * D[0, 0, k]
        for i in range(1, n):
            twice = P[i, 0] * D[i, 0, k]
            for j in range(1, i):
                twice += P[i, j] * D[i, j, k]
            value += twice + twice
            value += P[i, i] * D[i, i, k]
        g[k] = -value
    if g[0] != g[0] or g[1] != g[1] or g[2] != g[2]:
        return np.nan
    return float((w[0] * g[0] + w[1] * g[1]) + w[2] * g[2] - min(g[0], g[1], g[2]))


def _inverted(M: Floats, P: Floats) -> None:
    """`kernels.invert` of one matrix."""
    n = len(M)
    for i in range(n):
        for j in range(i + 1):
            P[i, j] = M[i, j]
    for k in range(n):
        P[k, k] = 1.0 / P[k, k]
        for i in range(k + 1, n):
            P[k, i] = P[i, k] * -P[k, k]
        for i in range(k + 1, n):
            for j in range(k + 1, i + 1):
                P[i, j] += P[j, k] * P[k, i]
    for i in range(2, n):
        for k in range(1, i):
            for a in range(k):
                P[a, i] += P[a, k] * P[k, i]
    for k in range(1, n):
        for a in range(k):
            P[k, a] = P[a, k] * P[k, k]
        for i in range(k):
            for j in range(i + 1):
                P[i, j] += P[k, i] * P[j, k]
    for i in range(n):
        for j in range(i):
            P[j, i] = P[i, j]


def _sought(
    D: Floats, w: Floats, M: Floats, P: Floats, g: Floats, F: Floats, H: Floats, c: Floats, s: Floats, limits: Floats
) -> bool:
    """`active._newton` of one: weights w (3,) of a gap that is small enough, with M, P and g of them; whether they are
    found."""
    n = len(M)
    for last in range(int(limits[2]), -1, -1):
        left = _looked_at(D, w, M, P, g)
        if not left > limits[1]:
            return bool(left <= limits[1])
        if last == 0:
            break
        for i in range(n):
            for j in range(n):
                for k in range(WEIGHTS):
                    value = P[i, 0] * D[0, j, k]
                    for a in range(1, n):
                        value += P[i, a] * D[a, j, k]
                    F[i, j, k] = value
        for i in range(WEIGHTS):
            for j in range(i + 1):
                value = F[0, 0, i] * F[0, 0, j]
                for a in range(n):
                    for b in range(n):
                        if a or b:
                            value += F[a, b, i] * F[b, a, j]
                H[i, j] = value
                H[j, i] = value
        for i in range(WEIGHTS):
            H[i, i] *= 1.0 + limits[3]
        for i in range(WEIGHTS):
            c[i] = g[i] - ((H[i, 0] * w[0] + H[i, 1] * w[1]) + H[i, 2] * w[2])
        _least_of_three(H, c, s)
        for i in range(WEIGHTS):
            s[i] = s[i] - w[i]
        square = 0.0
        for i in range(WEIGHTS):
            term = s[i] * ((H[i, 0] * s[0] + H[i, 1] * s[1]) + H[i, 2] * s[2])
            square = term if i == 0 else square + term
        size = np.sqrt(_larger(square, 0.0))
        for i in range(WEIGHTS):
            w[i] = c[i] if size <= limits[4] else w[i] + s[i] / (1.0 + size)
    return False


def _least_of_three(H: Floats, c: Floats, x: Floats) -> None:
    """`active._of_three` of one, into x (3,), and into c (3,) too."""
    far, side = H[0, 0] - H[0, 1], H[0, 0] - H[0, 2]
    p, q, r = (H[1, 1] - H[0, 1]) + far, (H[2, 2] - H[0, 2]) + side, (H[1, 2] - H[0, 2]) + far
    b, d = c[1] - c[0] - far, c[2] - c[0] - side
    low = 0.0
    for edge in range(3):
        t = -b / p if edge == 0 else -d / q if edge == 1 else (b - d + p - r) / (p + q - 2.0 * r)
        t = min(max(t, 0.0), 1.0) if np.isfinite(t) and t != 0.0 else t if t == 0.0 else 0.0
        y = t if edge == 0 else 1.0 - t if edge == 2 else 0.0
        z = 0.0 if edge == 0 else t
        value = y * (b + 0.5 * p * y + r * z) + z * (d + 0.5 * q * z)
        if edge == 0 or value < low:
            low = value
            x[0], x[1], x[2] = 0.0 if edge == 2 else 1.0 - t, y, z
    det = p * q - r * r
    y, z = (r * d - q * b) / det, (r * b - p * d) / det
    one = 1.0 - y - z
    if det > 0.0 and y > 0.0 and z > 0.0 and one > 0.0:
        x[0], x[1], x[2] = one, y, z
    for i in range(WEIGHTS):
        c[i] = x[i]
