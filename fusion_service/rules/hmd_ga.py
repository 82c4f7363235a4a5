"""Harmonic mean density in its Gaussian approximation (HMD-GA), any number of sources in one step.

p = 1 / sum w_j / p_j = (product of all p_i) / sum w_j q_j, with q_j the product of all but p_j, which is
z_j N(c_j, C_j) (Dubey eqs. (13)-(16)). The mixture in the denominator is replaced by the Gaussian of its
moments (Dubey (18), (19); Sharma (32), (33)), the mutual component, with normalised weights
v_j = w_j z_j / sum w z:

    c = sum v_j c_j,    G = sum v_j (C_j + c_j c_j') - c c'
    P^-1 = sum P_i^-1 - G^-1,    P^-1 x = sum P_i^-1 x_i - G^-1 c          (Dubey (21), (22); Sharma (31))

For N = 2, with w = w_1: G = (1-w) P_1 + w P_2 + w(1-w) d d'.

Weights: Sharma (77) as it stands, min over w of det or trace of G^-1. It makes the mutual component large;
it does not minimise P. G is concave in v as a matrix, so the problem is convex in v; the answer is mapped
back to w_j ~ v_j / z_j in logarithms.

The papers drop the constants z_j (Dubey (14)-(17)) for N > 2; here they are kept, and `constants=False`
gives the formula as printed.

Criterion "kl": weights by dispersion of divergences, Dubey (23) to (29),

    min over w of sum_i (D_i - mean D)^2,    D_i = (KL(p, p_i) + KL(p_i, p)) / 2,  p = HMD-GA at w

which makes the fused density equally far from all sources. For two sources a root of D_1 = D_2 exists: at
w_1 = 1 the result is source 1. There can be several minima (see `search` for which is found). These weights favour
the worst source (it must be as near as the best one), as Dubey's own tables show; equal weights did better there.

Promise: tight, and always positive definite and never above CI at the same v-weights; but in general not
conservative (Sharma's section 4.2 notwithstanding): for P_1 = diag(4, 1), P_2 = diag(1, 4) and one
cross-correlation of .9 the true error exceeds the reported covariance by 45 % in one direction.
"""

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.linalg import condition, inner, total
from fusion_service.rules.base.block import Result, Sources, alone, weighted_mean
from fusion_service.rules.base.matrices import all_but_one, weighted_sum
from fusion_service.rules.base.options import Option, one_of
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.base.scales import SCALES, in_scales
from fusion_service.rules.weights import line, search, simplex
from fusion_service.rules.weights.mixture_covariance import MixtureCovariance
from fusion_service.rules.weights.two import best_of_two

__all__ = ["RULE", "harmonic", "hmd_ga"]


def hmd_ga(sources: Sources, weights: Floats | None, influence: bool, *, criterion: str, constants: bool) -> Result:
    """Harmonic mean density, Gaussian approximation, with criterion "kl" too."""
    if criterion == "kl":
        if weights is None:
            weights = search.lowest(_dispersion(sources, constants), sources)
        criterion = "det"
    return harmonic(sources, weights, influence, criterion=criterion, constants=constants)


RULE = Rule(
    name="hmd-ga",
    order=9,
    title="harmonic mean density, Gaussian approximation, N-way in one step",
    promise="tight; none in general",
    source="harmonic mean density, Gaussian approximation: Sharma (31), (77); Dubey (14)-(29)",
    fuse=in_scales(hmd_ga),
    takes={
        "criterion": Option("det", one_of("det", "trace", "kl")),
        "scales": SCALES,
        "constants": Option(True),
    },
)


