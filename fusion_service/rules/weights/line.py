"""The best weight of two sources by Newton's method on the matrices themselves.

Slower than `pairs`, but for any n, in float64 and longdouble, and however far the means are apart: a spread
term enters by Sherman and Morrison's formula, so that the matrix inverted is never worse than the sources'.

An element is frozen when it has converged: its bits do not depend on the others.
"""

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.linalg import inner, matvec, outer, product, total, trace
from fusion_service.rules.weights.pairs import FLAT, Ends, of_elements

__all__ = ["best_weight", "spread_inverse"]

ROUNDS = 100
DONE = 1e-11
"""Slope, relative to the criterion, that counts as zero."""


def best_weight(criterion: str, M: Ends, *, bump: Floats | None = None, rho: float | Floats = 1.0) -> Floats:
    """The t (B,) in [0, 1] with the largest det M(t), or the smallest trace M(t)^-1; M as in `pairs.best_weight`."""
    size = M[0].shape[-1]
    lo, hi = np.zeros((2, size), M[0].dtype)
    hi += 1.0
    first, last = _slope(criterion, lo, M, bump, rho)[0], _slope(criterion, hi, M, bump, rho)[0]
    flat = ~((first > FLAT) | (last < -FLAT))
    out = np.where(flat, 0.5, np.where(last >= 0.0, hi, lo))
    at = np.flatnonzero(~flat & (first > 0.0) & (last < 0.0))
    lo, hi = lo[at], hi[at]
    t = 0.5 * (lo + hi)
    for _ in range(ROUNDS):
        if not len(at):
            break
        ends = M[0][..., at], M[1][..., at]
        h, dh = _slope(criterion, t, ends, None if bump is None else bump[:, at], of_elements(rho, at))
        lo, hi = np.where(h > 0.0, t, lo), np.where(h > 0.0, hi, t)
        step = h / dh
        new = t - step
        inside = (new >= lo) & (new <= hi)
        t = np.where(inside, new, 0.5 * (lo + hi))
        out[at] = t
        busy = ~(inside & ((np.abs(h) <= DONE) | (np.abs(step) <= 4.0 * np.finfo(t.dtype).eps)))
        at, t, lo, hi = at[busy], t[busy], lo[busy], hi[busy]
    return out


def spread_inverse(U: Floats, d: Floats, tau: Floats) -> tuple[Floats, Floats]:
    """V = (U^-1 + tau d d')^-1 (n, n, B), and V d (n, B), of which the latter is exact to rounding."""
    y = matvec(U, d)
    e = y / (1.0 + tau * total(d * y))
    return U - outer(tau * e, y), e


def _slope(criterion: str, t: Floats, M: Ends, bump: Floats | None, rho: float | Floats) -> tuple[Floats, Floats]:
    """First and second derivative of log det M, or of -log trace M^-1."""
    d0, d1 = (1.0 - rho) * (1.0 - t) + rho, (1.0 - rho) * t + rho
    G = (1.0 - t) / d0 * M[0] + t / d1 * M[1]
    slope0, slope1 = -rho / (d0 * d0), rho / (d1 * d1)
    dG = slope0 * M[0] + slope1 * M[1]
    ddG = 2.0 * (1.0 - rho) * (slope0 / d0 * M[0] - slope1 / d1 * M[1])
    V = linalg.inverse(G)
    X = product(V, dG)
    if bump is not None:
        V, e = spread_inverse(V, bump, t * (1.0 - t))
        X = product(V, dG) + outer((1.0 - 2.0 * t) * e, bump)
    if criterion == "det":
        bend = inner(V, ddG)
        if bump is not None:
            bend -= 2.0 * total(e * bump)
        return trace(X), bend - _trace_product(X, X)
    W = product(V, V)
    fall, bend = inner(W, dG), inner(W, ddG)
    if bump is not None:
        square = total(e * e)
        fall += (1.0 - 2.0 * t) * square
        bend -= 2.0 * square
    f = trace(V)
    first = fall / f
    return first, (bend - 2.0 * _trace_product(product(X, X), V)) / f + first * first


def _trace_product(A: Floats, B: Floats) -> Floats:
    """tr(A B) (B,) of any A and B."""
    out = total(A[0] * B[:, 0])
    for i in range(1, len(A)):
        out += total(A[i] * B[:, i])
    return out
