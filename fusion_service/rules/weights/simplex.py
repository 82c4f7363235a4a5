"""The best weights of any number of sources, for a whole block of fusions at once.

The problem: over weights w >= 0 that sum to 1, make -log det M(w), or log trace M(w)^-1, smallest. M is
concave in w as a matrix, so det M^-1 and trace M^-1 are convex, and with g the gradient

    gap(w) = sum_i w_i g_i - min_i g_i

bounds how far (relatively) w is from the best. For CI with `det` it is the certificate of D-optimal
design, max_i tr(P_i^-1 M^-1) - n. A primal-dual interior-point method with Newton's second derivatives
finds w; a barrier function with backtracking keeps it safe at any scale.

Batch-last, float64 or longdouble. An element leaves the iteration when it has converged: its bits do not
depend on the others.
"""

from typing import Protocol, Self

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats
from fusion_service.linalg import inner, product, total, trace
from fusion_service.rules.base.matrices import diagonal

__all__ = ["GAP", "Model", "best_weights", "gap", "gradient"]

GAP = 1e-9
"""Weights whose gap is below this are optimal."""
ROUNDS = 60


class Model(Protocol):
    """A concave matrix function of N weights."""

    def __call__(self, w: Floats, /) -> tuple[Floats, Floats]:
        """M (n, n, B) and dM/dw_i (n, n, N, B), the latter up to a matrix common to all i."""

    def bend(self, w: Floats, G: Floats, /) -> Floats | None:
        """-tr(G d2M/dw_i dw_j) (N, N, B) for G >= 0: positive semidefinite. None where M is linear."""

    def take(self, index: Bools) -> Self:
        """The model of some elements of the batch."""


def gap(w: Floats, g: Floats) -> Floats:
    """Optimality gap (B,) of weights w (N, B) with gradient g (N, B)."""
    out: Floats = total(w * g) - g.min(axis=0)
    return out


def gradient(criterion: str, V: Floats, D: Floats) -> Floats:
    """Gradient (N, B) of -log det M or log trace M^-1, from V = M^-1 (n, n, B) and D = dM/dw (n, n, N, B)."""
    if criterion == "det":
        return -inner(V[:, :, None], D)
    return -inner(product(V, V)[:, :, None], D) / trace(V)


def _evaluate(criterion: str, model: Model, w: Floats) -> tuple[Floats, Floats, Floats]:
    """V, D and the value of the criterion."""
    M, D = model(w)
    V, det, _ = linalg.sweep(M)
    return V, D, -np.log(det) if criterion == "det" else np.log(trace(V))


def best_weights(criterion: str, model: Model, start: Floats) -> Floats:
    """The best weights (N, B), from a positive `start` that sums to 1.

    Sources that a best weighting leaves out get exactly zero. Check with `gap`: hopeless input comes back
    as it is.
    """
    N, size = start.shape
    best, slack = np.array(start), np.zeros_like(start)
    todo, active, w = np.arange(size), model, np.array(start)
    V, D, value = _evaluate(criterion, model, w)
    g = gradient(criterion, V, D)
    s = g - g.min(axis=0) + np.maximum(gap(w, g), 1e-3)
    centring = np.full(size, 0.1, start.dtype)
    for _ in range(ROUNDS):
        target = np.maximum(total(w * s) / N, 1e-13)
        best[:, todo], slack[:, todo] = w, s
        busy = gap(w, g) > 0.01 * GAP
        if not busy.all():
            todo, active = todo[busy], active.take(busy)
            w, s, g, V, D = w[:, busy], s[:, busy], g[:, busy], V[..., busy], D[..., busy]
            value, centring, target = value[busy], centring[busy], target[busy]
        if not len(todo):
            break
        mu = centring * target
        dw = _direction(_hessian(criterion, active, w, V, D) + diagonal(s / w), g - mu / w)
        ds = mu / w - s - (s / w) * dw
        step, dual = _room(w, dw), _room(s, ds)
        barrier = value - mu * total(np.log(w))
        fall = total(dw * (g - mu / w))
        pending = np.ones(len(todo), dtype=np.bool_)
        for _ in range(40):
            trial = w + step * dw
            V, D, value = _evaluate(criterion, active, trial)
            bound = barrier + 1e-4 * step * fall + 1e-9 * (1.0 + np.abs(barrier))  # gross failures only
            pending &= ~(value - mu * total(np.log(trial)) <= bound)
            if not pending.any():
                break
            step = np.where(pending, 0.5 * step, step)
        w, s = trial / total(trial), s + dual * ds
        g = gradient(criterion, V, D)
        centring = np.maximum(0.003, (1.0 - np.minimum(step, dual)) ** 2)
    return _without_idle(criterion, model, best, slack)


def _without_idle(criterion: str, model: Model, w: Floats, s: Floats) -> Floats:
    """Set to zero the weights that the constraint holds, where the result is still optimal."""
    clean = np.where(w < s, 0.0, w)
    clean = clean / total(clean)
    V, D, _ = _evaluate(criterion, model, clean)
    return np.where(gap(clean, gradient(criterion, V, D)) <= 0.1 * GAP, clean, w)


def _room(x: Floats, dx: Floats) -> Floats:
    """The longest step (B,), at most 1, that keeps x positive."""
    limits = np.where(dx < 0.0, -0.99 * x / dx, 1.0)
    out: Floats = np.minimum(limits.min(axis=0), 1.0)
    return out


def _hessian(criterion: str, model: Model, w: Floats, V: Floats, D: Floats) -> Floats:
    """Second derivatives (N, N, B): of -log det M; of trace M^-1, over trace M^-1."""
    E = product(V[:, :, None], D)
    if criterion == "det":
        F, G = E, V
    else:
        scale = 1.0 / trace(V)
        F, G = product(E, V[:, :, None]) * (2.0 * scale), product(V, V) * scale
    H = np.zeros((*w.shape[:1], *w.shape), w.dtype)
    for a in range(len(V)):
        for b in range(len(V)):
            H += F[a, b][:, None] * E[b, a][None]
    bend = model.bend(w, G)
    if bend is not None:
        H += bend
    return H


def _direction(H: Floats, residual: Floats) -> Floats:
    """Newton's step within sum(dw) = 0."""
    a = linalg.solve(H, residual)
    b = linalg.solve(H, np.ones_like(residual))
    out: Floats = (total(a) / total(b)) * b - a
    return out
