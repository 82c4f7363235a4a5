"""What vessels hide: the zone behind each, as seen from the own ship, where less is seen and echoes of it appear.

A vessel of length L and beam B that moves with course c and is seen at range r under bearing b covers, as a rectangle,
the angle 2 h about b:

    h = [L |sin(c - b)| + B |cos(c - b)|] / 2 r + w,

w half of the sensor's beam. What lies on such a bearing, farther away by more than L / 2, is in its shadow: it is
seen less often, and what is seen there may be an echo by way of the vessel, which moves like a target and goes round
with the vessel's bearing. Nothing begins there, therefore; what has been tracked in the open is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensor_clients.filters.measurement import Floats

__all__ = ["Shade", "Shadows", "cast"]

MOVING = 0.5
"""Speed, m/s, below which a vessel has no course, and is taken to lie across the line of sight."""


@dataclass(frozen=True, slots=True)
class Shade:
    """How a sensor sees past vessels. length, beam: of the largest vessel reckoned with, m; width: half of the
    sensor's own beam, rad; seen: what part of the probability of detection is left in a shadow."""

    length: float
    beam: float
    width: float
    seen: float


@dataclass(frozen=True, slots=True, eq=False)
class Shadows:
    """Of K vessels seen from `own` (2,), m: beyond range (K,), m, within half (K,), rad, of bearing (K,), rad."""

    own: Floats
    range: Floats
    bearing: Floats
    half: Floats

    def over(self, places: Floats) -> NDArray[np.bool_]:
        """Which of places (2, T) are in a shadow."""
        x, y = places - self.own[:, None]
        away = np.arctan2(x, y)[:, None] - self.bearing
        away = np.abs((away + np.pi) % (2 * np.pi) - np.pi)
        hidden = (np.hypot(x, y)[:, None] > self.range) & (away < self.half)
        return np.asarray(hidden.any(axis=1))


def cast(own: Floats, means: Floats, hull: Shade) -> Shadows:
    """The shadows of vessels with states (4, K) for a ship at `own` (2,), m."""
    x, y = means[:2] - own[:, None]
    r = np.maximum(np.hypot(x, y), hull.length / 2)
    bearing = np.arctan2(x, y)
    aspect = np.arctan2(means[2], means[3]) - bearing
    across, along = np.abs(np.sin(aspect)), np.abs(np.cos(aspect))
    slow = np.hypot(means[2], means[3]) < MOVING
    width = np.where(slow, hull.length, hull.length * across + hull.beam * along)
    return Shadows(own, r + hull.length / 2, bearing, width / (2 * r) + hull.width)
