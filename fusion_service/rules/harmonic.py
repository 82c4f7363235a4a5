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

Promise: tight, and always positive definite and never above CI at the same v-weights; but in general not
conservative (Sharma's section 4.2 notwithstanding): for P_1 = diag(4, 1), P_2 = diag(1, 4) and one
cross-correlation of .9 the true error exceeds the reported covariance by 45 % in one direction.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.linalg import FloatArray, inner, total
from fusion_service.rules.sources import Result, Sources, condition, weighted_mean, weighted_sum
from fusion_service.rules.weights import line, pairs, simplex


def hmd_ga(sources: Sources, weights: FloatArray | None, influence: bool, *, criterion: str, constants: bool) -> Result:
    """Harmonic mean density, Gaussian approximation."""
    if sources.count == 1:
        one, zero = np.ones_like(sources.means[0]), np.zeros_like(sources.condition)
        return Result(
            sources.means[:, 0],
            sources.covariances[:, :, 0],
            one,
            one if influence else None,
            sources.condition,
            zero,
        )
    if len(sources.means) == 1:
        criterion = "det"  # the same, and kinder to rounding
    mixture, log_z, worst = _others(sources)
    if not constants:
        log_z = np.zeros_like(log_z)
    if weights is not None:
        v = _normalised(np.log(weights) + log_z)
    elif sources.count == 2:
        P, A, dets = sources.covariances, sources.information, sources.dets
        pair, bump = (P[:, :, 0], P[:, :, 1]), sources.spread[:, 1]
        if sources.fast and len(sources.means) <= pairs.LIMIT:
            t = pairs.best_weight(criterion, pair, (A[:, :, 0], A[:, :, 1]), (dets[0], dets[1]), bump=bump)
        else:
            t = line.best_weight(criterion, pair, bump=bump)
        v = np.stack([t, 1.0 - t])
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


@dataclass(frozen=True, slots=True)
class Mixture:
    """The covariance of the mixture sum v_j N(c_j, C_j), as a function of v."""

    C: FloatArray  # (n, n, N, B)
    c: FloatArray  # (n, N, B)

    def mean(self, v: FloatArray) -> FloatArray:
        return total((self.c * v).swapaxes(0, 1))

    def __call__(self, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        r = self.c - self.mean(v)[:, None]
        D = self.C + linalg.outer(r, r)
        return weighted_sum(D, v), D

    def bend(self, v: FloatArray, G: FloatArray) -> FloatArray:
        r = self.c - self.mean(v)[:, None]
        Gr = linalg.matvec(G[:, :, None], r)
        return 2.0 * total(r[:, :, None] * Gr[:, None])

    def take(self, index: NDArray[np.bool_]) -> Self:
        return replace(self, C=self.C[..., index], c=self.c[..., index])


def _mutual(mixture: Mixture, v: FloatArray, criterion: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """G^-1 (n, n, B), the condition of what was inverted, and the gradient (N, B) of the criterion."""
    G, D = mixture(v)
    V = linalg.inverse(G)
    return V, condition(G, V), simplex.gradient(criterion, V, D)


def _mutual_of_two(mixture: Mixture, v: FloatArray, criterion: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The same by Sherman and Morrison: means many sigmas apart make G ill-conditioned, and do no harm here."""
    C, d = mixture.C, mixture.c[:, 0] - mixture.c[:, 1]
    L = weighted_sum(C, v)
    U = linalg.inverse(L)
    V, e = line.spread_inverse(U, d, v[0] * v[1])
    if criterion == "det" or len(V) == 1:
        return V, condition(L, U), -inner(V[:, :, None], C) - v[::-1] ** 2 * total(e * d)
    W, scale = linalg.product(V, V), linalg.trace(V)
    return V, condition(L, U), -(inner(W[:, :, None], C) + v[::-1] ** 2 * total(e * e)) / scale


def _others(sources: Sources) -> tuple[Mixture, FloatArray, FloatArray]:
    """The products of all sources but one; their log constants (N, B), up to a common one; the condition.

    Sums from the left and from the right, so that nothing is subtracted.
    """
    x, A = sources.spread, sources.information
    if sources.count == 2:
        mixture = Mixture(sources.covariances[:, :, ::-1], x[:, ::-1])
        return mixture, np.zeros_like(x[0]), sources.condition
    Ax = linalg.matvec(A, x)
    Y, y = all_but_one(A), all_but_one(Ax)
    C, det, _ = linalg.sweep(Y)
    c = linalg.matvec(C, y)
    log_z = 0.5 * (np.log(sources.dets) - np.log(det) + total(x * Ax) + total(c * y))
    return Mixture(C, c), log_z, np.maximum(sources.condition, condition(Y, C).max(axis=0))


def all_but_one(a: FloatArray) -> FloatArray:
    """(..., N, B): for each source the sum over the others."""
    out = np.zeros_like(a)
    N = a.shape[-2]
    for order in (range(N), range(N - 1, -1, -1)):
        running = np.zeros_like(a[..., 0, :])
        for i in order:
            out[..., i, :] += running
            running = running + a[..., i, :]
    return out


def _normalised(log_w: FloatArray) -> FloatArray:
    w = np.exp(log_w - log_w.max(axis=0))
    out: FloatArray = w / total(w)
    return out


def _influence(A: FloatArray, P: FloatArray, V: FloatArray, weighted: FloatArray) -> FloatArray:
    """trace(K_i) / n (N, B), K_i = P (I - V sum_{j != i} v_j C_j) A_i, weights held."""
    X = linalg.product(linalg.product(P, V)[:, :, None], all_but_one(weighted))
    mutual = linalg.trace(linalg.product(X, A))
    out: FloatArray = (inner(P[:, :, None], A) - mutual) / len(P)
    return out
