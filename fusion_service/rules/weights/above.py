"""The smallest matrix above several, by det or trace, for a whole block at once.

    least c(P)  over  P >= U_i for every i,     c = log det P  or  trace P

With P_0 = F F' above them all, U_i = F G_i G_i' F'. By det with X = (F^-1 P F^-T)^-1, by trace with X = F^-1 P F^-T,
the problem and its dual are

    det:    least -log det X,  S_i = I - G_i' X G_i >= 0      most log det W + n - sum tr Z_i,   W = sum G_i Z_i G_i'
    trace:  least tr C X,      S_i = X - G_i G_i' >= 0        most sum tr Z_i G_i G_i',          sum Z_i = C = F'F

A primal-dual method with a predictor and a corrector (Mehrotra 1992; Helmberg, Rendl, Vanderbei and Wolkowicz 1996 for
the direction, Toh 1999 for log det) goes from within to Z_i S_i = 0 in about fifteen rounds. At each X and Z_i >= 0 the
difference of the two values is a certificate, the gap: by det, whatever Z_i, `sum tr Z_i S_i + tr XW - n - log det XW`.

How far a step may go is told by traces: the least eigenvalue of a matrix with eigenvalues of mean m and variance s^2 is
at least m - s sqrt(n - 1) (Wolkowicz and Styan 1980); asked again from there, it is nearly reached.

Batch-last, float64 or longdouble. An element leaves when it is found, or no longer gains: its bits do not depend on the
others.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.linalg import inner, product, total, trace
from fusion_service.rules.base.matrices import lower_inverse

__all__ = ["GAP", "smallest_above"]

GAP = 2e-10
"""Relative distance from the smallest det or trace at which an element is found."""
ROUNDS = 60
IDLE = 6
"""Rounds in which the gap is not halved after which an element is left as it is."""
SHORT = 0.95
"""Of the way to where a matrix would be singular."""


class _Point(NamedTuple):
    """Where the search stands, for some elements. T (n, n, M, B): S_i, Z_i and, by det, X; V: their inverses."""

    X: Floats
    T: Floats
    V: Floats


@dataclass(frozen=True, slots=True)
class _Problem:
    """ends (n, n, N, B): G_i by det, G_i G_i' by trace; C (n, n, B), None by det."""

    ends: Floats
    C: Floats | None

    def take(self, some: Any) -> _Problem:
        return _Problem(self.ends[..., some], None if self.C is None else self.C[..., some])

    @property
    def count(self) -> int:
        return int(self.ends.shape[2])

    def slack(self, X: Floats) -> Floats:
        """S_i (n, n, N, B)."""
        if self.C is not None:
            return X[:, :, None] - self.ends
        return np.eye(len(X), dtype=X.dtype)[:, :, None, None] - self.within(X)

    def within(self, D: Floats) -> Floats:
        """G_i' D G_i (n, n, N, B)."""
        return _even(product(product(self.ends.swapaxes(0, 1), _beside(D, self.count)), self.ends))

    def change(self, D: Floats) -> Floats:
        """That of S_i by one of X."""
        return _beside(D, self.count) if self.C is not None else -self.within(D)

    def outside(self, M: Floats) -> Floats:
        """G_i M_i G_i' (n, n, N, B), or M_i (by trace), of M; a multiple of N of them."""
        if self.C is not None:
            return M
        ends = self.ends if M.shape[2] == self.count else np.concatenate([self.ends, self.ends], axis=2)
        return _even(product(product(ends, M), ends.swapaxes(0, 1)))


def smallest_above(criterion: str, start: Floats, U: Floats) -> tuple[Floats, Floats]:
    """The P (n, n, B) of least `criterion`, "det" or "trace", above every U (n, n, N, B), and its gap (B,); `start` is
    one above them. Where nothing within .1 is found the gap is infinite."""
    n, _, _, size = U.shape
    L, d = linalg.ldl(start)
    F = L * np.sqrt(d)
    K, pivots = linalg.ldl(U)
    G = product(lower_inverse(F)[:, :, None] + np.zeros_like(U), K * np.sqrt(pivots))  # G G' is at most I
    identity = np.zeros_like(start)
    identity[range(n), range(n)] = 1.0
    if criterion == "det":
        problem, X = _Problem(G, None), 0.5 * identity
    else:
        C = product(F.swapaxes(0, 1), F)
        problem, X = _Problem(product(G, G.swapaxes(0, 1)), C / trace(C)), 2.0 * identity
    best, gap = np.array(X), np.full(size, np.inf, start.dtype)
    for todo, found, new in _search(problem, _begin(problem, X)):
        better = new < gap[todo]
        best[..., todo[better]], gap[todo[better]] = found[..., better], new[better]
    P = linalg.congruence(F, linalg.inverse(best) if criterion == "det" else best)
    return P, np.where(gap < 0.1, gap, np.inf)