def harmonic(sources: Sources, weights: Floats | None, influence: bool, *, criterion: str, constants: bool) -> Result:
    """Harmonic mean density, Gaussian approximation, by criterion "det" or "trace"."""
    if sources.count == 1:
        return alone(sources, influence)
    if len(sources.means) == 1:
        criterion = "det"  # the same, and kinder to rounding
    mixture, log_z, worst = _others(sources)
    if not constants:
        log_z = np.zeros_like(log_z)
    if weights is not None:
        v = _normalised(np.log(weights) + log_z)
    elif sources.count == 2:
        P, A, dets = sources.covariances, sources.information, sources.dets
        ends = (P[:, :, 0], P[:, :, 1]), (A[:, :, 0], A[:, :, 1]), (dets[0], dets[1])
        v = best_of_two(criterion, *ends, bump=sources.spread[:, 1])
    else:
        v = simplex.best_weights(criterion, mixture, sources.uniform)
    V, spoilt, g = (_mutual_of_two if sources.count == 2 else _mutual)(mixture, v, criterion)
    A = sources.information
    everything = weighted_sum(A)
    M = everything - V
    P = linalg.inverse(M)
    y = weighted_mean(sources) - linalg.matvec(V, mixture.mean(v))
    # M is a difference: what is lost in it is tr(P sum P_i^-1) / n >= 1
    worst = np.maximum(worst, spoilt) * inner(P, everything) / len(P)
    gap = simplex.gap(v, g) if weights is None else np.zeros_like(worst)
    return Result(
        sources.means[:, 0] + linalg.matvec(P, y),
        P,
        weights if weights is not None else _normalised(np.log(v) - log_z),
        _influence(A, P, V, mixture.C * v) if influence else None,
        np.maximum(worst, condition(M, P)),
        gap,
    )


def _mutual(mixture: MixtureCovariance, v: Floats, criterion: str) -> tuple[Floats, Floats, Floats]:
    """G^-1 (n, n, B), the condition of what was inverted, and the gradient (N, B) of the criterion."""
    G, D = mixture(v)
    V = linalg.inverse(G)
    return V, condition(G, V), simplex.gradient(criterion, V, D)


def _mutual_of_two(mixture: MixtureCovariance, v: Floats, criterion: str) -> tuple[Floats, Floats, Floats]:
    """The same by Sherman and Morrison: means many sigmas apart make G ill-conditioned, and do no harm here."""
    C, d = mixture.C, mixture.c[:, 0] - mixture.c[:, 1]
    L = weighted_sum(C, v)
    U = linalg.inverse(L)
    V, e = line.spread_inverse(U, d, v[0] * v[1])
    if criterion == "det" or len(V) == 1:
        return V, condition(L, U), -inner(V[:, :, None], C) - v[::-1] ** 2 * total(e * d)
    W, scale = linalg.product(V, V), linalg.trace(V)
    return V, condition(L, U), -(inner(W[:, :, None], C) + v[::-1] ** 2 * total(e * e)) / scale


def _others(sources: Sources) -> tuple[MixtureCovariance, Floats, Floats]:
    """The products of all sources but one; their log constants (N, B), up to a common one; the condition."""
    x, A = sources.spread, sources.information
    if sources.count == 2:
        mixture = MixtureCovariance(sources.covariances[:, :, ::-1], x[:, ::-1])
        return mixture, np.zeros_like(x[0]), sources.condition
    Ax = linalg.matvec(A, x)
    Y, y = all_but_one(A), all_but_one(Ax)
    C, det, _ = linalg.sweep(Y)
    c = linalg.matvec(C, y)
    log_z = 0.5 * (np.log(sources.dets) - np.log(det) + total(x * Ax) + total(c * y))
    return MixtureCovariance(C, c), log_z, np.maximum(sources.condition, condition(Y, C).max(axis=0))


def _normalised(log_w: Floats) -> Floats:
    w = np.exp(log_w - log_w.max(axis=0))
    out: Floats = w / total(w)
    return out


def _influence(A: Floats, P: Floats, V: Floats, weighted: Floats) -> Floats:
    """trace(K_i) / n (N, B), K_i = P (I - V sum_{j != i} v_j C_j) A_i, weights held."""
    X = linalg.product(linalg.product(P, V)[:, :, None], all_but_one(weighted))
    mutual = linalg.trace(linalg.product(X, A))
    out: Floats = (inner(P[:, :, None], A) - mutual) / len(P)
    return out


def _dispersion(sources: Sources, constants: bool) -> search.Cost:
    def cost(w: Floats) -> Floats:
        fused = harmonic(sources, w, False, criterion="det", constants=constants)
        P, A = fused.covariance[:, :, None], sources.information
        inverse = linalg.inverse(fused.covariance)[:, :, None]
        d = sources.spread - (fused.mean - sources.means[:, 0])[:, None]
        n = len(d)
        distance = inner(A, P) + inner(inverse, sources.covariances) - 2.0 * n
        distance = 0.25 * (distance + total(d * linalg.matvec(A + inverse, d)))
        off = distance - total(distance) / sources.count
        return total(off * off)

    return cost
