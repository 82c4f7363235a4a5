"""Coordinated turn: the horizontal velocity turns at the state's turn_rate, rad/s, with the exact Jacobian.

With S = sin(w t)/w and C = (1 - cos(w t))/w, in a plane: x' = x + S vx - C vy, y' = y + C vx + S vy (Bar-Shalom, Li,
Kirubarajan, Estimation with Applications, 2001, 11.7). In three dimensions the turn is about u, the vertical of the
ellipsoid at the place of the state, whatever the axes of the frame are:

    p' = p + (S H + C K + t u u') v,    v' = (cos(w t) H + sin(w t) K + u u') v,    H = I - u u', K v = u x v.

The vertical is held over the gap, and its change from place to place is left out of the Jacobian (1/R of the earth
per metre): a turn is a circle in the tangent plane, as cv is a line in it, and rises d^2 / 2R above the ground.

An element's result is the same, bit for bit, whatever batch surrounds it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.geodesy import vertical
from schemas import Ecef, Enu, Frame

__all__ = ["turn", "turns"]

PLANE = ("x", "y", "vx", "vy", "turn_rate")
SOLID = ("x", "y", "z", "vx", "vy", "vz", "turn_rate")
SMALL_TURN = 0.25
"""Below this angle (rad) the derivatives by the turn rate come from their series."""


class Arc(NamedTuple):
    """sin, cos of the angle turned, S, C, and the derivatives of S and C by the turn rate, (B,) each."""

    sine: Floats
    cosine: Floats
    along: Floats
    across: Floats
    d_along: Floats
    d_across: Floats


def turns(space: tuple[str, ...], frame: Frame | None) -> bool:
    """Whether states of `space` have a coordinated turn: with turn_rate, vx and vy, and without ax and ay; in ECEF,
    whose x and y are not horizontal, with z and vz too, and without az."""
    has = set(space)
    if isinstance(frame, Ecef):
        return _is_solid(space)
    return set(PLANE) <= has and not {"ax", "ay"} & has


def turn(space: tuple[str, ...], moves: Floats, means: Floats, dt: Floats, frame: Frame | None) -> None:
    """Make `moves`, F (n, n, B) of cv, the Jacobian of a turn of `dt` seconds from `means` (n, B).

    About the vertical where the frame is on the earth and the states have z and vz, else about the frame's z axis.
    """
    arc = _arc(means[space.index("turn_rate")], dt)
    if isinstance(frame, (Ecef, Enu)) and _is_solid(space):
        _in_space(space, moves, means, dt, arc, vertical(means, space, frame))
    else:
        _in_plane(space, moves, means, dt, arc)


def _is_solid(space: tuple[str, ...]) -> bool:
    return set(SOLID) <= set(space) and not {"ax", "ay", "az"} & set(space)


def _arc(rate: Floats, dt: Floats) -> Arc:
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
    return Arc(sine, cosine, along, across, d_along, d_across)


def _in_plane(space: tuple[str, ...], moves: Floats, means: Floats, dt: Floats, arc: Arc) -> None:
    ix, iy, ivx, ivy, iw = (space.index(name) for name in PLANE)
    vx, vy = means[ivx], means[ivy]
    moves[ivx, ivx], moves[ivx, ivy] = arc.cosine, -arc.sine
    moves[ivy, ivx], moves[ivy, ivy] = arc.sine, arc.cosine
    moves[ix, ivx], moves[ix, ivy] = arc.along, -arc.across
    moves[iy, ivx], moves[iy, ivy] = arc.across, arc.along
    moves[ivx, iw] = -dt * (arc.sine * vx + arc.cosine * vy)
    moves[ivy, iw] = dt * (arc.cosine * vx - arc.sine * vy)
    moves[ix, iw] = arc.d_along * vx - arc.d_across * vy
    moves[iy, iw] = arc.d_across * vx + arc.d_along * vy


def _in_space(space: tuple[str, ...], moves: Floats, means: Floats, dt: Floats, arc: Arc, up: Floats) -> None:
    places, velocities, iw = (
        [space.index(c) for c in "xyz"],
        [space.index(c) for c in ("vx", "vy", "vz")],
        space.index("turn_rate"),
    )
    v = [means[i] for i in velocities]
    cross = [[None, -up[2], up[1]], [up[2], None, -up[0]], [-up[1], up[0], None]]
    rise = up[0] * v[0] + up[1] * v[1] + up[2] * v[2]
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        level, aside = v[i] - rise * up[i], up[a] * v[b] - up[b] * v[a]
        for j in range(3):
            flat, turned = float(i == j) - up[i] * up[j], cross[i][j]
            moves[velocities[i], velocities[j]] = arc.cosine * flat + up[i] * up[j]
            moves[places[i], velocities[j]] = arc.along * flat + dt * (up[i] * up[j])
            if turned is not None:
                moves[velocities[i], velocities[j]] += arc.sine * turned
                moves[places[i], velocities[j]] += arc.across * turned
        moves[velocities[i], iw] = dt * (arc.cosine * aside - arc.sine * level)
        moves[places[i], iw] = arc.d_along * level + arc.d_across * aside
