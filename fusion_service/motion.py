"""Prediction of Gaussian states with a source's declared motion: the batch is the last axis.

On each axis the state holds some of position, velocity and acceleration. What drives a chain of L derivatives is
white noise on the highest (cv, ca, still: Bar-Shalom, Li, Kirubarajan, Estimation with Applications, 2001, 6.2) or
a highest derivative that is forgotten exponentially (Singer's acceleration, an Ornstein-Uhlenbeck velocity: ibid.,
8.2). Coordinated turn (ct): the velocity turns at the state's turn_rate (`turn`).

What a state does not have, it cannot carry from one step to the next, and yet it moves the target:

* a forgotten derivative has the spectrum S(w) = 2 sigma^2 tau / (1 + (w tau)^2), nowhere above S(0). The variance of
  any linear functional of it, over the gap and whatever went into the state before it, is then at most that under
  white noise of intensity 2 sigma^2 tau. That noise takes its place (Singer without acceleration, ou without
  velocity): never too small, exact as gaps grow, and two steps are one.
* a derivative that is never forgotten (an acceleration under ca, a velocity under ca and Singer) has no such bound:
  it counts from zero at the time of the state, or from ca's `sigma`; one long step then says more than two short ones.

An element's result is the same, bit for bit, whatever batch surrounds it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import factorial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats, all_of, any_of
from fusion_service.linalg import congruence, matvec
from fusion_service.turn import turn, turns
from schemas import Frame, Motion

__all__ = ["predict", "transition"]


AXES = (("x", "vx", "ax"), ("y", "vy", "ay"), ("z", "vz", "az"))
SMALL_GAP = 1.0
"""Below this multiple of tau the moments of what is forgotten come from their series, of `TERMS` terms."""
TERMS = 22
BACK = "a state is never predicted back in time: dt must be 0 or more seconds"


def predict(
    motion: Motion,
    space: tuple[str, ...],
    means: Floats,
    covariances: Floats,
    dt: Floats,
    frame: Frame | None = None,
) -> tuple[Floats, Floats]:
    """Means (n, B) and covariances (n, n, B) after `dt` (B,) seconds, one per element; 0 returns the same bits.

    F x and F P F' + Q with F and Q of `transition`; under a turn the mean goes by the turn itself. frame: that of
    the states, of which a turn asks where up is.
    Raises ValueError for a negative or NaN `dt`.
    """
    if not dt.any():
        return means.copy(), covariances.copy()
    turning = motion.kind == "ct" and turns(space, frame)
    once = not turning and dt.ndim == 1 and all_of(dt == dt[0])
    moves, noise = _at_once(motion, space, float(dt[0])) if once else transition(motion, space, means, dt, frame)
    with np.errstate(all="ignore"):
        if turning:
            w = space.index("turn_rate")
            straight = means.copy()
            straight[w] = 0.0
            predicted = matvec(moves, straight)
            predicted[w] = means[w]
        else:
            predicted = matvec(moves, means)
        spread = congruence(moves, covariances) + noise
    if once:
        return predicted, spread
    same = dt == 0
    if not any_of(same):
        return predicted, spread
    return np.where(same, means, predicted), np.where(same, covariances, spread)


@lru_cache(maxsize=256)
def _at_once(motion: Motion, space: tuple[str, ...], dt: float) -> tuple[Floats, Floats]:
    """F (n, n) and Q (n, n, 1) of a gap that all have in common: the same bits as each alone. Not of a turn."""
    if not dt >= 0:
        raise ValueError(BACK)
    with np.errstate(all="ignore"):
        moves, noise = _kinematics(motion, space, np.array([dt]))
    return moves[..., 0], noise


def transition(
    motion: Motion, space: tuple[str, ...], means: Floats, dt: Floats, frame: Frame | None = None
) -> tuple[Floats, Floats]:
    """F and Q (n, n, B) of `dt` (B,) seconds from states of `means` (n, B), any order of components.

    cv: position, velocity and acceleration, as far as the space has them, are integrated; q drives the highest one,
    so a position without its velocity walks at random with q dt. ca: the same with q on the acceleration, whether
    the space has it or not. singer, ou: the acceleration or velocity is multiplied by exp(-dt/tau) and regains its
    sigma; without it the white noise above drives what the space has. still: the position takes q dt, a velocity
    or acceleration becomes 0 with `sigma` as soon as dt > 0. Under ou an acceleration in the state is forgotten
    likewise, with sigma/tau, and moves nothing.

    ct: F is the Jacobian at the means (see `turn`); the noise on each axis is as in cv. A space that has no turn in
    this frame is predicted as cv.

    In every kind q_turn dt is added on a turn rate. Raises ValueError for a negative or NaN `dt`.
    """
    if not all_of(dt >= 0):
        raise ValueError(BACK)
    with np.errstate(all="ignore"):
        moves, noise = _kinematics(motion, space, np.ascontiguousarray(dt))
        if motion.kind == "ct" and turns(space, frame):
            turn(space, moves, means, dt, frame)
    return moves, noise


def _kinematics(motion: Motion, space: tuple[str, ...], dt: Floats) -> tuple[Floats, Floats]:
    """F and Q (n, n, B) of every kind, a turn's being those of cv."""
    n = len(space)
    moves, noise = np.zeros((n, n, *dt.shape)), np.zeros((n, n, *dt.shape))
    if dt.ndim == 1 and (plan := _driven(motion, space)) is not None:
        return _filled(moves, noise, plan, dt)
    moves[range(n), range(n)] = 1.0
    powers = [np.ones_like(dt)]
    for _ in range(5):
        powers.append(powers[-1] * dt)
    for chain, first in _chains(space):
        last = first + len(chain) - 1
        if motion.kind == "still":
            _hold(moves, noise, chain, first, motion, dt)
        elif motion.kind in ("singer", "ou"):
            _forget(moves, noise, chain, first, motion, powers)
        else:
            top = 2 if motion.kind == "ca" else last
            _drive(moves, noise, chain, top - first, motion.q, powers)
            if top > last and motion.sigma:
                _drift(noise, chain, top - first, motion.sigma, powers)
    if "turn_rate" in space:
        i = space.index("turn_rate")
        noise[i, i] = motion.q_turn * dt
    return moves, noise


