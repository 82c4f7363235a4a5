"""Prediction of Gaussian states with a source's declared motion: the batch is the last axis.

Nearly constant velocity (cv): on each axis the highest derivative in the state is driven by white noise of
intensity q (Bar-Shalom, Li, Kirubarajan, Estimation with Applications, 2001, 6.2). Coordinated turn (ct):
the velocity turns at the state's turn_rate (ibid., 11.7), with the exact Jacobian.

An element's result is the same, bit for bit, whatever batch surrounds it.
"""

from __future__ import annotations

from math import factorial

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.linalg import congruence, matvec
from schemas import Motion

__all__ = ["predict"]


AXES = (("x", "vx", "ax"), ("y", "vy", "ay"), ("z", "vz", "az"))
SMALL_TURN = 0.25
"""Below this angle (rad) the derivatives by the turn rate come from their series."""


def predict(
    motion: Motion, space: tuple[str, ...], means: Floats, covariances: Floats, dt: Floats
) -> tuple[Floats, Floats]:
    """Means (n, B) and covariances (n, n, B) after `dt` (B,) seconds, one per element; 0 returns the same bits.

    cv: position, velocity and acceleration, as far as the space has them, are integrated; q drives the
    highest one, so a position without its velocity walks at random with q dt. ct: in the horizontal plane,
    x' = x + S vx - C vy, y' = y + C vx + S vy with S = sin(w dt)/w, C = (1 - cos(w dt))/w; the noise on each
    axis is as in cv, and q_turn dt is added on the turn rate. A space without turn_rate, vx or vy, or with
    ax or ay, has no coordinated turn: there ct acts as cv. Any order of components.

    Raises ValueError for a negative or NaN `dt`.
    """
    if not np.all(dt >= 0):
        raise ValueError("a state is never predicted back in time: dt must be 0 or more seconds")
    turning = motion.kind == "ct" and {"turn_rate", "vx", "vy"} <= set(space) and not {"ax", "ay"} & set(space)
    with np.errstate(all="ignore"):
        transition, noise = _kinematics(motion, space, dt)
        predicted = _turn(space, transition, means, dt) if turning else matvec(transition, means)
        spread = congruence(transition, covariances) + noise
    still = dt == 0
    return np.where(still, means, predicted), np.where(still, covariances, spread)


def _kinematics(motion: Motion, space: tuple[str, ...], dt: Floats) -> tuple[Floats, Floats]:
    """F and Q (n, n, B) of cv. In a chain of L derivatives, with i' = L - 1 - i,
    F_ij = dt^(j-i) / (j-i)! and Q_ij = q dt^(i'+j'+1) / ((i'+j'+1) i'! j'!)."""
    n = len(space)
    transition, noise = np.zeros((n, n, *dt.shape)), np.zeros((n, n, *dt.shape))
    transition[range(n), range(n)] = 1.0
    powers = [np.ones_like(dt)]
    for _ in range(5):
        powers.append(powers[-1] * dt)
    for chain in _chains(space):
        last = len(chain) - 1
        for i, row in enumerate(chain):
            for j, column in enumerate(chain):
                if j > i:
                    transition[row, column] = powers[j - i] / factorial(j - i)
                a, b = last - i, last - j
                noise[row, column] = motion.q / ((a + b + 1) * factorial(a) * factorial(b)) * powers[a + b + 1]
    if "turn_rate" in space:
        i = space.index("turn_rate")
        noise[i, i] = motion.q_turn * dt
    return transition, noise


def _chains(space: tuple[str, ...]) -> list[list[int]]:
    """Ints of successive derivatives that stand in the space together: x vx, say, and y alone."""
    chains: list[list[int]] = []
    for names in AXES:
        chain: list[int] = []
        for name in names:
            if name in space:
                chain.append(space.index(name))
            elif chain:
                chains.append(chain)
                chain = []
        if chain:
            chains.append(chain)
    return chains


def _turn(space: tuple[str, ...], transition: Floats, means: Floats, dt: Floats) -> Floats:
    """The means (n, B) after the turn; `transition`, F of cv, becomes its Jacobian."""
    ix, iy, ivx, ivy, iw = (space.index(name) for name in ("x", "y", "vx", "vy", "turn_rate"))
    vx, vy, rate = means[ivx], means[ivy], means[iw]
    angle = rate * dt
    sine, cosine, half = np.sin(angle), np.cos(angle), np.sin(0.5 * angle)
    versine = 2.0 * half * half
    some = np.where(angle == 0.0, 1.0, angle)
    along = dt * np.where(angle == 0.0, 1.0, sine / some)
    across = dt * (versine / some)
    # (t cos t - sin t) / t^2 and (t sin t - 1 + cos t) / t^2 lose their digits as t goes to 0: there, their series.
    small, square = np.abs(angle) < SMALL_TURN, angle * angle
    large = np.where(small, 1.0, angle)
    series_s = -angle * (1 / 3 - square * (1 / 30 - square * (1 / 840 - square * (1 / 45360 - square / 3991680))))
    series_c = 1 / 2 - square * (1 / 8 - square * (1 / 144 - square * (1 / 5760 - square * (1 / 403200))))
    d_along = dt * dt * np.where(small, series_s, (large * cosine - sine) / (large * large))
    d_across = dt * dt * np.where(small, series_c, (large * sine - versine) / (large * large))

    transition[ivx, ivx], transition[ivx, ivy] = cosine, -sine
    transition[ivy, ivx], transition[ivy, ivy] = sine, cosine
    transition[ix, ivx], transition[ix, ivy] = along, -across
    transition[iy, ivx], transition[iy, ivy] = across, along
    predicted = matvec(transition, means)
    transition[ivx, iw] = -dt * (sine * vx + cosine * vy)
    transition[ivy, iw] = dt * (cosine * vx - sine * vy)
    transition[ix, iw] = d_along * vx - d_across * vy
    transition[iy, iw] = d_across * vx + d_along * vy
    return predicted
