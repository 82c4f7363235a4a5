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
ROUNDS = 80
FLAT = 1e-10
"""Relative slope below which a criterion does not care: the weight stays at a half."""


def best_weight(
    criterion: str,
    M0: FloatArray,
    M1: FloatArray,
    *,
    bump: FloatArray | None = None,
    rho: float = 1.0,
) -> FloatArray:
    """The t (B,) in [0, 1] with the largest det M(t), or the smallest trace M(t)^-1.

    M(t) = (1-t) M0 + t M1 + t(1-t) bump bump', with bump (n, B) or None; or, for rho < 1,
    M(t) = c(1-t) M0 + c(t) M1 with c(w) = w / ((1-rho) w + rho).
    """
    n, size = M0.shape[0], M0.shape[-1]
    degree = n + (bump is not None)
    nodes, to_coefficients = _nodes(degree)
    t = nodes[:, None]
    M = np.empty((n, n, degree + 1, size))
    difference = M1 - M0
    for i in range(n):
        M[i, : i + 1] = M0[i, : i + 1, None] + t * difference[i, : i + 1, None]
        if bump is not None:
            M[i, : i + 1] += (t * (1.0 - t)) * (bump[: i + 1] * bump[i])[:, None]
    if criterion == "det":
        values = linalg.det(M)[:, None]
    else:
        inverse, det, _ = linalg.sweep(M)
        values = np.stack([det, det * linalg.trace(inverse)], axis=1)
    # (degree + 1, 1 or 2, B): the coefficients of det M, and of trace adj M
    coefficients = linalg.total(to_coefficients.T[:, :, None, None] * values[:, None])
    slope = _det_slope if criterion == "det" else _trace_slope
    return _newton(lambda t, c: slope(t, c, n, rho), coefficients)


@cache
def _nodes(degree: int) -> tuple[FloatArray, FloatArray]:
    """Chebyshev-Lobatto nodes on [0, 1] and the matrix from values there to coefficients in z = 2t - 1."""
    z = -np.cos(np.pi * np.arange(degree + 1) / degree)
    return 0.5 + 0.5 * z, np.linalg.inv(np.vander(z, increasing=True))


def _polynomials(t: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Values, first and second derivatives by t, each like t, of polynomials c (degree + 1, B) in 2t - 1."""
    z = t + t - 1.0
    f: FloatArray = c[-1] * z + c[-2]
    df: FloatArray = c[-1].copy()
    ddf: FloatArray = np.zeros_like(f)
    for row in c[-3::-1]:
        ddf = ddf * z + df
        df = df * z + f
        f = f * z + row
    return f, 2.0 * df, 8.0 * ddf


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
        f, df, ddf = _polynomials(t, c[:, 0])
        first = df / f
        return first, ddf / f - first * first
    s, ds, dds, r, dr, ddr = _share(t, rho)
    f, df, ddf = _polynomials(r, c[:, 0])
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
    f, df, ddf = _polynomials(t, c[:, 0])
    a, da, dda = _polynomials(t, c[:, 1])
    u, v = da / a, df / f
    first = u - v
    return first, dda / a - 2.0 * first * v - ddf / f


Slope = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]


def _newton(slope: Slope, coefficients: FloatArray) -> FloatArray:
    """Where in [0, 1] a falling function passes zero; the better end if nowhere, a half if it is flat."""
    size = coefficients.shape[-1]
    at_zero, _ = slope(np.zeros(size), coefficients)
    at_one, _ = slope(np.ones(size), coefficients)
    out = np.full(size, 0.5)
    steep = (at_zero > FLAT) | (at_one < -FLAT)
    out[steep & (at_zero <= 0.0)] = 0.0
    out[steep & (at_one >= 0.0)] = 1.0
    todo = np.flatnonzero(steep & (at_zero > 0.0) & (at_one < 0.0))
    t, lo, hi = out[todo], np.zeros(len(todo)), np.ones(len(todo))
    c = coefficients[..., todo] if len(todo) < size else coefficients
    for _ in range(ROUNDS):
        if not len(todo):
            break
        h, dh = slope(t, c)
        rising = h > 0.0
        np.copyto(lo, t, where=rising)
        np.copyto(hi, t, where=~rising)
        step = h / dh
        new = t - step
        inside = (new > lo) & (new < hi)
        new = np.where(inside, new, 0.5 * (lo + hi))
        out[todo] = new
        # the first-order gain still to be had is |h step|
        busy = ~(inside & (np.abs(h * step) < 1e-14)) & (hi - lo > 1e-16)
        if busy.all():
            t = new
        else:
            todo, t, lo, hi, c = todo[busy], new[busy], lo[busy], hi[busy], c[..., busy]
    return out
