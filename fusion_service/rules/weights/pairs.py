"""The best weight of two sources, for a whole block of pairs at once.

Along one weight t, det M(t) and trace adj M(t) are polynomials of degree n (one more with a spread term).
Their values at both ends, what the inverses there tell of their slopes, and values at a few nodes between
give them. Meant for n <= `LIMIT`: beyond, interpolation loses too many digits, and `line` does the work.

For det and a plain sum, det M = sum e_k t^k (1-t)^(n-k) with all e_k >= 0, and with u = t / (1-t) the best t
is where q(u) = sum ((k+1) e_(k+1) - (n-k) e_k) u^k = 0, k < n. det M(u) has only real roots, so q has too
(Laguerre's theorem on the polar derivative), and at most one of them is positive: Laguerre's method goes
there from anywhere. For the rest a bracketed Newton iteration on the polynomials finds the best t.

The caller certifies the answer with `simplex.gap`, so a lost digit is noticed. An element is frozen when
it has converged: its bits do not depend on the others.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.linalg import total

__all__ = ["FLAT", "LIMIT", "Ends", "best_weight", "is_one", "of_elements"]

LIMIT = 6
ROUNDS = 60
FLAT = 1e-10
"""Relative slope below which a criterion does not care: the weight stays at a half."""
DONE = 1e-11
CLOSE = 3e-5
"""A relative step of Laguerre's method after which the error, about its cube, is nothing."""


Ends = tuple[Floats, Floats]


def best_weight(
    criterion: str, M: Ends, inverses: Ends, dets: Ends, *, bump: Floats | None = None, rho: float | Floats = 1.0
) -> Floats:
    """The t (B,) in [0, 1] with the largest det M(t), or the smallest trace M(t)^-1.

    M(t) = (1-t) M0 + t M1 + t(1-t) bump bump', with bump (n, B) or None; or, for rho < 1,
    M(t) = c(1-t) M0 + c(t) M1 with c(w) = w / ((1-rho) w + rho), rho one number or (B,) positive ones. `M` is
    (M0, M1), each (n, n, B); `inverses` and `dets` are theirs.
    """
    n, size = M[0].shape[0], M[0].shape[-1]
    degree = n + (bump is not None)
    first, last = linalg.inner(inverses[0], M[1]) - n, n - linalg.inner(inverses[1], M[0])  # slopes of log det
    if bump is not None:
        first += _form(inverses[0], bump)
        last -= _form(inverses[1], bump)
    slopes = min(2 if criterion == "det" else 1, degree - 1)
    t = _nodes(degree - 1 - slopes)
    between = _between(M, bump, t)
    det = np.empty((degree + 1, 1, size))
    det[:2, 0] = dets
    for row, slope, value in zip(det[2 : 2 + slopes, 0], (first, last), dets, strict=False):
        np.multiply(slope, value, out=row)
    if criterion == "det":
        if len(t):
            det[2 + slopes :, 0] = linalg.det(between)
        if bump is None and is_one(rho):
            q = _combine(_polar(n, slopes), det[:, 0])
            np.multiply(first, dets[0], out=q[0])
            np.multiply(last, dets[1], out=q[-1])
            return _laguerre(q, first, last)
        ends = (first, last) if is_one(rho) else ((first + n) / rho - rho * n, rho * n - (n - last) / rho)
        return _newton(_det_slope, _combine(_monomials(degree, slopes), det), n, rho, ends)
    adjugate = np.empty((2 + len(t), 1, size))
    for row, inverse, value in zip(adjugate[:2, 0], inverses, dets, strict=True):
        np.multiply(linalg.trace(inverse), value, out=row)
    if len(t):
        adjugate[2:, 0], det[2 + slopes :, 0] = linalg.trace_inverse_det(between)
        adjugate[2:] *= det[2 + slopes :]
    c = np.zeros((degree + 1, 2, size))
    c[:, :1] = _combine(_monomials(degree, slopes), det)
    c[: len(adjugate), 1:] = _combine(_monomials(len(adjugate) - 1, 0), adjugate)
    return _newton(_trace_slope, c, n, rho)


