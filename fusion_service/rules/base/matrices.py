"""Small matrices, batch-last, as rules need them beyond `linalg`: float64 or longdouble, an element on its own."""

from __future__ import annotations

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats

__all__ = [
    "all_but_one",
    "diagonal",
    "fill_upper",
    "lower_inverse",
    "lower_product",
    "spectral",
    "weighted_sum",
]


def weighted_sum(A: Floats, scale: Floats | None = None) -> Floats:
    """sum_i scale_i A_i (n, n, B) of A (n, n, N, B): the lower triangle, which is all that is read of it."""
    M = np.empty_like(A[:, :, 0])
    for k in range(len(M)):
        terms = A[k, : k + 1] if scale is None else A[k, : k + 1] * scale
        np.add(terms[:, 0], terms[:, 1] if A.shape[2] > 1 else 0.0, out=M[k, : k + 1])
        for i in range(2, A.shape[2]):
            M[k, : k + 1] += terms[:, i]
    return M


def all_but_one(a: Floats) -> Floats:
    """(..., N, B): for each source the sum over the others. From the left and the right: nothing is subtracted."""
    out = np.zeros_like(a)
    N = a.shape[-2]
    for order in (range(N), range(N - 1, -1, -1)):
        running = np.zeros_like(a[..., 0, :])
        for i in order:
            out[..., i, :] += running
            running = running + a[..., i, :]
    return out


def diagonal(x: Floats) -> Floats:
    """Diagonal matrices (n, n, B) of x (n, B)."""
    out = np.zeros((len(x), *x.shape), x.dtype)
    for i, row in enumerate(x):
        out[i, i] = row
    return out


def spectral(T: Floats, values: Floats) -> Floats:
    """T diag(values) T' (n, n, B) of T (n, n, B) and values (n, B)."""
    return linalg.congruence(T, diagonal(values))


def fill_upper(P: Floats) -> Floats:
    """P (n, n, ...) with its upper triangle filled from the lower, in place."""
    for i in range(1, len(P)):
        P[:i, i] = P[i, :i]
    return P


def lower_product(A: Floats, B: Floats) -> Floats:
    """The lower triangle of A B (n, n, B)."""
    out = np.empty_like(A)
    for i in range(len(A)):
        row = A[i, 0] * B[0, : i + 1]
        for k in range(1, len(A)):
            row += A[i, k] * B[k, : i + 1]
        out[i, : i + 1] = row
    return out


def lower_inverse(F: Floats) -> Floats:
    """F^-1 (n, n, B) of lower triangular F."""
    out = np.zeros_like(F)
    for i in range(len(F)):
        out[i, i] = 1.0 / F[i, i]
        for k in range(i):
            out[i, : k + 1] -= F[i, k] * out[k, : k + 1]
        if i:
            out[i, :i] *= out[i, i]
    return out
