"""How large the vessels of the Autoferry recordings are, and which way they lie.

The data set tells no sizes. R/V Gunnerus has been 36.25 m x 9.6 m since she was lengthened in 2019; of Havfruen, "a
medium-sized leisure craft", and of the jet boat nothing is published with the data: theirs are assumed. So is that the
antenna stood in the middle of each hull, and that a vessel lies along its course over the ground.
"""

from __future__ import annotations

import numpy as np

from sensor_clients.events import Parameter
from sensor_clients.filters.measurement import Floats

__all__ = ["PARAMETERS", "hulls"]

SECOND_DAY = 1_620_172_800.0
"""2021-05-05 00:00 UTC, Unix s: scenarios before are of environment 1 (target 2 is Gunnerus), later ones of
environment 2 (it is the jet boat)."""
GUNNERUS, HAVFRUEN, JET_BOAT = (36.25, 9.6), (10.0, 3.0), (7.5, 2.6)
COURSE = 4.0
"""Seconds over which a course is taken."""
MADE_WAY = 2.0
"""m in them: below, a vessel keeps the course of the nearest time at which it moved."""

PARAMETERS = (
    Parameter("hull of Gunnerus", "36.25 x 9.6 m", "the ship's data sheet, since 2019"),
    Parameter("hull of Havfruen", "10 x 3 m", "assumed: a medium-sized leisure craft"),
    Parameter("hull of the jet boat", "7.5 x 2.6 m", "assumed"),
    Parameter("place of the antennas", "the middle of the hull", "assumed: not told"),
    Parameter("heading of the hulls", f"the course over {COURSE:g} s", "assumed: no compass in the data"),
)


def hulls(target: int, times: Floats, places: Floats, wanted: Floats) -> Floats:
    """Length, width (m) and heading (rad, from x to y) of a vessel (W, 3) at the times `wanted`, Unix s, from fixes:
    times (K,), ascending, places (K, 2), m. NaN for an unknown vessel; of one that never moves the heading is."""
    out = np.full((len(wanted), 3), np.nan)
    sizes = {1: HAVFRUEN, 2: GUNNERUS if times[0] < SECOND_DAY else JET_BOAT}
    if target not in sizes:
        return out
    out[:, :2] = sizes[target]
    grid = np.arange(times[0], times[-1] + 0.5, 0.5)
    ahead, behind = (
        np.stack([np.interp(grid + side, times, axis) for axis in places.T]) for side in (COURSE / 2, -COURSE / 2)
    )
    way = ahead - behind
    moving = np.flatnonzero(np.hypot(*way) >= MADE_WAY)
    if len(moving):
        nearest = np.abs(grid[moving] - wanted[:, None]).argmin(axis=1)
        out[:, 2] = np.arctan2(*way[::-1, moving[nearest]])
    return out
