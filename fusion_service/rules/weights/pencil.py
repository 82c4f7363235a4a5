"""Two covariances in coordinates where both are diagonal: P_1 = T T', P_2 = T diag(ratio) T'.

By Cholesky's factor of P_1 and cyclic Jacobi rotations, batch-last, in float64 or longdouble. An element that
has converged is turned no more: its bits do not depend on the others.
"""

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.compiled import either
from fusion_service.compiled.small import SWEEPS
from fusion_service.linalg import condition
from fusion_service.rules.base.matrices import lower_inverse

__all__ = ["eigen", "jacobi", "pencil"]


def pencil(P1: Floats, P2: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """T (n, n, B), its inverse (n, n, B), ratio (n, B) > 0, and what rounding grows by (B,).

    The latter is `linalg.condition` of P_2 in the coordinates of P_1's factor: of what is diagonalised.
    """
    L, d = linalg.ldl(P1)
    F = L * np.sqrt(d)
    inverse = lower_inverse(F)
    W = linalg.congruence(inverse, P2)
    ratio, Q = eigen(W)
    grown = condition(W, linalg.product(Q / ratio, Q.swapaxes(0, 1)))
    grown = np.where(ratio.min(axis=0) > 0.0, grown, np.inf)
    return linalg.product(F, Q), linalg.product(Q.swapaxes(0, 1), inverse), ratio, grown


def eigen(A: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues (n, B), in no order, and orthonormal vectors (n, n, B), in columns, of symmetric A."""
    n = len(A)
    X = np.zeros((2 * n, *A.shape[1:]), A.dtype)  # what is left of A, above the vectors
    X[:n] = A
    X[range(n, 2 * n), range(n)] = 1.0
    eps = 4.0 * np.finfo(A.dtype).eps
    floor = (eps * eps * np.abs(A).max(axis=(0, 1))) ** 2
    X = jacobi(X, floor, eps * eps)
    return X[range(n), range(n)], X[n:]


@either
def jacobi(X: Floats, floor: Floats, small: float) -> Floats:
    """X (2n, n, B), a symmetric matrix above vectors, turned until the matrix is diagonal."""
    n = X.shape[1]
    for _ in range(SWEEPS):
        turned = False
        for p in range(n):
            for q in range(p + 1, n):
                turned = _turn(X, p, q, small, floor) or turned
        if not turned:
            break
    return X + 0.0  # whether a zero is negative depended on what else is turned


def _turn(X: Floats, p: int, q: int, small: float, floor: Floats) -> bool:
    """Rotate p and q so that X[p, q] is zero, where it is not small."""
    n = X.shape[1]
    b, x, y = X[p, q].copy(), X[p, p].copy(), X[q, q].copy()
    square = b * b
    busy = square > small * np.abs(x * y) + floor
    if not busy.any():
        return False
    half = 0.5 * (y - x)
    t = np.where(busy, b / (half + np.copysign(np.sqrt(half * half + square), half)), 0.0)
    c = 1.0 / np.sqrt(1.0 + t * t)
    s = t * c
    one, other = X[:, p], X[:, q]
    X[:, p], X[:, q] = c * one - s * other, s * one + c * other
    X[p], X[q] = X[:n, p], X[:n, q]
    t *= b
    X[p, p], X[q, q] = x - t, y + t
    X[p, q] = X[q, p] = np.where(busy, 0.0, b)
    return True