def is_one(rho: float | Floats) -> bool:
    """Whether this is the number 1, where nothing is bounded; (B,) numbers never are."""
    return isinstance(rho, float) and rho == 1.0


def of_elements(rho: float | Floats, at: Ints | Bools) -> float | Floats:
    """rho of some elements of the batch."""
    return rho if isinstance(rho, float) else rho[at]


def _between(M: Ends, bump: Floats | None, t: Floats) -> Floats:
    """M(t) at some nodes (K,), for rho = 1: lower triangles (n, n, K, B)."""
    n, size = M[0].shape[0], M[0].shape[-1]
    t = t[:, None]
    out = np.empty((n, n, len(t), size))
    for i in range(n if len(t) else 0):
        row = out[i, : i + 1]
        np.multiply(M[0][i, : i + 1, None], 1.0 - t, out=row)
        row += t * M[1][i, : i + 1, None]
        if bump is not None:
            row += (t * (1.0 - t)) * (bump[: i + 1] * bump[i])[:, None]
    return out


def _form(A: Floats, x: Floats) -> Floats:
    """x' A x (B,)."""
    return total(linalg.matvec(A, x) * x)


@cache
def _nodes(count: int) -> Floats:
    """The inner Chebyshev-Lobatto nodes of [0, 1]."""
    out: Floats = 0.5 - 0.5 * np.cos(np.pi * np.arange(1, count + 1) / (count + 1))
    return out


@cache
def _monomials(degree: int, slopes: int) -> Floats:
    """From values at 0 and 1, so many slopes there, and values at `_nodes` to coefficients in z = 2t - 1."""
    t = np.array([0.0, 1.0, *_nodes(degree - 1 - slopes)])
    rows = list(np.vander(2.0 * t - 1.0, degree + 1, increasing=True))
    k = np.arange(degree + 1.0)
    rows[2:2] = [2.0 * k * (-1.0) ** (k + 1), 2.0 * k][:slopes]
    return np.linalg.inv(np.array(rows, dtype=np.float64))


@cache
def _polar(n: int, slopes: int) -> Floats:
    """From the same to the coefficients of q(u)."""
    k = np.arange(n + 1.0)
    t = np.array([0.0, 1.0, *_nodes(n - 1 - slopes)])[:, None]
    rows = list(t**k * (1.0 - t) ** (n - k))
    first, last = (k == 1) - float(n) * (k == 0), float(n) * (k == n) - (k == n - 1)
    rows[2:2] = [first, last][:slopes]
    e = np.linalg.inv(np.array(rows))
    out: Floats = k[1:, None] * e[1:] - (n - k[:-1, None]) * e[:-1]
    return out


def _combine(matrix: Floats, values: Floats) -> Floats:
    columns = matrix.reshape(*matrix.shape, *(1,) * (values.ndim - 1))
    out: Floats = columns[:, 0] * values[0]
    for k in range(1, len(values)):
        out += columns[:, k] * values[k]
    return out


def _laguerre(q: Floats, first: Floats, last: Floats) -> Floats:
    """t where q(u) (n, B) is zero; the better end if nowhere, a half if it is flat."""
    steep = (first > FLAT) | (last < -FLAT)
    inside = steep & (first > 0.0) & (last < 0.0)
    out = np.where(steep, np.where(last >= 0.0, 1.0, 0.0), 0.5)
    todo = np.flatnonzero(inside)
    if not len(todo):
        return out
    whole = len(todo) == len(out)
    u, q = (first / -last, q) if whole else (first[todo] / -last[todo], q[:, todo])
    m = len(q) - 1
    for _ in range(ROUNDS):
        value, slope, bend = q[m] * u, q[m], None
        value += q[m - 1]
        for k in range(m - 2, -1, -1):
            bend = slope if bend is None else bend * u + slope
            slope = slope * u
            slope += value
            value *= u
            value += q[k]
        if bend is None:
            root: Floats | float = 0.0
        else:
            square = slope * slope
            square *= m - 1.0
            value *= 2.0 * m
            square -= value * bend
            square *= m - 1.0
            root = np.sqrt(np.maximum(square, 0.0, out=square), out=square)
            value *= 0.5 / m
        step = value
        step *= m
        step /= root - slope
        u = u + step
        busy = np.abs(step) > CLOSE * u
        left = np.count_nonzero(busy)
        if left < len(u):
            out[todo] = u / (1.0 + u)
            if not left:
                break
            todo, u, q = todo[busy], u[busy], q[:, busy]
    return out


