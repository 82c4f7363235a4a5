"""Covariance union (CU): one covariance that holds whichever source is right (Uhlmann; Li-AA section II-B).

    x = sum w_i x_i,    U_i = P_i + (x - x_i)(x - x_i)'                             (Li-AA (5), (11))

max: the smallest P, by det or trace, with P >= U_i for every i (7). Li-AA's (8), the largest of the U_i by
trace or det, is not above the others as a matrix; this is. min: the smallest of the U_i, as in (9). The
weights only place the mean; uniform unless given.

Two sources have a closed form. With U_1 = T T', U_2 = T diag(r) T' the least det is that of
T diag(max(r, 1)) T'; the least trace is that of U_1 + (U_2 - U_1)_+, the positive part. For more, the
problem is convex (det: in P^-1) and a primal-dual method finds P to a duality gap of `GAP` (`weights.above`); where
rounding does not let it, in longdouble either, P is what joining them two by two gives: above all, if not the smallest.

Promise (max): conservative if one source is, that is, if for one i the truth given all estimates has mean
x_i and covariance at most P_i. Li-AA's Lemmas 1 and 2 need just this; a covariance P_i that holds on average
over the estimates is not enough, least of all for min.
"""

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.linalg import condition, total, trace
from fusion_service.rules.base.block import Result, Sources, alone
from fusion_service.rules.base.matrices import spectral
from fusion_service.rules.base.options import CRITERION, Option, one_of
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.base.scales import SCALES, in_scales
from fusion_service.rules.weights.above import GAP, smallest_above
from fusion_service.rules.weights.pencil import eigen, pencil

__all__ = ["RULE", "cu"]

ENOUGH = 1e-6
"""The gap that will do where rounding allows no less, in longdouble."""


def cu(sources: Sources, weights: Floats | None, influence: bool, *, criterion: str, bound: str) -> Result:
    """Covariance union, `bound` "max" or "min"."""
    if sources.count == 1:
        return alone(sources, influence)
    w = sources.uniform if weights is None else weights
    x = total((sources.spread * w).swapaxes(0, 1))
    d = sources.spread - x[:, None]
    U = sources.covariances + linalg.outer(d, d)
    A, _, margin = linalg.sweep(U)
    worst, gap = condition(U, A).max(axis=0), np.zeros_like(sources.condition)
    worst = np.where(margin.min(axis=0) > 0.0, worst, np.inf)
    if bound == "min":
        size = linalg.logdet(U) if criterion == "det" else trace(U)
        P = np.take_along_axis(U, size.argmin(axis=0)[None, None, None], axis=2)[:, :, 0]
    else:
        P, worst = U[:, :, 0], np.zeros_like(worst)
        for i in range(1, sources.count):
            P, more = _join(criterion, P, U[:, :, i])
            worst = np.maximum(worst, 10.0 * more)
        worst = np.where(margin.min(axis=0) > 0.0, worst, np.inf)
        if sources.count > 2:
            P, gap = _smallest(criterion, P, U)
    return Result(sources.means[:, 0] + x, P, w, w if influence else None, worst, gap)


RULE = Rule(
    name="cu",
    order=13,
    title="covariance union, `max` and `min`",
    promise="conservative if one source is (max)",
    source="covariance union (Uhlmann; Li-AA (7)-(9))",
    fuse=in_scales(cu),
    takes={"criterion": CRITERION, "scales": SCALES, "bound": Option("max", one_of("max", "min"))},
)


def _join(criterion: str, U: Floats, W: Floats) -> tuple[Floats, Floats]:
    """The smallest matrix above both, and what rounding grows by.

    The result is above both, so it is the condition of the larger that counts: how flat the smaller one is does not.
    """
    swap = linalg.logdet(W) > linalg.logdet(U)
    U, W = np.where(swap, W, U), np.where(swap, U, W)
    base = condition(U, linalg.inverse(U))
    if criterion == "det":
        T, _, r, _ = pencil(U, W)
        return spectral(T, np.maximum(r, 1.0)), base * np.maximum(np.abs(r).max(axis=0), 1.0)
    size, Q = eigen(W - U)
    P = U + spectral(Q, np.maximum(size, 0.0))
    return P, base * np.abs(size).max(axis=0) / np.stack([P[k, k] for k in range(len(P))]).min(axis=0)


def _smallest(criterion: str, start: Floats, U: Floats) -> tuple[Floats, Floats]:
    """The smallest P (n, n, B) above every U (n, n, N, B), and the gap (B,); `start` is one above them."""
    P, gap = smallest_above(criterion, start, U)
    size_of = linalg.logdet if criterion == "det" else trace
    new, old = size_of(P), size_of(start)
    no_worse = ~(old > new + 2.0 * GAP * (np.abs(new) if criterion == "trace" else 1.0))
    if U.dtype != np.float64:
        no_worse |= ~(gap <= ENOUGH)  # longdouble does not find it either: what is above all, if not the smallest
    return np.where(no_worse, start, P), np.where(no_worse, 0.0, gap)
