"""The weight of two sources at which a rising slope passes zero: bracketed Newton steps, for many pairs at once.

An element is frozen when it has converged: its bits do not depend on the others.
"""

from collections.abc import Callable

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.rules.weights.pairs import FLAT

__all__ = ["Slope", "root", "slopes_at_ends"]

ROUNDS = 100
DONE, STEEP = 1e-11, 3e-6
"""Stop where a Newton step gains less than the one, relatively, from a slope below the other."""

Slope = Callable[[Floats, Floats, Floats], tuple[Floats, Floats]]
"""First and second derivative (B,) of a criterion by t, at t and u = 1 - t (B,), of data (..., B)."""


def slopes_at_ends(slope: Slope, data: Floats) -> tuple[Floats, Floats]:
    """The first derivative (B,) at t = 0 and at t = 1."""
    zero, one = np.zeros_like(data[0, 0]), np.ones_like(data[0, 0])
    return slope(zero, one, data)[0], slope(one, zero, data)[0]


def root(slope: Slope, data: Floats, zero: Floats, one: Floats) -> Floats:
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
            todo, v, lo, hi, busy, flip = todo[at], v[at], lo[at], hi[at], busy[at], flip[at]
            data = data.take(at, axis=-1)
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
