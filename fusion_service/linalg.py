"""Small symmetric matrices, many at once: the batch is the last axis.

A batch of matrices is `(n, n, B)`, a batch of vectors `(n, B)`. Loops run in Python over the n
indices and in NumPy over the batch, so each operation is a handful of passes over contiguous rows.
Further batch axes are welcome: wherever `B` is written, `(..., B)` works too.

What callers may rely on:

* An element's result is the same, bit for bit, whatever batch surrounds it. Only element-wise ufuncs
  are used: no BLAS, and no reduction over an axis (NumPy orders those by shape).
* A bad element (indefinite, NaN) yields NaN, inf or a meaningless number of its own, and neither warns
  nor raises nor spoils its neighbours. Ask `is_positive_definite`.
* Functions of a symmetric P read its lower triangle only; what they return is exactly symmetric.
* float64 in, float64 out; longdouble in, longdouble out.

The factorisation is P = L D L' without pivoting, which for a positive definite P is stable and
indifferent to the scale of each component (metres beside radians per second): its error is governed by
the condition of the correlation matrix, not of P.
"""

from collections.abc import Iterator

import numpy as np

from fusion_service.arrays import Bools, Floats
from fusion_service.compiled import either
from fusion_service.layout import TURN, blocks, to_first, to_last

__all__ = [
    "TURN",
    "blocks",
    "condition",
    "congruence",
    "det",
    "inner",
    "inverse",
    "inverse_det",
    "is_positive_definite",
    "ldl",
    "logdet",
    "matvec",
    "outer",
    "product",
    "quadratic",
    "solve",
    "sweep",
    "symmetrise",
    "to_first",
    "to_last",
    "total",
    "trace",
    "trace_inverse_det",
]


FEW = 1024
"""Elements of which all rows are compared at once."""


@either
def inverse(P: Floats) -> Floats:
    """P^-1 (n, n, B) of symmetric positive definite P."""
    out = np.empty(P.shape, P.dtype)
    with np.errstate(all="ignore"):
        for p, W, _ in _pieces(P, out):
            _factor(p, W)
            _square(W)
    return out


@either
def sweep(P: Floats) -> tuple[Floats, Floats, Floats]:
    """P^-1 (n, n, B), det P (B,) and margin (B,), in one elimination.

    The margin is the smallest pivot relative to its diagonal entry, NaN or negative for a bad matrix:
    `margin > tolerance` is `is_positive_definite(P, tolerance)`.
    """
    out, det, margin = np.empty(P.shape, P.dtype), np.empty(P.shape[2:], P.dtype), np.empty(P.shape[2:], P.dtype)
    with np.errstate(all="ignore"):
        for p, W, part in _pieces(P, out):
            _factor(p, W, det.reshape(-1)[part])
            relative = 1.0 / (_diagonal(W) * np.abs(_diagonal(p)))
            np.minimum.reduce(relative, axis=0, out=margin.reshape(-1)[part])
            _square(W)
    return out, det, margin


@either
def inverse_det(P: Floats) -> tuple[Floats, Floats, Floats]:
    """P^-1 (n, n, B), det P (B,) and its least reciprocal pivot (B,), which is positive if all pivots are.

    For callers who look at the condition of P, and need no margin.
    """
    out, det, least = np.empty(P.shape, P.dtype), np.empty(P.shape[2:], P.dtype), np.empty(P.shape[2:], P.dtype)
    with np.errstate(all="ignore"):
        for p, W, part in _pieces(P, out):
            _factor(p, W, det.reshape(-1)[part])
            np.minimum.reduce(_diagonal(W), axis=0, out=least.reshape(-1)[part])
            _square(W)
    return out, det, least


def trace_inverse_det(P: Floats) -> tuple[Floats, Floats]:
    """tr P^-1 (B,) and det P (B,)."""
    trace, det = np.empty(P.shape[2:], P.dtype), np.empty(P.shape[2:], P.dtype)
    with np.errstate(all="ignore"):
        for p, W, part in _pieces(P):
            _factor(p, W, det.reshape(-1)[part])
            total = trace.reshape(-1)[part]
            total[...] = W[0, 0]
            for k in range(1, len(P)):
                square = W[0, k] * W[0, k]
                for j in range(1, k):
                    square += W[j, k] * W[j, k]
                square += 1.0
                square *= W[k, k]
                total += square
    return trace, det


def _pieces(P: Floats, out: Floats | None = None) -> Iterator[tuple[Floats, Floats, slice]]:
    """P and `out`, or room for it, with all batch axes made one, in pieces for the cache."""
    n = len(P)
    p = P.reshape(n, n, -1)
    W = None if out is None else out.reshape(n, n, -1)
    for part in blocks(n, p.shape[2], 2):
        piece = p[..., part]
        yield piece, np.empty(piece.shape, P.dtype) if W is None else W[..., part], part