class _Plan(NamedTuple):
    """Which elements of F and Q hold what of the powers of dt, each column (K,): rows, columns, the power, and what it
    is divided by, or multiplied. top: the highest power."""

    diagonal: NDArray[np.intp]
    moves: tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], Floats]
    noise: tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], Floats]
    top: int


@lru_cache(maxsize=256)
def _driven(motion: Motion, space: tuple[str, ...]) -> _Plan | None:
    """What `_drive` writes for all chains together; None for motions that say more than that."""
    if motion.kind not in ("cv", "ca", "ct") or "turn_rate" in space:
        return None
    moves: list[tuple[int, int, int, float]] = []
    noise: list[tuple[int, int, int, float]] = []
    for chain, first in _chains(space):
        last = first + len(chain) - 1
        top = 2 if motion.kind == "ca" else last
        if top > last and motion.sigma:
            return None
        above = top - first
        for i, row in enumerate(chain):
            for j, column in enumerate(chain):
                a, b = above - i, above - j
                if j > i:
                    moves.append((row, column, j - i, float(factorial(j - i))))
                noise.append((row, column, a + b + 1, motion.q / ((a + b + 1) * factorial(a) * factorial(b))))
    top = max([1, *(one[2] for one in noise)])
    return _Plan(np.arange(len(space)), _columns(moves), _columns(noise), top)


def _columns(
    entries: list[tuple[int, int, int, float]],
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp], Floats]:
    whole = np.array([entry[:3] for entry in entries], dtype=np.intp).reshape(-1, 3)
    return whole[:, 0].copy(), whole[:, 1].copy(), whole[:, 2].copy(), np.array([[entry[3]] for entry in entries])


def _filled(moves: Floats, noise: Floats, plan: _Plan, dt: Floats) -> tuple[Floats, Floats]:
    """`_kinematics` by a plan: the same operations on all elements at once."""
    powers = np.empty((plan.top + 1, len(dt)))
    powers[0] = 1.0
    for k in range(plan.top):
        np.multiply(powers[k], dt, out=powers[k + 1])
    moves[plan.diagonal, plan.diagonal] = 1.0
    row, column, power, factor = plan.moves
    if len(row):
        moves[row, column] = powers[power] / factor
    row, column, power, factor = plan.noise
    noise[row, column] = factor * powers[power]
    return moves, noise


def _chains(space: tuple[str, ...]) -> list[tuple[list[int], int]]:
    """Ints of successive derivatives that stand in the space together (x vx, say, and y alone), and the order of
    the first: 0 a position, 1 a velocity, 2 an acceleration."""
    chains: list[tuple[list[int], int]] = []
    for names in AXES:
        chain: list[int] = []
        for order, name in enumerate(names):
            if name in space:
                if not chain:
                    chains.append((chain, order))
                chain.append(space.index(name))
            else:
                chain = []
    return chains


