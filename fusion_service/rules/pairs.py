"""The best weight of two sources, for a whole block of pairs at once.

Along one weight t, det M(t) and trace adj M(t) are polynomials of degree n (one more with a spread term):
their values at a few nodes give them, and a bracketed Newton iteration on the polynomials finds the best
t in a few passes over rows of scalars. Meant for n <= `LIMIT`: beyond, interpolation loses too many
digits, and `simplex` does the work.

The caller certifies the answer with `simplex.gap`, so a lost digit is noticed. An element is frozen when
it has converged: its bits do not depend on the others.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from .. import linalg
from ..linalg import FloatArray

LIMIT = 6
ROUNDS = 60
FLAT = 1e-10
"""Relative slope below which a criterion does not care: the weight stays at a half."""
DONE = 1e-11


Ends = tuple[FloatArray, FloatArray]


def best_weight(
    criterion: str, M: Ends, inverses: Ends, dets: Ends, *, bump: FloatArray | None = None, rho: float = 1.0
) -> FloatArray:
    """The t (B,) in [0, 1] with the largest det M(t), or the smallest trace M(t)^-1.

    M(t) = (1-t) M0 + t M1 + t(1-t) bump bump', with bump (n, B) or None; or, for rho < 1,
    M(t) = c(1-t) M0 + c(t) M1 with c(w) = w / ((1-rho) w + rho). `M` is (M0, M1), each (n, n, B);
    `inverses` and `dets` are theirs.
    """
    n, size = M[0].shape[0], M[0].shape[-1]
    degree = n + (bump is not None)
    nodes, to_coefficients = _nodes(degree)
    det, adjugate = np.empty((2, degree + 1, 1, size))
    det[0, 0], det[-1, 0] = dets
    t = nodes[1:-1, None]
    between = np.empty((n, n, degree - 1, size))
    difference = M[1] - M[0]
    for i in range(n):
        between[i, : i + 1] = t * difference[i, : i + 1, None]
        between[i, : i + 1] += M[0][i, : i + 1, None]
        if bump is not None:
            between[i, : i + 1] += (t * (1.0 - t)) * (bump[: i + 1] * bump[i])[:, None]
    if criterion == "det":
        det[1:-1, 0] = linalg.det(between)
        return _newton(_det_slope, to_coefficients, det, n, rho)
    adjugate[1:-1, 0], det[1:-1, 0] = linalg.trace_inverse_det(between)
    adjugate[0, 0], adjugate[-1, 0] = linalg.trace(inverses[0]), linalg.trace(inverses[1])
    return _newton(_trace_slope, to_coefficients, np.concatenate([det, adjugate * det], axis=1), n, rho)


@cache
def _nodes(degree: int) -> tuple[FloatArray, FloatArray]:
    """Chebyshev-Lobatto nodes on [0, 1] and the matrix from values there to coefficients in z = 2t - 1."""
    z = -np.cos(np.pi * np.arange(degree + 1) / degree)
    return 0.5 + 0.5 * z, np.linalg.inv(np.vander(z, increasing=True))


def _with_derivatives(c: FloatArray) -> FloatArray:
    """(degree + 1, 3, k, B): coefficients of polynomials in z = 2t - 1 and of their two derivatives by t."""
    out = np.zeros((len(c), 3, *c.shape[1:]))
    power = 2.0 * np.arange(1, len(c))[:, None, None]
    out[:, 0] = c
    np.multiply(power, c[1:], out=out[:-1, 1])
    np.multiply(power[:-1], out[1:-1, 1], out=out[:-2, 2])
    return out


def _polynomials(t: FloatArray, c: FloatArray) -> FloatArray:
    """Values, first and second derivatives, (3, k, B), from `_with_derivatives`."""
    z = t + t - 1.0
    out: FloatArray = c[-1] * z
    out += c[-2]
    for row in c[-3::-1]:
        out *= z
        out += row
    return out


def _share(t: FloatArray, rho: float) -> tuple[FloatArray, ...]:
    """s = c(t) + c(1-t) and r = c(t) / s, each with its first and second derivative."""
    d0, d1 = (1.0 - rho) * (1.0 - t) + rho, (1.0 - rho) * t + rho
    c1 = t / d1
    s = c1 + (1.0 - t) / d0
    slope0, slope1 = rho / (d0 * d0), rho / (d1 * d1)
    ds = slope1 - slope0
    bend1 = -2.0 * (1.0 - rho) * slope1 / d1
    dds = bend1 - 2.0 * (1.0 - rho) * slope0 / d0
    r = c1 / s
    dr = (slope1 - r * ds) / s
    return s, ds, dds, r, dr, (bend1 - r * dds - 2.0 * dr * ds) / s


def _det_slope(t: FloatArray, c: FloatArray, n: int, rho: float) -> tuple[FloatArray, FloatArray]:
    """First and second derivative of log det M."""
    if rho == 1.0:
        (f,), (df,), (ddf,) = _polynomials(t, c)
        first = df / f
        return first, ddf / f - first * first
    s, ds, dds, r, dr, ddr = _share(t, rho)
    (f,), (df,), (ddf,) = _polynomials(r, c)
    u, v = df / f, ds / s
    return u * dr + n * v, (ddf / f - u * u) * dr * dr + u * ddr + n * (dds / s - v * v)


def _trace_slope(t: FloatArray, c: FloatArray, n: int, rho: float) -> tuple[FloatArray, FloatArray]:
    """First and second derivative of -trace M^-1, over trace M^-1."""
    if rho == 1.0:
        first, second = _log_ratio(t, c)
        return -first, -second
    s, ds, dds, r, dr, ddr = _share(t, rho)
    first, second = _log_ratio(r, c)
    u, v = first * dr, ds / s
    return v - u, dds / s + 2.0 * v * (u - v) - second * dr * dr - first * ddr


def _log_ratio(t: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray]:
    """g'/g and g''/g of g = trace adj M / det M."""
    (f, a), (df, da), (ddf, dda) = _polynomials(t, c)
    u, v = da / a, df / f
    first = u - v
    return first, dda / a - 2.0 * first * v - ddf / f