def _begin(problem: _Problem, X: Floats) -> _Point:
    """Z_i = mu S_i^-1, mu such that the dual residual has no trace."""
    S = problem.slack(X)
    V = linalg.inverse(S)
    spread = total(np.moveaxis(problem.outside(V), 2, 0))
    mu = len(X) / inner(X, spread) if problem.C is None else 1.0 / trace(spread)
    T, inverse = [S, V * mu], [V, S / mu]
    if problem.C is None:
        T, inverse = [*T, X[:, :, None]], [*inverse, 1.0 / X[:1, :1, None] * np.eye(len(X))[:, :, None, None]]
    return _Point(X, np.concatenate(T, axis=2), np.concatenate(inverse, axis=2))


def _search(problem: _Problem, at: _Point) -> Iterator[tuple[Any, Floats, Floats]]:
    """Elements that are still sought, their X, and the gap there, round by round."""
    size = at.X.shape[-1]
    todo, idle = np.arange(size), np.zeros(size, dtype=np.intp)
    lowest = np.full(size, np.inf, at.X.dtype)
    for _ in range(ROUNDS):
        shares, distance, gap = _look(problem, at)
        yield todo, at.X, gap
        better = gap < 0.5 * lowest
        lowest, idle = np.where(better, gap, lowest), np.where(better, 0, idle + 1)
        busy = (gap > GAP) & (idle < IDLE)
        if not busy.all():
            if not busy.any():
                return
            todo, idle, lowest, problem = todo[busy], idle[busy], lowest[busy], problem.take(busy)
            at = _Point(*(one[..., busy] for one in at))
            shares, distance = shares[..., busy], distance[busy]
        at = _step(problem, at, shares, distance)


def _look(problem: _Problem, at: _Point) -> tuple[Floats, Floats, Floats]:
    """G_i Z_i G_i' above G_i S_i^-1 G_i' (n, n, 2N, B); sum tr Z_i S_i (B,); the gap (B,), NaN where a matrix is not
    positive definite."""
    N = problem.count
    S, Z, V = at.T[:, :, :N], at.T[:, :, N : 2 * N], at.V[:, :, :N]
    distance = total(inner(Z, S))
    shares = problem.outside(np.concatenate([Z, V], axis=2))
    both = total(np.moveaxis(shares[:, :, :N], 2, 0))
    if problem.C is None:
        beyond = inner(at.X, both) - len(both) - linalg.logdet(at.X) - linalg.logdet(both)
        gap = distance + np.maximum(beyond, 0.0)
    else:
        gap = (distance + np.abs(inner(problem.C - both, at.X))) / inner(problem.C, at.X)
    sound = at.V[range(len(at.V)), range(len(at.V))].min(axis=(0, 1)) > 0.0
    return shares, distance, np.where(sound, gap, np.nan)


