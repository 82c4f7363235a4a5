"""What `fusion_service.linalg` does over many matrices, as loops that a compiler makes fast.

Each is the same additions, multiplications and divisions in the same order as its namesake in `linalg`, so it gives the
same bits; nothing may be contracted or put in another order. Written for numba, and plain Python: called as they stand
they compute the same, slowly, which is how they are tested where there is no numba.

The batch is cut into `LANES` elements, so that what is worked on stays in the nearest cache and every innermost loop
runs over neighbours. A batch of matrices is (n, n, B), of which the lower triangle is read; results are written into
what is given, contiguous.
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
                for b in range(w):
                    W[i, j, b] = P[i, j, s + b]
        for b in range(w):
            det[s + b] = 1.0
        for k in range(n):
            for b in range(w):
                det[s + b] *= W[k, k, b]
            for b in range(w):
                W[k, k, b] = 1.0 / W[k, k, b]
            for i in range(k + 1, n):
                for b in range(w):
                    W[k, i, b] = W[i, k, b] * -W[k, k, b]
            for i in range(k + 1, n):
                for j in range(k + 1, i + 1):
                    for b in range(w):
                        W[i, j, b] += W[j, k, b] * W[k, i, b]
        for k in range(n):
            for b in range(w):
                pivot, relative = W[k, k, b], 1.0 / (W[k, k, b] * abs(P[k, k, s + b]))
                if k == 0 or relative < margin[s + b] or relative != relative:
                    margin[s + b] = relative
                if k == 0 or pivot < least[s + b] or pivot != pivot:
                    least[s + b] = pivot
        for i in range(2, n):
            for k in range(1, i):
                for a in range(k):
                    for b in range(w):
                        W[a, i, b] += W[a, k, b] * W[k, i, b]
        for k in range(1, n):
            for a in range(k):
                for b in range(w):
                    W[k, a, b] = W[a, k, b] * W[k, k, b]
            for i in range(k):
                for j in range(i + 1):
                    for b in range(w):
                        W[i, j, b] += W[k, i, b] * W[j, k, b]
        for i in range(n):
            for j in range(i + 1):
                for b in range(w):
                    out[i, j, s + b] = W[i, j, b]
                    out[j, i, s + b] = W[i, j, b]


def pivots(P: Floats, d: Floats) -> None:
    """The pivots (n, B) of P."""
    n, size = P.shape[0], P.shape[2]
    W, m = np.empty((n, n, LANES)), np.empty(LANES)
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        for i in range(n):
            for j in range(i + 1):
                for b in range(w):
                    W[i, j, b] = P[i, j, s + b]
        for k in range(n):
            for b in range(w):
                d[k, s + b] = W[k, k, b]
            for i in range(k + 1, n):
                for b in range(w):
                    m[b] = W[i, k, b] * (-1.0 / W[k, k, b])
                for j in range(k + 1, i + 1):
                    for b in range(w):
                        W[i, j, b] += W[j, k, b] * m[b]


def ldl(P: Floats, L: Floats, d: Floats) -> None:
    """L (n, n, B), zeros above the diagonal, and pivots d (n, B), of P = L diag(d) L'."""
    n, size = P.shape[0], P.shape[2]
    W = np.empty((n, n, LANES))
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        for i in range(n):
            for j in range(i + 1):
                for b in range(w):
                    W[i, j, b] = P[i, j, s + b]
        for k in range(n):
            for b in range(w):
                d[k, s + b] = W[k, k, b]
            for i in range(n):
                for b in range(w):
                    L[i, k, s + b] = 1.0 if i == k else 0.0
            for i in range(k + 1, n):
                for b in range(w):
                    L[i, k, s + b] = W[i, k, b] / W[k, k, b]
            for i in range(k + 1, n):
                for j in range(k + 1, i + 1):
                    for b in range(w):
                        W[i, j, b] -= L[i, k, s + b] * W[j, k, b]