Slope = Callable[[FloatArray, FloatArray, int, float], tuple[FloatArray, FloatArray]]


def _newton(slope: Slope, to_coefficients: FloatArray, values: FloatArray, n: int, rho: float) -> FloatArray:
    """Where in [0, 1] a falling slope passes zero; the better end if nowhere, a half if it is flat.

    `values` (degree + 1, k, B): of the polynomials at the nodes.
    """
    c = to_coefficients[:, 0, None, None] * values[0]
    for column, row in zip(to_coefficients.T[1:], values[1:], strict=True):
        c += column[:, None, None] * row
    size = c.shape[-1]
    three = np.zeros((3, size))
    three[1], three[2] = 0.5, 1.0
    c = _with_derivatives(c)
    (zero, half, one), _ = slope(three, c[..., None, :], n, rho)
    steep = (zero > FLAT) | (one < -FLAT)
    lo, hi = np.where(half > 0.0, 0.5, 0.0), np.where(half > 0.0, 1.0, 0.5)
    # start where (a + b t) / (1 + c t) through the three values is zero: it can follow a pole
    t = zero / (zero - one * (1.0 + (zero + one - 2.0 * half) / (half - one)))
    t = np.where((t >= lo) & (t <= hi), t, 0.5 * (lo + hi))
    t[~steep] = 0.5
    t[steep & (zero <= 0.0)] = 0.0
    t[steep & (one >= 0.0)] = 1.0
    busy = steep & (zero > 0.0) & (one < 0.0)
    out, todo = t, np.arange(size)
    for _ in range(ROUNDS):
        left = np.count_nonzero(busy)
        if left <= 0.6 * len(todo):
            out[todo] = t
            if not left:
                break
            at = np.flatnonzero(busy)
            todo, t, lo, hi, c, busy = todo[at], t[at], lo[at], hi[at], c[..., at], busy[at]
        h, dh = slope(t, c, n, rho)
        rising = h > 0.0
        np.copyto(lo, t, where=rising)
        np.copyto(hi, t, where=~rising)
        step = h / dh
        new = t - step
        outside = ~((new >= lo) & (new <= hi))
        if outside.any():
            np.copyto(new, 0.5 * (lo + hi), where=outside)
        np.copyto(t, new, where=busy)
        # h step is minus the squared Newton decrement: after this step about its square remains
        busy &= ~(np.abs(h * step + 0.5 * DONE) <= 0.5 * DONE) | outside
    else:
        out[todo] = t
    return out