def _step(problem: _Problem, at: _Point, shares: Floats, distance: Floats) -> _Point:
    """The next point: along the direction to the goal, corrected by what its first guess leaves."""
    N, n = problem.count, len(at.X)
    S, Z, V = at.T[:, :, :N], at.T[:, :, N : 2 * N], at.V[:, :, :N]
    A, B = shares[:, :, :N], shares[:, :, N:]
    spread = total(np.moveaxis(B, 2, 0))
    goal = at.V[:, :, 2 * N] if problem.C is None else problem.C
    Y = goal if problem.C is None else None
    H = _curvature(A, B, Y)

    def direction(mu: Floats, left: Floats | None) -> tuple[Floats, Floats]:
        """Of X, and of T, towards Z_i S_i = mu I, less what is `left` of second order."""
        right = mu * spread - goal
        if left is not None:
            right = right + total(np.moveaxis(problem.outside(left), 2, 0))
        D = _solved(H, right if Y is None else -right)
        dS = problem.change(D)
        dZ = mu * V - Z - _even(product(product(Z, dS), V))
        parts = [dS, dZ if left is None else dZ + left]
        return D, np.concatenate(parts if Y is None else [*parts, D[:, :, None]], axis=2)

    _, dT = direction(np.zeros_like(distance), None)
    primal, dual = (np.minimum(one, 1.0) for one in _rooms(at.V, dT, N))
    reached = total(inner(Z + dual * dT[:, :, N : 2 * N], S + primal * dT[:, :, :N]))
    centring = np.clip(reached / distance, 1e-3, 1.0)
    left = -_even(product(product(dT[:, :, N : 2 * N], dT[:, :, :N]), V))
    D, dT = direction(centring * centring * distance / (N * n), left)
    primal, dual = (np.minimum(SHORT * one, 1.0) for one in _rooms(at.V, dT, N))
    more = _rooms(linalg.inverse(_moved(at.T, dT, primal, dual, N)), dT, N)
    primal, dual = (
        np.where(one < 1.0, np.minimum(one + SHORT * rest, 1.0), 1.0)
        for one, rest in zip((primal, dual), more, strict=True)
    )
    X, T = at.X + primal * D, _moved(at.T, dT, primal, dual, N)
    T[:, :, :N] = problem.slack(X)
    return _Point(X, T, linalg.inverse(T))


def _moved(T: Floats, dT: Floats, primal: Floats, dual: Floats, N: int) -> Floats:
    out = T + primal * dT
    out[:, :, N : 2 * N] = T[:, :, N : 2 * N] + dual * dT[:, :, N : 2 * N]
    return out


def _rooms(V: Floats, D: Floats, N: int) -> tuple[Floats, Floats]:
    """How far (B,) T can go along D, as far as traces tell, and stay positive definite: S and X, and Z. V = T^-1."""
    n = len(V)
    E = product(V, D)
    mean, square = trace(E) / n, total(total(E * E.swapaxes(0, 1))) / n
    low = mean - np.sqrt(np.maximum(square - mean * mean, 0.0) * (n - 1))
    room = np.where(low < 0.0, -1.0 / low, np.inf)
    primal, dual = np.minimum.reduce(room[:N], axis=0), np.minimum.reduce(room[N : 2 * N], axis=0)
    return (np.minimum(primal, room[2 * N]) if len(room) > 2 * N else primal), dual


def _curvature(A: Floats, B: Floats, Y: Floats | None) -> Floats:
    """The matrix (m, m, B) of D -> sum of A_i D B_i, symmetrised, and Y D Y, over the lower triangle of D."""
    _, _, factor = _lower(len(A))
    H = total(np.moveaxis(_twofold(A, B), 2, 0))
    if Y is not None:
        H += _twofold(Y, Y)
    H *= factor.astype(A.dtype)[..., None]
    return H


def _twofold(A: Floats, B: Floats) -> Floats:
    a, b, _ = _lower(len(A))
    A_a, A_b, B_a, B_b = A[a], A[b], B[a], B[b]
    out: Floats = A_a[:, a] * B_b[:, b]
    out += A_a[:, b] * B_b[:, a]
    out += A_b[:, a] * B_a[:, b]
    out += A_b[:, b] * B_a[:, a]
    return out


@cache
def _lower(n: int) -> tuple[Any, Any, Floats]:
    """Rows and columns of the lower triangle, and what a pair of its entries counts."""
    a, b = np.array([(i, j) for i in range(n) for j in range(i + 1)]).T
    twice = np.where(a == b, 0.5, 1.0)
    return a, b, twice[:, None] * twice


def _solved(H: Floats, right: Floats) -> Floats:
    """D (n, n, B) for a symmetric right side, by `_curvature`."""
    a, b, _ = _lower(len(right))
    twice = np.where(a == b, 1.0, 2.0)[:, None]
    out = np.empty_like(right)
    out[a, b] = out[b, a] = linalg.solve(H, right[a, b] * twice)
    return out


def _beside(D: Floats, N: int) -> Floats:
    """N times the same (n, n, N, B)."""
    return np.repeat(D[:, :, None], N, axis=2)


def _even(A: Floats) -> Floats:
    return 0.5 * (A + A.swapaxes(0, 1))
