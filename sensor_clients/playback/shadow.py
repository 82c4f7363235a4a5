"""What vessels hide of one another, and where returns are theirs and not a new vessel's.

**Shadow.** A vessel of length L and beam B that moves with course c and is seen at range r under bearing b covers, as
a rectangle, the angle 2 h about b:

    h = [L sin a + B cos a] / 2 r + w,   a = |c - b| (mod 180 deg, up to 90) + 2 sigma_c,

w half of the sensor's own beam, sigma_c the course's standard deviation. What lies on such a bearing, farther away by
more than L / 2, is in its shadow. It is seen less often; and what is seen there may be an echo by way of the vessel,
which moves like a target and goes round with the vessel's bearing.

**Hull and wake.** Returns within L along the course and B across it may be of the same hull, whichever part of that the
track follows; those behind, within Kelvin's angle of asin 1/3 to either side, may be of its wake.

In all of these nothing begins: a track counts as new when it comes out into the open. What was tracked in the open
before goes on, and so does an echo that was found before its vessel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensor_clients.filters.measurement import Floats

__all__ = ["Shade", "Shadows", "cast"]

KELVIN = float(np.tan(np.arcsin(1 / 3)))
"""How a wake widens with the way behind the vessel."""
ITSELF = 0.1
"""Nearer to a vessel's place than this, m, is the vessel itself."""


@dataclass(frozen=True, slots=True)
class Shade:
    """How a sensor sees vessels and past them. length, beam: of the largest vessel reckoned with, m; wake: how far
    behind one its wake is seen, m; width: half of the sensor's own beam, rad; seen: what part of the probability of
    detection is left in a shadow."""

    length: float
    beam: float
    wake: float
    width: float
    seen: float


@dataclass(frozen=True, slots=True, eq=False)
class Shadows:
    """Of K vessels at places (2, K), m, with courses (2, K), unit vectors, for a ship at own (2,), m, whose sensor is
    of this `shade`: shadows beyond range (K,), m, within half (K,), rad, of bearing (K,), rad."""

    shade: Shade
    own: Floats
    places: Floats
    courses: Floats
    range: Floats
    bearing: Floats
    half: Floats

    def over(self, places: Floats) -> NDArray[np.bool_]:
        """Which of places (2, T) are in a shadow."""
        x, y = places - self.own[:, None]
        away = np.arctan2(x, y)[:, None] - self.bearing
        away = np.abs((away + np.pi) % (2 * np.pi) - np.pi)
        return np.asarray(((np.hypot(x, y)[:, None] > self.range) & (away < self.half)).any(axis=1))

    def part(self, places: Floats) -> NDArray[np.bool_]:
        """Which of places (2, T) may be on a vessel's hull or in its wake, and are not its own place."""
        x, y = places[:, :, None] - self.places[:, None]
        along = x * self.courses[0] + y * self.courses[1]
        across = np.abs(y * self.courses[0] - x * self.courses[1])
        hull = (np.abs(along) <= self.shade.length) & (across <= self.shade.beam)
        wake = (along < 0) & (along >= -self.shade.wake) & (across <= self.shade.beam - KELVIN * along)
        return np.asarray(((hull | wake) & (np.hypot(x, y) > ITSELF)).any(axis=1))

    def unproven(self, places: Floats) -> NDArray[np.bool_]:
        """Where in places (2, T) nothing begins."""
        return self.over(places) | self.part(places)


def cast(own: Floats, means: Floats, covariances: Floats, shade: Shade) -> Shadows:
    """The shadows of vessels with states (4, K) and their covariances (4, 4, K) for a ship at `own` (2,), m."""
    x, y = means[:2] - own[:, None]
    r, bearing = np.maximum(np.hypot(x, y), shade.length / 2), np.arctan2(x, y)
    speed = np.maximum(np.hypot(means[2], means[3]), 1e-6)
    courses = means[2:] / speed
    normal = np.stack([courses[1], -courses[0]])
    sigma = np.sqrt(np.einsum("at,abt,bt->t", normal, covariances[2:, 2:], normal)) / speed
    aspect = np.arctan2(means[2], means[3]) - bearing
    off = np.abs((aspect + np.pi / 2) % np.pi - np.pi / 2)
    off = np.minimum(off + 2 * sigma, np.pi / 2)
    half = (shade.length * np.sin(off) + shade.beam * np.cos(off)) / (2 * r) + shade.width
    return Shadows(shade, own, means[:2], courses, r + shade.length / 2, bearing, half)
