"""Inverse covariance intersection (ICI): Noack, Sijs, Reinhardt and Hanebeck 2017; Sharma (47), (55).

    P^-1 = P_1^-1 + P_2^-1 - G^-1,    P^-1 x = P_1^-1 x_1 + P_2^-1 x_2 - G^-1 (w_1 x_1 + w_2 x_2)
    G = w_1 P_1 + w_2 P_2

(The paper's (47) lacks the leading P of the mean.) G stands for what both sources have in common; without
the spread of the means it is HMD-GA's mutual component with the weights exchanged.

Weights: min over w of det P or trace P. G^-1 is convex in w as a matrix, so P^-1 is concave and the problem
convex. Where P_1 = T T', P_2 = T diag(r) T', with t = w_1, g_k = t + (1-t) r_k and h_k = t + (1-t) r_k^2,

    P = T diag(r_k g_k / h_k) T'
    d log det P / dt = sum r_k (r_k - 1) / (g_k h_k),    d trace P / dt = sum |T_k|^2 r_k^2 (r_k - 1) / h_k^2

For det the elementary symmetric functions of r and r^2 give it without T (see `symmetric`). The answer is certified
by `simplex.gap`.

Promise: conservative under its own correlation structure only, where each source is an independent part
fused with one estimate that is common to both: P_12 = P_1 X P_2 with the common information X (Sharma (54)).
In general it is not: for P_1 = diag(4, 1), P_2 = diag(1, 4) and one cross-correlation of .9 the true error
exceeds the reported one by 44 %.

More than two sources are fused pairwise, in the order of `chain`.
"""

from functools import partial

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.linalg import condition, inner, product, total, trace
from fusion_service.rules.base.block import Result, Sources
from fusion_service.rules.base.chain import Pair, pairwise
from fusion_service.rules.base.matrices import lower_product, weighted_sum
from fusion_service.rules.base.options import CRITERION
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.base.scales import SCALES, in_scales
from fusion_service.rules.weights import pairs, simplex
from fusion_service.rules.weights.pencil import pencil
from fusion_service.rules.weights.root import root, slopes_at_ends
from fusion_service.rules.weights.symmetric import symmetric_functions, symmetric_slope

__all__ = ["RULE", "ici"]


def ici(sources: Sources, weights: Floats | None, influence: bool, *, criterion: str) -> Result:
    """Inverse covariance intersection."""
    return pairwise(partial(_pair, criterion), sources, weights, influence)


RULE = Rule(
    name="ici",
    order=7,
    title="inverse covariance intersection, pairwise",
    promise="conservative under its own correlation structure only",
    source="inverse covariance intersection (Noack et al. 2017; Sharma (47), (55)); smallest det first",
    fuse=in_scales(ici),
    n_way=False,
    takes={"criterion": CRITERION, "scales": SCALES},
)


def _pair(criterion: str, two: Sources, weights: Floats | None, influence: bool) -> Pair:
    P, A = two.covariances, two.information
    w = _best(criterion, two) if weights is None else weights
    G = weighted_sum(P, w)
    V = linalg.inverse(G)
    everything = weighted_sum(A)
    M = everything - V
    fused = linalg.inverse(M)
    # M is a difference: what is lost in it is tr(P sum P_i^-1) / n >= 1
    worst = np.maximum(two.condition, condition(G, V)) * inner(fused, everything) / len(M)
    gap = np.zeros_like(worst)
    if weights is None:
        half = product(V, fused)
        if criterion == "det":
            slope = inner(lower_product(half, V)[:, :, None], P)
        else:
            slope = inner(lower_product(half, half.swapaxes(0, 1))[:, :, None], P) / trace(fused)
        gap = simplex.gap(w, -slope)
    second = A[:, :, 1] - w[1] * V
    return Pair(
        two.means[:, 0] + linalg.matvec(fused, linalg.matvec(second, two.spread[:, 1])),
        fused,
        w,
        product(fused, second) if influence else None,
        np.maximum(worst, condition(M, fused)),
        gap,
    )


def _best(criterion: str, two: Sources) -> Floats:
    """Weights (2, B) with the smallest det P or trace P."""
    P = two.covariances
    if criterion == "det" and two.fast and len(P) <= pairs.LIMIT:
        data = symmetric_functions(two)
        ends = data[-2, 0] / data[-1, 0], data[1, 0]
        return root(symmetric_slope, data, ends[0][0] - ends[0][1], ends[1][1] - ends[1][0])
    T, _, r, _ = pencil(P[:, :, 0], P[:, :, 1])
    slope, data = (
        (_det_slope, r[:, None]) if criterion == "det" else (_trace_slope, np.stack([r, total(T * T)], axis=1))
    )
    return root(slope, data, *slopes_at_ends(slope, data))


def _det_slope(t: Floats, u: Floats, data: Floats) -> tuple[Floats, Floats]:
    """First and second derivative of log det P by t, at t and u = 1 - t."""
    r = data[:, 0]
    g, h = t + u * r, t + u * (r * r)
    term = (r - 1.0) * r / (g * h)
    return total(term), total(term * (r - 1.0) * (1.0 / g + (1.0 + r) / h))


def _trace_slope(t: Floats, u: Floats, data: Floats) -> tuple[Floats, Floats]:
    """First and second derivative of trace P, over trace P."""
    r, size = data[:, 0], data[:, 1]
    h = t + u * (r * r)
    term = size * (r / h) * (r / h) * (r - 1.0)
    scale = 1.0 / total(size * r * (t + u * r) / h)
    return total(term) * scale, 2.0 * total(term * (r - 1.0) * (r + 1.0) / h) * scale
