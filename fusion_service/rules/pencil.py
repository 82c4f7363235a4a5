"""Two covariances in coordinates where both are diagonal: P_1 = T T', P_2 = T diag(ratio) T'.

By Cholesky's factor of P_1 and cyclic Jacobi rotations, batch-last, in float64 or longdouble. An element that
has converged is turned no more: its bits do not depend on the others.
"""

import numpy as np

from .. import linalg
from ..linalg import FloatArray
from .sources import condition

SWEEPS = 30


def pencil(P1: FloatArray, P2: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """T (n, n, B), its inverse (n, n, B), ratio (n, B) > 0, and what rounding grows by (B,).

    The latter is `sources.condition` of P_2 in the coordinates of P_1's factor: of what is diagonalised.
    """
    L, d = linalg.ldl(P1)
    F = L * np.sqrt(d)
    inverse = lower_inverse(F)
    W = linalg.congruence(inverse, P2)
    ratio, Q = eigen(W)
    grown = condition(W, linalg.product(Q / ratio, Q.swapaxes(0, 1)))
    grown = np.where(ratio.min(axis=0) > 0.0, grown, np.inf)
    return linalg.product(F, Q), linalg.product(Q.swapaxes(0, 1), inverse), ratio, grown


def eigen(A: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues (n, B), in no order, and orthonormal vectors (n, n, B), in columns, of symmetric A."""
    A = np.array(A)
    n = len(A)
    Q = np.zeros_like(A)
    Q[range(n), range(n)] = 1.0
    eps = np.finfo(A.dtype).eps
    floor = np.zeros_like(A[0, 0])
    for k in range(n):
        floor = np.maximum(floor, np.abs(A[k]).max(axis=0))
    floor = eps * eps * floor
    for _ in range(SWEEPS):
        turned = False
        for p in range(n):
            for q in range(p + 1, n):
                turned = _turn(A, Q, p, q, eps, floor) or turned
        if not turned:
            break
    return np.stack([A[k, k] for k in range(n)]), Q


def _turn(A: FloatArray, Q: FloatArray, p: int, q: int, eps: float, floor: FloatArray) -> bool:
    """Rotate p and q so that A[p, q] is zero, where it is not small."""
    b, x, y = A[p, q], A[p, p].copy(), A[q, q].copy()
    busy = np.abs(b) > eps * np.sqrt(np.abs(x * y)) + floor
    if not busy.any():
        return False
    half = 0.5 * (y - x)
    t = np.where(busy, b / (np.abs(half) + np.sqrt(half * half + b * b)), 0.0)
    t = np.where(half < 0.0, -t, t)
    c = 1.0 / np.sqrt(1.0 + t * t)
    s = t * c
    tb = t * b
    columns = c * A[:, p] - s * A[:, q], s * A[:, p] + c * A[:, q]
    A[:, p], A[:, q] = columns
    A[p], A[q] = columns
    A[p, p], A[q, q] = x - tb, y + tb
    A[p, q] = A[q, p] = np.where(busy, 0.0, b)
    Q[:, p], Q[:, q] = c * Q[:, p] - s * Q[:, q], s * Q[:, p] + c * Q[:, q]
    return True


def lower_inverse(F: FloatArray) -> FloatArray:
    """F^-1 (n, n, B) of lower triangular F."""
    out = np.zeros_like(F)
    for i in range(len(F)):
        out[i, i] = 1.0 / F[i, i]
        for k in range(i):
            out[i, : k + 1] -= F[i, k] * out[k, : k + 1]
        if i:
            out[i, :i] *= out[i, i]
    return out