def solve(P: Floats, x: Floats, y: Floats, square: Floats, back: bool) -> None:
    """y = P^-1 x (n, B) where `back`; else square = x' P^-1 x (B,)."""
    n, size = P.shape[0], P.shape[2]
    W, L, Y = np.empty((n, n, LANES)), np.empty((n, n, LANES)), np.empty((n, LANES))
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        for i in range(n):
            for j in range(i + 1):
                for b in range(w):
                    W[i, j, b] = P[i, j, s + b]
            for b in range(w):
                Y[i, b] = x[i, s + b]
        for k in range(n):
            for i in range(k + 1, n):
                for b in range(w):
                    L[i, k, b] = W[i, k, b] / W[k, k, b]
            for i in range(k + 1, n):
                for j in range(k + 1, i + 1):
                    for b in range(w):
                        W[i, j, b] -= L[i, k, b] * W[j, k, b]
                for b in range(w):
                    Y[i, b] -= L[i, k, b] * Y[k, b]
        if back:
            for i in range(n):
                for b in range(w):
                    Y[i, b] /= W[i, i, b]
            for k in range(n - 1, 0, -1):
                for i in range(k):
                    for b in range(w):
                        Y[i, b] -= L[k, i, b] * Y[k, b]
            for i in range(n):
                for b in range(w):
                    y[i, s + b] = Y[i, b]
        else:
            for b in range(w):
                square[s + b] = Y[0, b] * Y[0, b] / W[0, 0, b]
            for i in range(1, n):
                for b in range(w):
                    square[s + b] += Y[i, b] * Y[i, b] / W[i, i, b]


def matvec(A: Floats, x: Floats, out: Floats) -> None:
    """A x (m, B) of A (m, n, B) and x (n, B)."""
    m, n, size = A.shape
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        for i in range(m):
            for b in range(w):
                out[i, s + b] = A[i, 0, s + b] * x[0, s + b]
            for k in range(1, n):
                for b in range(w):
                    out[i, s + b] += A[i, k, s + b] * x[k, s + b]


def product(A: Floats, B: Floats, out: Floats) -> None:
    """A B (m, n, B) of A (m, k, B) and B (k, n, B)."""
    m, inside, size = A.shape
    n = B.shape[1]
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        for i in range(m):
            for j in range(n):
                for b in range(w):
                    out[i, j, s + b] = A[i, 0, s + b] * B[0, j, s + b]
                for k in range(1, inside):
                    for b in range(w):
                        out[i, j, s + b] += A[i, k, s + b] * B[k, j, s + b]


def inner(A: Floats, B: Floats, out: Floats) -> None:
    """tr(A B) (B,) of symmetric A and B (n, n, B)."""
    n, size = A.shape[0], A.shape[2]
    twice = np.empty(LANES)
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        for b in range(w):
            out[s + b] = A[0, 0, s + b] * B[0, 0, s + b]
        for i in range(1, n):
            for b in range(w):
                twice[b] = A[i, 0, s + b] * B[i, 0, s + b]
            for j in range(1, i):
                for b in range(w):
                    twice[b] += A[i, j, s + b] * B[i, j, s + b]
            for b in range(w):
                out[s + b] += twice[b] + twice[b]
            for b in range(w):
                out[s + b] += A[i, i, s + b] * B[i, i, s + b]


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
                if F[i, k] != 0.0:
                    for j in range(n):
                        for b in range(w):
                            half[i, j, b] += F[i, k] * P[k, j, s + b]
        for i in range(m):
            for j in range(i + 1):
                for b in range(w):
                    out[i, j, s + b] = 0.0
                for k in range(n):
                    if F[j, k] != 0.0:
                        for b in range(w):
                            out[i, j, s + b] += F[j, k] * half[i, k, b]
                for b in range(w):
                    out[j, i, s + b] = out[i, j, s + b]


def congruence_each(F: Floats, P: Floats, out: Floats) -> None:
    """F P F' (m, m, B) of F (m, n, B) and P (n, n, B)."""
    m, n, size = F.shape
    half = np.empty((m, n, LANES))
    for s in range(0, size, LANES):
        w = min(LANES, size - s)
        half[:] = 0.0
        for i in range(m):
            for k in range(n):
                for j in range(n):
                    for b in range(w):
                        half[i, j, b] += F[i, k, s + b] * P[k, j, s + b]
        for i in range(m):
            for j in range(i + 1):
                for b in range(w):
                    out[i, j, s + b] = 0.0
                for k in range(n):
                    for b in range(w):
                        out[i, j, s + b] += F[j, k, s + b] * half[i, k, b]
                for b in range(w):
                    out[j, i, s + b] = out[i, j, s + b]