def _drive(moves: Floats, noise: Floats, chain: list[int], above: int, q: float, powers: list[Floats]) -> None:
    """A chain whose first component is `above` derivatives below the one that white noise of intensity q drives.
    With i' = above - i: F_ij = dt^(j-i) / (j-i)! and Q_ij = q dt^(i'+j'+1) / ((i'+j'+1) i'! j'!)."""
    for i, row in enumerate(chain):
        for j, column in enumerate(chain):
            if j > i:
                moves[row, column] = powers[j - i] / factorial(j - i)
            a, b = above - i, above - j
            noise[row, column] = q / ((a + b + 1) * factorial(a) * factorial(b)) * powers[a + b + 1]


def _drift(noise: Floats, chain: list[int], above: int, sigma: float, powers: list[Floats]) -> None:
    """An unseen constant derivative of standard deviation `sigma`, `above` the first of the chain."""
    for i, row in enumerate(chain):
        for j, column in enumerate(chain):
            a, b = above - i, above - j
            noise[row, column] += sigma**2 / (factorial(a) * factorial(b)) * powers[a + b]


def _hold(moves: Floats, noise: Floats, chain: list[int], first: int, motion: Motion, dt: Floats) -> None:
    """A position that walks at random; derivatives that are zero with sigma."""
    for order, row in enumerate(chain, first):
        if order == 0:
            noise[row, row] = motion.q * dt
        else:
            moves[row, row] = np.where(dt == 0, 1.0, 0.0)
            noise[row, row] = np.where(dt == 0, 0.0, motion.sigma**2)


def _forget(moves: Floats, noise: Floats, chain: list[int], first: int, motion: Motion, powers: list[Floats]) -> None:
    """A chain under singer or ou: with its forgotten derivative, or the white noise that covers it."""
    top = 2 if motion.kind == "singer" else 1
    last = first + len(chain) - 1
    if last < top:
        reach = max(last, top - 1)
        _drive(moves, noise, chain, reach - first, 2 * motion.sigma**2 * motion.tau, powers)
    if first <= top <= last:
        own = chain[: top - first + 1][::-1]
        _fill(moves, noise, own, *_forgotten(len(own), motion.sigma, motion.tau, powers[1]))
    if last > top:
        own = chain[-1:]
        _fill(moves, noise, own, *_forgotten(1, motion.sigma / motion.tau, motion.tau, powers[1]))


def _fill(moves: Floats, noise: Floats, own: list[int], F: list[list[Floats]], Q: list[list[Floats]]) -> None:
    for i, row in enumerate(own):
        for j, column in enumerate(own):
            if j <= i:
                moves[row, column] = F[i][j]
                noise[row, column] = noise[column, row] = Q[i][j]


def _forgotten(levels: int, sigma: float, tau: float, dt: Floats) -> tuple[list[list[Floats]], list[list[Floats]]]:
    """F and Q, lower triangles, of what is forgotten and its first `levels` - 1 integrals, in this order.

    With u = dt/tau and e = exp(-u): F = e; tau (1 - e), 1; tau^2 (u - 1 + e), dt, 1, and Q/sigma^2 =
    1 - e^2; tau (1 - e)^2, tau^2 (2u - 3 + 4e - e^2);
    tau^2 (1 - 2ue - e^2), tau^3 (u - 1 + e)^2, tau^4 (1 + 2u - 2u^2 + 2u^3/3 - 4ue - e^2).
    """
    u = dt / tau
    e, gone = np.exp(-u), -np.expm1(-u)
    s, one = sigma**2, np.ones_like(u)
    F, Q = [[e]], [[-s * np.expm1(-2.0 * u)]]
    if levels > 1:
        F.append([tau * gone, one])
        f = _or_series(u, 3, lambda k: 4 - 2.0**k, 2 * u - 3 + (4 - e) * e)
        Q.append([s * tau * gone**2, s * tau**2 * f])
    if levels > 2:
        h = _or_series(u, 2, lambda k: 1.0, u - gone)
        F.append([tau**2 * h, dt, one])
        f = _or_series(u, 3, lambda k: 2 * k - 2.0**k, 1 - (2 * u + e) * e)
        g = _or_series(u, 5, lambda k: 4 * k - 2.0**k, 1 + u * (2 - u * (2 - u * (2 / 3))) - (4 * u + e) * e)
        Q.append([s * tau**2 * f, s * tau**3 * h**2, s * tau**4 * g])
    return F, Q


def _or_series(u: Floats, low: int, c: Callable[[int], float], closed: Floats) -> Floats:
    """The sum of c(k) (-u)^k / k! from k = `low` where u is small, and its `closed` form, which loses digits there."""
    small = np.minimum(u, SMALL_GAP)
    total = np.zeros_like(u)
    for k in range(low + TERMS - 1, low - 1, -1):
        total = c(k) / factorial(k) - small * total
    for _ in range(low):
        total = -small * total
    return np.where(u < SMALL_GAP, total, closed)
