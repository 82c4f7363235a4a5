"""Weights where the problem is not convex.

Two sources: the lowest of `POINTS` equally spaced weights, refined by golden sections; of equally low ones
that nearest to equal weights. More: a local minimum, by BFGS from equal weights in the logarithms of the
weights, with central differences. Neither depends on the order of the sources.
"""

from collections.abc import Callable

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.linalg import outer, total
from fusion_service.rules.base.block import Sources

__all__ = ["Cost", "lowest"]

POINTS = 65
GOLDEN = (5.0**0.5 - 1.0) / 2.0
SECTIONS = 36
ROUNDS = 80
STEP = 1e-5
"""Of the central differences, in logarithms."""

Cost = Callable[[Floats], Floats]
"""Of weights (N, B): (B,)."""


def lowest(cost: Cost, sources: Sources) -> Floats:
    """Weights (N, B) with a low cost."""
    if sources.count == 1:
        return sources.uniform

    def safe(w: Floats) -> Floats:
        value = cost(w)
        return np.where(np.isnan(value), np.inf, value)

    return _scan(safe, sources.uniform) if sources.count == 2 else _descend(safe, sources.uniform)


def _scan(cost: Cost, w: Floats) -> Floats:
    def value(t: Floats) -> Floats:
        return cost(np.stack([t, 1.0 - t]))

    best, low = w[0], np.full_like(w[0], np.inf)
    for t in sorted(np.linspace(0.0, 1.0, POINTS), key=lambda t: abs(t - 0.5)):
        here = value(np.full_like(best, t))
        better = here < low - 1e-12 * np.maximum(1.0, np.abs(here))
        best, low = np.where(better, t, best), np.where(better, here, low)
    lo, hi = np.maximum(best - 1.0 / (POINTS - 1), 0.0), np.minimum(best + 1.0 / (POINTS - 1), 1.0)
    left, right = hi - GOLDEN * (hi - lo), lo + GOLDEN * (hi - lo)
    at_left, at_right = value(left), value(right)
    for _ in range(SECTIONS):
        down = at_left <= at_right
        lo, hi = np.where(down, lo, left), np.where(down, right, hi)
        new = np.where(down, hi - GOLDEN * (hi - lo), lo + GOLDEN * (hi - lo))
        here = value(new)
        left, right = np.where(down, new, right), np.where(down, left, new)
        at_left, at_right = np.where(down, here, at_right), np.where(down, at_left, here)
    middle = 0.5 * (lo + hi)
    best = np.where(value(middle) < low, middle, best)
    return np.stack([best, 1.0 - best])


def _descend(cost: Cost, w: Floats) -> Floats:
    N = len(w)
    z = np.zeros_like(w)
    identity = np.zeros((N, *w.shape), w.dtype)
    identity[range(N), range(N)] = 1.0
    H, here, g = identity, cost(w), _slope(cost, z)
    moving = np.ones(w.shape[1], dtype=np.bool_)
    for _ in range(ROUNDS):
        dz = -linalg.matvec(H, g)
        dz *= 1.0 / np.maximum(1.0, np.abs(dz).max(axis=0))  # at most a factor e
        fall, length = total(dz * g), np.ones_like(here)
        low, pending = here, moving
        for _ in range(20):
            value = cost(_weights(z + length * dz))
            pending = moving & ~(value <= here + 1e-4 * length * fall)
            low = np.where(pending, low, value)
            if not pending.any():
                break
            length = np.where(pending, 0.5 * length, length)
        moving = moving & ~pending & (here - low > 1e-12 * np.maximum(1e-6, np.abs(here)))
        if not moving.any():
            break
        moved = np.where(moving, length * dz, 0.0)
        z, here = z + moved, np.where(moving, low, here)
        new = _slope(cost, z)
        y = new - g
        curved = total(y * moved)
        Hy = linalg.matvec(H, y)
        update = (1.0 + total(y * Hy) / curved) * outer(moved, moved) - outer(Hy, moved) - outer(moved, Hy)
        H = np.where(moving & (curved > 1e-14), H + update / curved, H)
        g = np.where(moving, new, g)
    return _weights(z)


def _weights(z: Floats) -> Floats:
    w = np.exp(z - z.max(axis=0))
    out: Floats = w / total(w)
    return out


def _slope(cost: Cost, z: Floats) -> Floats:
    out = np.empty_like(z)
    for i in range(len(z)):
        for sign in (1.0, -1.0):
            there = np.array(z)
            there[i] += sign * STEP
            value = cost(_weights(there))
            out[i] = value if sign > 0.0 else (out[i] - value) / (2.0 * STEP)
    return out
