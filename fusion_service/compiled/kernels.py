"""What `fusion_service.linalg` does over many matrices, as loops that a compiler makes fast.

Each is the same additions, multiplications and divisions in the same order as its namesake in `linalg`, so it gives the
same bits; nothing may be contracted or put in another order. Written for numba, and plain Python: called as they stand
they compute the same, slowly, which is how they are tested where there is no numba.

The batch is cut into `LANES` elements, so that what is worked on stays in the nearest cache, and every innermost loop
runs over neighbours of rows that are named before it (an index like `s + b` would keep it from being vectorised). A
batch of matrices is (n, n, B), of which the lower triangle is read; results are written into what is given, contiguous.
"""

from __future__ import annotations

import numpy as np

from fusion_service.compiled.either import Floats

__all__ = ["LANES", "congruence", "congruence_each", "inner", "invert", "ldl", "matvec", "pivots", "product", "solve"]

LANES = 64


def invert(P: Floats, out: Floats, det: Floats, margin: Floats, least: Floats) -> None:
    """P^-1 (n, n, B), det P (B,), margin (B,) and least reciprocal pivot (B,): see `linalg.sweep`, `inverse_det`."""
    n, size = P.shape[0], P.shape[2]
    W = np.empty((n, n, LANES))
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        for i in range(n):
            for j in range(i + 1):
                W[i, j, :w] = P[i, j, s : s + w]
        all_of, low, flat = det[s : s + w], least[s : s + w], margin[s : s + w]
        for k in range(n):
            pivot, row = W[k, k], P[k, k, s : s + w]
            for b in range(w):
                all_of[b] = pivot[b] if k == 0 else all_of[b] * pivot[b]
            for b in range(w):
                pivot[b] = 1.0 / pivot[b]
            for b in range(w):
                relative = 1.0 / (pivot[b] * abs(row[b]))
                flat[b] = relative if k == 0 or relative < flat[b] or relative != relative else flat[b]
            for b in range(w):
                low[b] = pivot[b] if k == 0 or pivot[b] < low[b] or pivot[b] != pivot[b] else low[b]
            for i in range(k + 1, n):
                to, row = W[k, i], W[i, k]
                for b in range(w):
                    to[b] = row[b] * -pivot[b]
            for i in range(k + 1, n):
                minus = W[k, i]
                for j in range(k + 1, i + 1):
                    to, row = W[i, j], W[j, k]
                    for b in range(w):
                        to[b] += row[b] * minus[b]
        for i in range(2, n):
            for k in range(1, i):
                factor = W[k, i]
                for a in range(k):
                    to, row = W[a, i], W[a, k]
                    for b in range(w):
                        to[b] += row[b] * factor[b]
        for k in range(1, n):
            pivot = W[k, k]
            for a in range(k):
                to, row = W[k, a], W[a, k]
                for b in range(w):
                    to[b] = row[b] * pivot[b]
            for i in range(k):
                factor = W[k, i]
                for j in range(i + 1):
                    to, row = W[i, j], W[j, k]
                    for b in range(w):
                        to[b] += factor[b] * row[b]
        for i in range(n):
            for j in range(i + 1):
                out[i, j, s : s + w] = W[i, j, :w]
                out[j, i, s : s + w] = W[i, j, :w]


def pivots(P: Floats, d: Floats) -> None:
    """The pivots (n, B) of P."""
    n, size = P.shape[0], P.shape[2]
    W, m = np.empty((n, n, LANES)), np.empty(LANES)
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        for i in range(n):
            for j in range(i + 1):
                W[i, j, :w] = P[i, j, s : s + w]
        for k in range(n):
            pivot = W[k, k]
            d[k, s : s + w] = pivot[:w]
            for i in range(k + 1, n):
                row = W[i, k]
                for b in range(w):
                    m[b] = row[b] * (-1.0 / pivot[b])
                for j in range(k + 1, i + 1):
                    to, row = W[i, j], W[j, k]
                    for b in range(w):
                        to[b] += row[b] * m[b]


def ldl(P: Floats, L: Floats, d: Floats) -> None:
    """L (n, n, B), zeros above the diagonal, and pivots d (n, B), of P = L diag(d) L'."""
    n, size = P.shape[0], P.shape[2]
    W = np.empty((n, n, LANES))
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        for i in range(n):
            for j in range(n):
                W[i, j, :w] = P[i, j, s : s + w]
                L[i, j, s : s + w] = 1.0 if i == j else 0.0
        for k in range(n):
            pivot = W[k, k]
            d[k, s : s + w] = pivot[:w]
            for i in range(k + 1, n):
                to, row = L[i, k, s : s + w], W[i, k]
                for b in range(w):
                    to[b] = row[b] / pivot[b]
            for i in range(k + 1, n):
                factor = L[i, k, s : s + w]
                for j in range(k + 1, i + 1):
                    to, row = W[i, j], W[j, k]
                    for b in range(w):
                        to[b] -= factor[b] * row[b]


