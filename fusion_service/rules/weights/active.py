"""The best weights of three sources and more by Newton's method on those that have any.

Most of the best weights are zero: half of the time one of three, eighteen of twenty. So a quadratic model of the
criterion is minimised over the whole simplex, by exchange of the sources that are held at zero, and its minimum is the
next point: sources are left out exactly, and come back. Of many sources that is done with a few of each fusion, those
that have weight and those with the steepest slope, and the slopes of all say which are to be in the next round.

What is found counts only where its own certificate, the gap of `simplex`, is small enough; the interior point does the
rest. Batch-last, float64 or longdouble; an element leaves when it has converged: its bits do not depend on the others.
"""

from typing import Protocol, Self

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.linalg import matvec, product, total, trace
from fusion_service.rules.weights import simplex
from fusion_service.rules.weights.simplex import gap, gradient

__all__ = ["DONE", "Model", "best_weights"]

DONE = 0.1 * simplex.GAP
THREE = 3
"""Of so many the minimum of the quadratic model is in closed form."""
SETS = (4, 6, 6, 8, 8)
"""Of more sources, so many are looked at together, in round after round."""
ROUNDS, EXCHANGES = 10, 12
POWER = 2
"""Of the slopes, by which equal weights are multiplied to begin with."""
NEAR = 1.0
"""Size of a step, in the metric of the second derivatives, up to which it is taken whole."""
MIX = 0.05
"""What each has at least when another round begins, so that none is held at zero by a wall."""
RIDGE, SLACK = 1e-8, 1e-12
"""Of the second derivatives, relatively; slope of what is held at zero that counts as none."""


class Model(simplex.Model, Protocol):
    """A model of which some sources can be taken."""

    def take(self, index: Bools | Ints) -> Self:
        """The model of some elements of the batch."""

    def of(self, which: Ints) -> Self:
        """The model of the sources `which` (K, B) of each element: the others have no weight."""


def best_weights(
    criterion: str, model: Model, uniform: Floats, near: Floats | None = None, enough: float = DONE
) -> Floats:
    """The best weights (N, B), as `simplex.best_weights`; `uniform` are equal ones (N, B).

    `near`, any numbers (N, B), are begun with where they are weights; then a gap of `enough` ends the search. Where
    equal weights are the best, they are given.
    """
    w, good = np.array(uniform), np.zeros(uniform.shape[1], np.bool_)
    usable = np.zeros_like(good)
    if near is not None:
        w = near / total(near)
        usable = (w.min(axis=0) >= 0.0) & (total(w) > 0.5)
    fresh = np.flatnonzero(~usable)
    if len(fresh):
        w[:, fresh], good[fresh] = _guess(criterion, _part(model, fresh, w), uniform[:, fresh])
    many = np.count_nonzero(w, axis=0) >= SETS[0]
    for which, limit, sets in (
        (usable & ~many, enough, SETS),
        (usable & many, enough, SETS[2:]),
        (~usable & ~good, DONE, SETS),
    ):
        some = np.flatnonzero(which)
        if len(some):
            w[:, some], good[some] = _improved(criterion, _part(model, some, w), w[:, some], limit, sets)
    rest = np.flatnonzero(~good)
    if len(rest):
        w[:, rest] = simplex.best_weights(criterion, model.take(rest), uniform[:, rest])
    return w


def _part(model: Model, at: Ints, w: Floats) -> Model:
    return model if len(at) == w.shape[1] else model.take(at)


def _guess(criterion: str, model: Model, w: Floats) -> tuple[Floats, Bools]:
    """Weights (N, B), the larger, the steeper the slope is at equal weights `w`; these where they are the best (B,)."""
    g = _slopes(criterion, model, w)
    best = gap(w, g) <= DONE
    steep = w * g**POWER
    return np.where(best, w, steep / total(steep)), best


def _slopes(criterion: str, model: Model, w: Floats) -> Floats:
    M, D = model(w)
    return gradient(criterion, linalg.inverse(M), D)


def _improved(
    criterion: str, model: Model, start: Floats, enough: float, sets: tuple[int, ...]
) -> tuple[Floats, Bools]:
    """Weights (N, B) from `start`, and whether their gap is at most `enough` (B,)."""
    N, size = start.shape
    if SETS[0] >= N:
        return _newton(criterion, model, start, enough)
    out, good, todo, w = np.array(start), np.zeros(size, np.bool_), np.arange(size), start
    g = _slopes(criterion, model, w)
    for number, most in enumerate(sets):
        which = np.lexsort((g, -w), axis=0)[:most]
        some = np.take_along_axis(w, which, axis=0)
        some = some / total(some) + MIX * (number > 0)
        some, _ = _newton(criterion, model.of(which), some / total(some), 0.5 * enough)
        w = np.zeros_like(w)
        np.put_along_axis(w, which, some, axis=0)
        g = _slopes(criterion, model, w)
        left = gap(w, g)
        out[:, todo], good[todo] = w, left <= enough
        busy = np.flatnonzero(left > enough)
        if most >= N or not len(busy):
            break
        todo, w, g, model = todo[busy], w[:, busy], g[:, busy], model.take(busy)
    return out, good


