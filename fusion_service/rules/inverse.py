"""Inverse covariance intersection (ICI): Noack, Sijs, Reinhardt and Hanebeck 2017; Sharma (47), (55).

    P^-1 = P_1^-1 + P_2^-1 - G^-1,    P^-1 x = P_1^-1 x_1 + P_2^-1 x_2 - G^-1 (w_1 x_1 + w_2 x_2)
    G = w_1 P_1 + w_2 P_2

(The paper's (47) lacks the leading P of the mean.) G stands for what both sources have in common; without
the spread of the means it is HMD-GA's mutual component with the weights exchanged.

Weights: min over w of det P or trace P. G^-1 is convex in w as a matrix, so P^-1 is concave and the problem
convex. Where P_1 = T T', P_2 = T diag(r) T', with t = w_1, g_k = t + (1-t) r_k and h_k = t + (1-t) r_k^2,

    P = T diag(r_k g_k / h_k) T'
    d log det P / dt = sum r_k (r_k - 1) / (g_k h_k),    d trace P / dt = sum |T_k|^2 r_k^2 (r_k - 1) / h_k^2

For det, all of this is in the elementary symmetric functions e_k of r and E_k of r^2, since prod g_k =
sum e_k (1-t)^k t^(n-k): e_1 and e_{n-1} are traces, n - 3 determinants give the rest, and E follows from e
(Graeffe). The answer is certified by `simplex.gap`.

Promise: conservative under its own correlation structure only, where each source is an independent part
fused with one estimate that is common to both: P_12 = P_1 X P_2 with the common information X (Sharma (54)).
In general it is not: for P_1 = diag(4, 1), P_2 = diag(1, 4) and one cross-correlation of .9 the true error
exceeds the reported one by 44 %.

More than two sources are fused pairwise, in the order of `chain`.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from fusion_service import linalg
from fusion_service.linalg import FloatArray, inner, product, total, trace
from fusion_service.rules.chain import Pair, pairwise
from fusion_service.rules.sources import Result, Sources, condition, weighted_sum
from fusion_service.rules.weights import simplex
from fusion_service.rules.weights.pencil import pencil

LIMIT = 6
"""Up to this dimension the weights for det come from symmetric functions; rounding spoils them above."""
ROUNDS = 100
Slope = Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
FLAT = 1e-10
"""Slopes below this, relatively, do not matter: the weight stays at a half."""
DONE, STEEP = 1e-11, 3e-6
"""Stop where a Newton step gains less than the one, relatively, from a slope below the other."""


def ici(sources: Sources, weights: FloatArray | None, influence: bool, *, criterion: str) -> Result:
    """Inverse covariance intersection."""
    return pairwise(partial(_pair, criterion), sources, weights, influence)


def _pair(criterion: str, two: Sources, weights: FloatArray | None, influence: bool) -> Pair:
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
            slope = inner(_lower_product(half, V)[:, :, None], P)
        else:
            slope = inner(_lower_product(half, half.swapaxes(0, 1))[:, :, None], P) / trace(fused)
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


def _lower_product(A: FloatArray, B: FloatArray) -> FloatArray:
    """The lower triangle of A B."""
    out = np.empty_like(A)
    for i in range(len(A)):
        row = A[i, 0] * B[0, : i + 1]
        for k in range(1, len(A)):
            row += A[i, k] * B[k, : i + 1]
        out[i, : i + 1] = row
    return out


def _best(criterion: str, two: Sources) -> FloatArray:
    """Weights (2, B) with the smallest det P or trace P."""
    P = two.covariances
    slope: Slope
    if criterion == "det" and two.fast and len(P) <= LIMIT:
        slope, data = _symmetric_slope, _symmetric_functions(two)
        ends = data[-2, 0] / data[-1, 0], data[1, 0]
        return root(slope, data, ends[0][0] - ends[0][1], ends[1][1] - ends[1][0])
    T, _, r, _ = pencil(P[:, :, 0], P[:, :, 1])
    if criterion == "det":
        slope, data = _det_slope, r[:, None]
    else:
        slope, data = _trace_slope, np.stack([r, total(T * T)], axis=1)
    zero, one = (slope(np.full_like(r[0], t), np.full_like(r[0], 1.0 - t), data)[0] for t in (0.0, 1.0))
    return root(slope, data, zero, one)


def _det_slope(t: FloatArray, u: FloatArray, data: FloatArray) -> tuple[FloatArray, FloatArray]:
    """First and second derivative of log det P by t, at t and u = 1 - t."""
    r = data[:, 0]
    g, h = t + u * r, t + u * (r * r)
    term = (r - 1.0) * r / (g * h)
    return total(term), total(term * (r - 1.0) * (1.0 / g + (1.0 + r) / h))


def _trace_slope(t: FloatArray, u: FloatArray, data: FloatArray) -> tuple[FloatArray, FloatArray]:
    """First and second derivative of trace P, over trace P."""
    r, size = data[:, 0], data[:, 1]
    h = t + u * (r * r)
    term = size * (r / h) * (r / h) * (r - 1.0)
    scale = 1.0 / total(size * r * (t + u * r) / h)
    return total(term) * scale, 2.0 * total(term * (r - 1.0) * (r + 1.0) / h) * scale


def _symmetric_slope(t: FloatArray, u: FloatArray, data: FloatArray) -> tuple[FloatArray, FloatArray]:
    """As `_det_slope`, from `_symmetric_functions`."""
    n, power = len(data) - 1, [np.ones_like(t), t]
    for _ in range(2, n + 1):
        power.append(power[-1] * t)
    (g, h), (dg, dh), (ddg, ddh) = (_form(data[: max(n + 1 - order, 1), order], power, u) for order in range(3))
    u, v = dg / g, dh / h
    return u - v, ddg / g - u * u - ddh / h + v * v


def _form(c: FloatArray, power: list[FloatArray], b: FloatArray) -> FloatArray:
    """sum c_k b^k t^(n-k), (2, B), from the powers of t."""
    n = len(c) - 1
    out = np.array(c[n])
    for k in range(n - 1, -1, -1):
        out *= b
        out += c[k] * power[n - k]
    return out


def _symmetric_functions(two: Sources) -> FloatArray:
    """Coefficients (n+1, 3, 2, B) of sum e_k (1-t)^k t^(n-k), of the same with E_k, and of their derivatives.

    e_k and E_k are the elementary symmetric functions of r and of r^2.
    """
    P, A = two.covariances, two.information
    n = len(P)
    e = np.empty((n + 1, P.shape[-1]))
    e[0], e[n] = 1.0, two.dets[1] / two.dets[0]
    if n > 1:
        e[1], e[n - 1] = inner(A[:, :, 0], P[:, :, 1]), e[n] * inner(A[:, :, 1], P[:, :, 0])
    unknown = n - 3
    if unknown > 0:
        # det(P_1 + s P_2) = det P_1 sum e_k s^k, at values of s where the unknown terms are the large ones
        centre = (e[1] / e[n - 1]) ** (1.0 / (n - 2))
        s = centre * 3.0 ** (np.arange(unknown) - 0.5 * (unknown - 1))[:, None]
        rest = linalg.det(P[:, :, :1] + s * P[:, :, 1:]) / two.dets[0]
        rest = (rest - 1.0 - s * e[1] - s ** (n - 1) * (e[n - 1] + s * e[n])) / (s * s)
        e[2 : n - 1] = _interpolated(s, rest)
    E = e * e
    for k in range(1, n):
        for j in range(1, min(k, n - k) + 1):
            E[k] += (2.0 if j % 2 == 0 else -2.0) * e[k - j] * e[k + j]
    out = np.zeros((n + 1, 3, 2, P.shape[-1]))
    out[:, 0, 0], out[:, 0, 1] = e, E
    for order in (0, 1):
        m = n - order
        index = np.arange(m, dtype=np.float64)[:, None, None]
        out[:m, order + 1] = (m - index) * out[:m, order] - (index + 1.0) * out[1 : m + 1, order]
    return out


def _interpolated(s: FloatArray, values: FloatArray) -> FloatArray:
    """Coefficients (m, B) of the polynomials with these values at s, by divided differences."""
    m = len(s)
    d = np.array(values)
    for j in range(1, m):
        d[j:] = (d[j:] - d[j - 1 : -1]) / (s[j:] - s[:-j])
    out = np.zeros_like(d)
    for j in range(m - 1, -1, -1):
        out[1:] = out[:-1] - s[j] * out[1:]
        out[0] = d[j] - s[j] * out[0]
    return out


def root(slope: Slope, data: FloatArray, zero: FloatArray, one: FloatArray) -> FloatArray:
    """(t, 1 - t) (2, B) where a rising slope passes zero; the better end if nowhere, a half if it is flat.

    `zero` and `one` are its values at the ends. The smaller weight is what is searched, so that it keeps its
    digits.
    """
    middle = np.full_like(zero, 0.5)
    half, _ = slope(middle, middle, data)
    upper = half < 0.0  # then 1 - t is the smaller one, and the slope by it rises too
    near, far = np.where(upper, -one, zero), np.where(upper, -zero, one)
    half = np.abs(half)
    # start where (a + b v) / (1 + c v) through the three values is zero: it can follow a pole
    v = near / (near - far * (1.0 + (near + far - 2.0 * half) / (half - far)))
    lo, hi = np.zeros_like(v), middle.copy()
    v = np.where((v >= lo) & (v <= hi), v, 0.25)
    steep = (near < -FLAT) | (far > FLAT)
    v[~steep] = 0.5
    v[steep & (near >= 0.0)] = 0.0
    busy = steep & (near < 0.0)
    out, todo, flip = v, np.arange(len(v)), upper
    for _ in range(ROUNDS):
        left = np.count_nonzero(busy)
        if left <= 0.6 * len(todo):
            out[todo] = v
            if not left:
                break
            at = np.flatnonzero(busy)
            todo, v, lo, hi, data, busy, flip = todo[at], v[at], lo[at], hi[at], data[..., at], busy[at], flip[at]
        rest = 1.0 - v
        h, dh = slope(np.where(flip, rest, v), np.where(flip, v, rest), data)
        h = np.where(flip, -h, h)
        rising = h > 0.0
        np.copyto(hi, v, where=rising)
        np.copyto(lo, v, where=~rising)
        step = h / dh
        new = v - step
        outside = ~((new >= lo) & (new <= hi))
        new = np.where(outside, 0.5 * (lo + hi), new)
        np.copyto(v, new, where=busy)
        # h step is the squared Newton decrement: after this step about its square remains; |h| is the gap
        busy &= ~((np.abs(h * step) <= DONE) & (np.abs(h) <= STEEP)) | outside
        busy &= hi - lo > 1e-17 * hi
    else:
        out[todo] = v
    return np.stack([np.where(upper, 1.0 - out, out), np.where(upper, out, 1.0 - out)])