def _with_derivatives(c: Floats) -> Floats:
    """(degree + 1, 3, k, B): coefficients of polynomials in z = 2t - 1 and of their two derivatives by t."""
    out = np.zeros((len(c), 3, *c.shape[1:]))
    power = 2.0 * np.arange(1, len(c))[:, None, None]
    out[:, 0] = c
    np.multiply(power, c[1:], out=out[:-1, 1])
    np.multiply(power[:-1], out[1:-1, 1], out=out[:-2, 2])
    return out


def _polynomials(t: Floats, c: Floats) -> Floats:
    """Values, first and second derivatives, (3, k, B), from `_with_derivatives`."""
    z = t + t - 1.0
    out: Floats = c[-1] * z
    out += c[-2]
    for row in c[-3::-1]:
        out *= z
        out += row
    return out


def _share(t: Floats, rho: float | Floats) -> tuple[Floats, ...]:
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


def _det_slope(t: Floats, c: Floats, n: int, rho: float | Floats) -> tuple[Floats, Floats]:
    """First and second derivative of log det M."""
    if is_one(rho):
        (f,), (df,), (ddf,) = _polynomials(t, c)
        first = df / f
        return first, ddf / f - first * first
    s, ds, dds, r, dr, ddr = _share(t, rho)
    (f,), (df,), (ddf,) = _polynomials(r, c)
    u, v = df / f, ds / s
    return u * dr + n * v, (ddf / f - u * u) * dr * dr + u * ddr + n * (dds / s - v * v)


def _trace_slope(t: Floats, c: Floats, n: int, rho: float | Floats) -> tuple[Floats, Floats]:
    """First and second derivative of -trace M^-1, over trace M^-1."""
    if is_one(rho):
        first, second = _log_ratio(t, c)
        return -first, -second
    s, ds, dds, r, dr, ddr = _share(t, rho)
    first, second = _log_ratio(r, c)
    u, v = first * dr, ds / s
    return v - u, dds / s + 2.0 * v * (u - v) - second * dr * dr - first * ddr


def _log_ratio(t: Floats, c: Floats) -> tuple[Floats, Floats]:
    """g'/g and g''/g of g = trace adj M / det M."""
    (f, a), (df, da), (ddf, dda) = _polynomials(t, c)
    u, v = da / a, df / f
    first = u - v
    return first, dda / a - 2.0 * first * v - ddf / f


Slope = Callable[[Floats, Floats, int, float | Floats], tuple[Floats, Floats]]


def _newton(slope: Slope, c: Floats, n: int, rho: float | Floats, ends: tuple[Floats, ...] = ()) -> Floats:
    """Where in [0, 1] a falling slope passes zero; the better end if nowhere, a half if it is flat.

    `c` (degree + 1, k, B): coefficients of the polynomials; `ends`: the slope at 0 and 1 where it is known.
    """
    size = c.shape[-1]
    c = _with_derivatives(c)
    if ends:
        (zero, one), (half, _) = ends, slope(np.full(size, 0.5), c, n, rho)
    else:
        three = np.zeros((3, size))
        three[1], three[2] = 0.5, 1.0
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
            todo, t, lo, hi, c, busy = todo[at], t[at], lo[at], hi[at], c.take(at, axis=-1), busy[at]
            rho = of_elements(rho, at)
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