def _newton(criterion: str, model: Model, w: Floats, enough: float) -> tuple[Floats, Bools]:
    """The same with all sources at once."""
    out, good, todo = np.array(w), np.zeros(w.shape[1], np.bool_), np.arange(w.shape[1])
    for last in range(ROUNDS, -1, -1):
        M, D = model(w)
        V = linalg.inverse(M)
        g = gradient(criterion, V, D)
        left = gap(w, g)
        out[:, todo], good[todo] = w, left <= enough
        busy = np.flatnonzero(left > enough)
        if not last or not len(busy):
            break
        if len(busy) < len(todo):
            todo, model, w, g, V, D = todo[busy], model.take(busy), w[:, busy], g[:, busy], V[..., busy], D[..., busy]
        H = _curvature(criterion, model, w, V, D)
        x = _minimum(H, g - matvec(H, w), w > 0.0)
        step = x - w
        size = np.sqrt(np.maximum(total(step * matvec(H, step)), 0.0))
        w = np.where(size <= NEAR, x, w + step / (1.0 + size))
    return out, good


def _curvature(criterion: str, model: Model, w: Floats, V: Floats, D: Floats) -> Floats:
    """`simplex.hessian`, of each pair once, with a ridge."""
    E = product(V[:, :, None], D)
    if criterion == "det":
        F, G = E, V
    else:
        scale = 1.0 / trace(V)
        F, G = product(E, V[:, :, None]), product(V, V) * scale
        F *= 2.0 * scale
    H = np.empty((*w.shape[:1], *w.shape), w.dtype)
    for i in range(len(w)):
        row = F[0, 0, i] * E[0, 0, : i + 1]
        term = np.empty_like(row)
        for a in range(len(V)):
            for b in range(len(V)):
                if a or b:
                    row += np.multiply(F[a, b, i], E[b, a, : i + 1], out=term)
        H[i, : i + 1] = row
    bend = model.bend(w, G)
    if bend is not None:
        H += bend
    for i in range(len(w)):
        H[i, i] *= 1.0 + RIDGE
        H[:i, i] = H[i, :i]
    return H


def _minimum(H: Floats, c: Floats, free: Bools) -> Floats:
    """The x (N, B) >= 0 of sum 1 with the smallest c'x + x'Hx/2, for H (N, N, B) and c (N, B); `free` (N, B): those
    that may be positive."""
    if len(c) == THREE:
        return _of_three(H, c)
    N = len(c)
    out, todo = np.empty_like(c), np.arange(c.shape[1])
    for number in range(EXCHANGES):
        part = np.where(free[:, None] & free, H, 0.0)
        for i in range(N):
            part[i, i] += ~free[i]
        a, b = _solved(part, np.where(free, c, 0.0), free.astype(c.dtype))
        nu = (1.0 + total(a)) / total(b)
        x = nu * b - a
        pull = c + matvec(H, x) - nu
        wrong = np.where(free, x < 0.0, pull < -SLACK)
        if number >= 3:  # the first alone: what is exchanged together may go in circles
            wrong[1:] &= ~np.logical_or.accumulate(wrong, axis=0)[:-1]
        x = np.maximum(x, 0.0)
        out[:, todo] = x / total(x)
        busy = np.flatnonzero(wrong.any(axis=0))
        if not len(busy):
            break
        todo, H, c = todo[busy], H[..., busy], c[:, busy]
        free = (free ^ wrong)[:, busy]
    return out


def _solved(P: Floats, *columns: Floats) -> Floats:
    """P^-1 x (N, B) of each column x."""
    L, d = linalg.ldl(P)
    y = np.stack(columns, axis=1)
    for k in range(len(L) - 1):
        y[k + 1 :] -= L[k + 1 :, k, None] * y[k]
    y /= d[:, None]
    for k in range(len(L) - 1, 0, -1):
        y[:k] -= L[k, :k, None] * y[k]
    return y.swapaxes(0, 1)


def _of_three(H: Floats, c: Floats) -> Floats:
    """The same of three: inside, or the best of the three edges. By y = (x_1, x_2)."""
    p, q, r = H[1, 1] - H[0, 1], H[2, 2] - H[0, 2], H[1, 2] - H[0, 2]
    far, side = H[0, 0] - H[0, 1], H[0, 0] - H[0, 2]
    p, q, r = p + far, q + side, r + far  # second derivatives, by y_1, y_2 and both
    b, d = c[1] - c[0] - far, c[2] - c[0] - side
    t = np.stack([-b / p, -d / q, (b - d + p - r) / (p + q - 2.0 * r)])
    t = np.clip(np.where(np.isfinite(t), t, 0.0), 0.0, 1.0)
    edges = np.zeros((3, 3, len(b)), c.dtype)
    for edge, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        edges[i, edge], edges[j, edge] = 1.0 - t[edge], t[edge]
    _, y, z = edges
    value = y * (b + 0.5 * p * y + r * z) + z * (d + 0.5 * q * z)
    best, low = edges[:, 0], value[0]
    for i in (1, 2):
        less = value[i] < low
        best, low = np.where(less, edges[:, i], best), np.where(less, value[i], low)
    det = p * q - r * r
    y, z = (r * d - q * b) / det, (r * b - p * d) / det
    x = 1.0 - y - z
    inside = (det > 0.0) & (y > 0.0) & (z > 0.0) & (x > 0.0)
    return np.where(inside, np.stack([x, y, z]), best)