def solve(P: Floats, x: Floats, y: Floats, square: Floats, back: bool) -> None:
    """y = P^-1 x (n, B) where `back`; else square = x' P^-1 x (B,)."""
    n, size = P.shape[0], P.shape[2]
    W, L, Y = np.empty((n, n, LANES)), np.empty((n, n, LANES)), np.empty((n, LANES))
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        for i in range(n):
            for j in range(i + 1):
                W[i, j, :w] = P[i, j, s : s + w]
            Y[i, :w] = x[i, s : s + w]
        for k in range(n):
            pivot, known = W[k, k], Y[k]
            for i in range(k + 1, n):
                to, row = L[i, k], W[i, k]
                for b in range(w):
                    to[b] = row[b] / pivot[b]
            for i in range(k + 1, n):
                factor = L[i, k]
                for j in range(k + 1, i + 1):
                    to, row = W[i, j], W[j, k]
                    for b in range(w):
                        to[b] -= factor[b] * row[b]
                to = Y[i]
                for b in range(w):
                    to[b] -= factor[b] * known[b]
        if back:
            for i in range(n):
                to, pivot = Y[i], W[i, i]
                for b in range(w):
                    to[b] /= pivot[b]
            for k in range(n - 1, 0, -1):
                known = Y[k]
                for i in range(k):
                    to, factor = Y[i], L[k, i]
                    for b in range(w):
                        to[b] -= factor[b] * known[b]
            for i in range(n):
                y[i, s : s + w] = Y[i, :w]
        else:
            one = square[s : s + w]
            for i in range(n):
                row, pivot = Y[i], W[i, i]
                if i == 0:
                    for b in range(w):
                        one[b] = row[b] * row[b] / pivot[b]
                else:
                    for b in range(w):
                        one[b] += row[b] * row[b] / pivot[b]


def matvec(A: Floats, x: Floats, out: Floats) -> None:
    """A x (m, B) of A (m, n, B) and x (n, B)."""
    m, n, size = A.shape
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        for i in range(m):
            to = out[i, s : s + w]
            for k in range(n):
                row, factor = A[i, k, s : s + w], x[k, s : s + w]
                if k == 0:
                    for b in range(w):
                        to[b] = row[b] * factor[b]
                else:
                    for b in range(w):
                        to[b] += row[b] * factor[b]


def product(A: Floats, B: Floats, out: Floats) -> None:
    """A B (m, n, B) of A (m, k, B) and B (k, n, B)."""
    m, inside, size = A.shape
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        for i in range(m):
            for j in range(B.shape[1]):
                to = out[i, j, s : s + w]
                for k in range(inside):
                    row, factor = A[i, k, s : s + w], B[k, j, s : s + w]
                    if k == 0:
                        for b in range(w):
                            to[b] = row[b] * factor[b]
                    else:
                        for b in range(w):
                            to[b] += row[b] * factor[b]


def inner(A: Floats, B: Floats, out: Floats) -> None:
    """tr(A B) (B,) of symmetric A and B (n, n, B)."""
    n, size = A.shape[0], A.shape[2]
    twice = np.empty(LANES)
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        to = out[s : s + w]
        for i in range(n):
            for j in range(i):
                row, other = A[i, j, s : s + w], B[i, j, s : s + w]
                if j == 0:
                    for b in range(w):
                        twice[b] = row[b] * other[b]
                else:
                    for b in range(w):
                        twice[b] += row[b] * other[b]
            row, other = A[i, i, s : s + w], B[i, i, s : s + w]
            if i == 0:
                for b in range(w):
                    to[b] = row[b] * other[b]
            else:
                for b in range(w):
                    to[b] += twice[b] + twice[b]
                for b in range(w):
                    to[b] += row[b] * other[b]


def congruence(F: Floats, P: Floats, out: Floats) -> None:
    """F P F' (m, m, B) of one F (m, n), whose zeros are skipped, and P (n, n, B)."""
    m, n = F.shape
    size = P.shape[2]
    half = np.empty((m, n, LANES))
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        half[:] = 0.0
        for i in range(m):
            for k in range(n):
                factor = F[i, k]
                if factor != 0.0:
                    for j in range(n):
                        to, row = half[i, j], P[k, j, s : s + w]
                        for b in range(w):
                            to[b] += factor * row[b]
        for i in range(m):
            for j in range(i + 1):
                one, other = out[i, j, s : s + w], out[j, i, s : s + w]
                one[:] = 0.0
                for k in range(n):
                    factor = F[j, k]
                    if factor != 0.0:
                        row = half[i, k]
                        for b in range(w):
                            one[b] += factor * row[b]
                other[:] = one


def congruence_each(F: Floats, P: Floats, out: Floats) -> None:
    """F P F' (m, m, B) of F (m, n, B) and P (n, n, B)."""
    m, n, size = F.shape
    half = np.empty((m, n, LANES))
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        half[:] = 0.0
        for i in range(m):
            for k in range(n):
                each = F[i, k, s : s + w]
                for j in range(n):
                    to, row = half[i, j], P[k, j, s : s + w]
                    for b in range(w):
                        to[b] += each[b] * row[b]
        for i in range(m):
            for j in range(i + 1):
                one, other = out[i, j, s : s + w], out[j, i, s : s + w]
                one[:] = 0.0
                for k in range(n):
                    each, row = F[j, k, s : s + w], half[i, k]
                    for b in range(w):
                        one[b] += each[b] * row[b]
                other[:] = one