def _diagonal(P: Floats) -> Floats:
    """A view, (n, B), of (n, n, B)."""
    return P.diagonal().T


def _factor(P: Floats, W: Floats, det: Floats | None = None) -> None:
    """1 / d on the diagonal of W and L^-1' above it, of P = L diag(d) L'. Writes det P into `det`.

    Below the diagonal of W the elimination is done.
    """
    n = len(P)
    for k in range(n):
        S = W if k else P
        pivot = S[k, k]
        if det is not None:
            np.multiply(det if k else 1.0, pivot, out=det)
        r = np.divide(1.0, pivot, out=W[k, k])
        if k + 1 < n:
            below = S[k + 1 :, k]
            minus = np.multiply(below, -r, out=W[k, k + 1 :])
            for i in range(1, n - k):
                np.add(S[k + i, k + 1 : k + i + 1], below[:i] * minus[i - 1], out=W[k + i, k + 1 : k + i + 1])
    for i in range(2, n):
        for k in range(1, i):
            W[:k, i] += W[:k, k] * W[k, i]


def _square(W: Floats) -> None:
    """P^-1 = W' D^-1 W from `_factor`, in place, as LAPACK's potri does it."""
    n = len(W)
    for k in range(1, n):
        column = W[:k, k]
        scaled = np.multiply(column, W[k, k], out=W[k, :k])
        for i in range(k):
            W[i, : i + 1] += scaled[i] * column[: i + 1]
    for i in range(1, n):
        W[:i, i] = W[i, :i]


@either
def ldl(P: Floats) -> tuple[Floats, Floats]:
    """Factors of P = L diag(d) L': unit lower triangular L (n, n, B) and pivots d (n, B)."""
    n = P.shape[0]
    L = np.zeros(P.shape, P.dtype)
    d = np.empty(P.shape[1:], P.dtype)
    with np.errstate(all="ignore"):
        A = np.array(P)
        for k in range(n):
            d[k] = A[k, k]
            L[k, k] = 1.0
            L[k + 1 :, k] = A[k + 1 :, k] / d[k]
            for i in range(k + 1, n):
                A[i, k + 1 : i + 1] -= L[i, k] * A[k + 1 : i + 1, k]
    return L, d


@either
def _pivots(P: Floats) -> Floats:
    n = len(P)
    out = np.empty(P.shape[1:], P.dtype)
    for p, A, part in _pieces(P):
        d = out.reshape(n, -1)[:, part]
        for k in range(n):
            S = A if k else p
            d[k] = S[k, k]
            if k + 1 < n:
                below = S[k + 1 :, k]
                minus = below * (-1.0 / d[k])
                for i in range(1, n - k):
                    np.add(S[k + i, k + 1 : k + i + 1], below[:i] * minus[i - 1], out=A[k + i, k + 1 : k + i + 1])
    return out


def det(P: Floats) -> Floats:
    """det P (B,), as the product of the pivots."""
    with np.errstate(all="ignore"):
        d = _pivots(P)
        product: Floats = d[0].copy()
        for k in range(1, len(d)):
            product *= d[k]
    return product


def logdet(P: Floats) -> Floats:
    """log det P (B,); NaN where a pivot is negative, -inf where one is zero."""
    with np.errstate(all="ignore"):
        logs = np.log(_pivots(P))
        total: Floats = logs[0].copy()
        for k in range(1, len(logs)):
            total += logs[k]
    return total


@either
def solve(P: Floats, x: Floats) -> Floats:
    """P^-1 x (n, B) for x (n, B)."""
    n = P.shape[0]
    L, d = ldl(P)
    with np.errstate(all="ignore"):
        y = _forward(L, x)
        y /= d
        for k in range(n - 1, 0, -1):
            y[:k] -= L[k, :k] * y[k]
    return y


@either
def quadratic(P: Floats, x: Floats) -> Floats:
    """x' P^-1 x (B,) for x (n, B): the squared Mahalanobis distance."""
    L, d = ldl(P)
    with np.errstate(all="ignore"):
        y = _forward(L, x)
        y *= y
        y /= d
        total: Floats = y[0].copy()
        for k in range(1, len(y)):
            total += y[k]
    return total


def _forward(L: Floats, x: Floats) -> Floats:
    y = np.array(np.broadcast_to(x, L.shape[1:]), dtype=L.dtype)
    for k in range(len(y) - 1):
        y[k + 1 :] -= L[k + 1 :, k] * y[k]
    return y


