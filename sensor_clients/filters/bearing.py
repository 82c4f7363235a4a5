"""Tracks from bearings alone: a range-parameterised Gaussian sum (Peach 1995; Arulampalam and Ristic 2000).

A bearing says nothing of range, so each track is a bank of filters, one for each interval of range from the first
sight of it: of edges e_c = e_0 rho^c, so that all have the same ratio of spread to range, which is what bends a
bearing. Interval c starts as a Gaussian at mean range (e_c + e_c+1) / 2 with standard deviation (e_c+1 - e_c) /
sqrt 12 along the line of sight and the bearing's own error across it, at velocity 0 +- sigma_speed. All intervals
begin with the same weight (ranges uniform in their logarithm: what is near is seen more readily); from then on
the weights are those of `mixture`. If the sensor stays where it is, only the limit on speed tells them apart.

Cartesian filters gain a little information of range that is not there. Simulated targets that start 60 m away or more
and move at some 3 m/s lie inside the mixture's 90 % region in 90 % of cases after 30 s; where the bearing turns by
more than a radian, as when they pass nearer, in about 75 %.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion_service import linalg, motion
from sensor_clients.filters.measurement import STATE, Floats, MeasurementModel, sight_covariance
from sensor_clients.filters.mixture import MixtureTracker
from sensor_clients.filters.tracker import TrackerConfig

__all__ = ["Bearing", "BearingTracker"]


@dataclass(frozen=True, slots=True)
class Bearing:
    """Bearing theta = atan2(x - x0, y - y0), clockwise from the y axis (north), seen from `origin` (x0, y0), m.

    Its standard deviation at range r is sqrt(sigma_bearing^2 + (sigma_cross / r)^2) (rad, m): the sensor's, and
    where on the object the sensor points. edges: of the intervals of range, m, from near to far.
    """

    sigma_bearing: float
    sigma_cross: float
    edges: tuple[float, ...]
    origin: tuple[float, float] = (0.0, 0.0)

    def observe(self, place: Floats) -> Floats:
        return np.asarray(np.arctan2(place[0] - self.origin[0], place[1] - self.origin[1])[None])

    def jacobian(self, place: Floats) -> Floats:
        x, y = place[0] - self.origin[0], place[1] - self.origin[1]
        r2 = np.maximum(x * x + y * y, 1e-6)
        return np.stack([y / r2, -x / r2])[None]

    def noise(self, place: Floats) -> Floats:
        x, y = place[0] - self.origin[0], place[1] - self.origin[1]
        R = self.sigma_bearing**2 + self.sigma_cross**2 / np.maximum(x * x + y * y, 1.0)
        return np.asarray(R[None, None])

    def difference(self, a: Floats, b: Floats) -> Floats:
        return np.asarray((a - b + math.pi) % (2 * math.pi) - math.pi)

    def locate(self, returns: Floats) -> tuple[Floats, Floats]:
        """As for any return, of a range uniform in its logarithm: the moments of the intervals taken together."""
        places, spreads = self.intervals(returns)
        mean = places.mean(axis=1)
        away = places - mean[:, None]
        return mean, linalg.symmetrise((spreads + linalg.outer(away, away)).mean(axis=2))

    def intervals(self, returns: Floats) -> tuple[Floats, Floats]:
        """Means (2, C, M) and covariances (2, 2, C, M) of the place in each interval of range, for bearings (1, M)."""
        sight = np.stack([np.sin(returns[0]), np.cos(returns[0])])[:, None]
        near, far = np.array(self.edges[:-1])[:, None], np.array(self.edges[1:])[:, None]
        r, sigma = (near + far) / 2, (far - near) / math.sqrt(12)
        spread = (r * self.sigma_bearing) ** 2 + self.sigma_cross**2
        places = np.array(self.origin)[:, None, None] + r * sight
        return places, sight_covariance(sight, sigma**2, spread)


class BearingTracker(MixtureTracker):
    """A `LocalTracker` of bearings; `config.min_way` and `min_speed` are angles here, rad and rad/s: how far the
    bearing has surely turned. `first` holds the first bearing in its first row."""

    def __init__(self, config: TrackerConfig, intervals: int) -> None:
        super().__init__(config, intervals)

    def _moved(self, dt: float) -> tuple[Floats, Floats, Floats]:
        C, T = self.weights.shape
        flat = self.parts.reshape(4, -1), self.spreads.reshape(4, 4, -1)
        parts, spreads = motion.predict(self.config.motion, STATE, *flat, np.full(C * T, dt))
        return self.weights, parts.reshape(4, C, T), spreads.reshape(4, 4, C, T)

    def _components(self, returns: Floats, model: MeasurementModel) -> tuple[Floats, Floats, Floats]:
        assert isinstance(model, Bearing)
        places, spreads = model.intervals(returns)
        parts, covariances = self._still(places, spreads)
        C = places.shape[1]
        return np.full(places.shape[1:], 1 / C), parts, covariances

    def _born(self, returns: Floats, model: MeasurementModel) -> dict[str, Any]:
        return super()._born(returns, model) | {"first": np.concatenate([returns, np.zeros_like(returns)])}

    def _way(self, model: MeasurementModel) -> Floats:
        place = np.ascontiguousarray(self.means[:2])
        H = model.jacobian(place)
        sigma = np.sqrt(np.einsum("jt,jkt,kt->t", H[0], self.covariances[:2, :2], H[0]))
        return np.asarray(np.abs(model.difference(model.observe(place), self.first[:1])[0]) - 2 * sigma)