def is_positive_definite(P: Floats, tolerance: float = 1e-14) -> Bools:
    """Which P are numerically positive definite, (B,).

    Every pivot must exceed `tolerance` times its diagonal entry, that is, 1 minus the squared multiple
    correlation of a component with those before it must be told from zero. Independent of the units of
    each component. NaN and infinity give False. The symmetry of P is not looked at.
    """
    with np.errstate(all="ignore"):
        d = _pivots(P)
        if d[0].size < FEW:
            diagonal = _diagonal(P) if P.ndim == 3 else P[range(len(d)), range(len(d))]
            fine = d > np.maximum(tolerance * diagonal, 0.0)
            fine &= d < np.inf
            return np.asarray(np.logical_and.reduce(fine))
        good: Bools = np.ones(P.shape[2:], dtype=np.bool_)
        for k in range(len(d)):
            good &= d[k] > tolerance * P[k, k]
            good &= d[k] > 0.0
            good &= np.isfinite(d[k])
    return good


def condition(P: Floats, A: Floats) -> Floats:
    """max_k P_kk A_kk (...) for A = P^-1 (n, n, ...): the largest variance inflation factor.

    Whatever the units of the components, the condition number of the correlation matrix lies between this and n^2
    times this. P^-1 by elimination is the inverse of some P + dP with A + dA within a factor 1 +- n^2 eps condition
    of A as quadratic forms, and such factors pass through sums: it tells how good what is made of inverses is.
    """
    out: Floats = P[0, 0] * A[0, 0]
    for k in range(1, len(P)):
        np.maximum(out, P[k, k] * A[k, k], out=out)
    return out


def symmetrise(P: Floats) -> Floats:
    """(P + P') / 2."""
    out: Floats = 0.5 * (P + P.swapaxes(0, 1))
    return out


@either
def matvec(A: Floats, x: Floats) -> Floats:
    """A x, (m, B): x (n, B), A (m, n, B), or one A (m, n) for the whole batch."""
    if A.ndim == 2:
        A = A.reshape(*A.shape, *(1,) * (x.ndim - 1))
    with np.errstate(all="ignore"):
        out: Floats = A[:, 0] * x[0]
        for k in range(1, A.shape[1]):
            out += A[:, k] * x[k]
    return out


def outer(x: Floats, y: Floats) -> Floats:
    """x y', (m, n, B), for x (m, B) and y (n, B)."""
    out: Floats = x[:, None] * y[None, :]
    return out


@either
def product(A: Floats, B: Floats) -> Floats:
    """A B, (m, n, B), for A (m, k, B) and B (k, n, B)."""
    with np.errstate(all="ignore"):
        out: Floats = A[:, 0, None] * B[None, 0]
        for k in range(1, A.shape[1]):
            out += A[:, k, None] * B[None, k]
    return out


@either
def inner(A: Floats, B: Floats) -> Floats:
    """tr(A B), (B,), for symmetric A and B."""
    with np.errstate(all="ignore"):
        out: Floats = A[0, 0] * B[0, 0]
        for i in range(1, len(A)):
            twice = A[i, 0] * B[i, 0]
            for j in range(1, i):
                twice += A[i, j] * B[i, j]
            out += twice + twice
            out += A[i, i] * B[i, i]
    return out


def trace(A: Floats) -> Floats:
    """tr A, (B,)."""
    out: Floats = A[0, 0].copy()
    for i in range(1, len(A)):
        out += A[i, i]
    return out


def total(a: Floats) -> Floats:
    """Sum over the first axis in its order; `np.sum` chooses the order by the shape of the batch."""
    out: Floats = np.array(a[0])
    for row in a[1:]:
        out += row
    return out


@either
def congruence(F: Floats, P: Floats) -> Floats:
    """F P F' (m, m, B), exactly symmetric: P (n, n, B), F (m, n, B), or one F (m, n) for the whole batch.

    Zeros of a shared F are skipped, so a sparse transition matrix is cheap.
    """
    m, n = F.shape[:2]
    shared = F.ndim == 2
    half = np.zeros((m, *P.shape[1:]), P.dtype)
    out = np.zeros((m, m, *P.shape[2:]), P.dtype)
    with np.errstate(all="ignore"):
        for i in range(m):
            for k in range(n):
                if not (shared and F[i, k] == 0.0):
                    half[i] += F[i, k] * P[k]
        for i in range(m):
            if shared:
                for j in range(i + 1):
                    for k in range(n):
                        if F[j, k] != 0.0:
                            out[i, j] += F[j, k] * half[i, k]
            else:
                for k in range(n):
                    out[i, : i + 1] += F[: i + 1, k] * half[i, k]
            out[:i, i] = out[i, :i]
    return out
