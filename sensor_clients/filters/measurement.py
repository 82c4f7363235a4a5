"""Measurement models of local trackers, and the predicted measurement by linearisation or cubature.

States are `STATE` = (x, y, vx, vy) in m and m/s, batch last: means (4, T), covariances (4, 4, T); returns
are (d, M), d = 2 but for a bearing, which has d = 1. A model says how a position shows up in a return;
`predict_measurement` gives the moments that an EKF or a CKF update needs, `Sigma` being the square root of P and
K = P_xz S^-1:

    EKF   z = h(x),               S = H P H' + R,                           P_xz = P H'
    CKF   z = sum_i h(X_i) / 2n,  S = sum_i (h(X_i)-z)(h(X_i)-z)' / 2n + R, P_xz = sum_i (X_i-x)(h(X_i)-z)' / 2n
          with X_i = x +- sqrt(n) Sigma e_i, i = 1..n   (Arasaratnam and Haykin 2009)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg

__all__ = [
    "STATE",
    "Floats",
    "MeasurementModel",
    "Position",
    "Prediction",
    "RangeAzimuth",
    "predict_measurement",
    "sight_covariance",
]

Floats: TypeAlias = NDArray[np.float64]

STATE = ("x", "y", "vx", "vy")
"""The state of every local tracker here."""


class Prediction(NamedTuple):
    """Predicted returns: mean z (d, T), covariance S (d, d, T), gain K (4, d, T), innovations (d, T, M)."""

    mean: Floats
    covariance: Floats
    gain: Floats
    innovations: Floats


class MeasurementModel(Protocol):
    """How a place (2, ...), m, shows up in a return (d, ...)."""

    def observe(self, place: Floats) -> Floats:
        """The noiseless return h(place), (d, ...)."""

    def jacobian(self, place: Floats) -> Floats:
        """dh/dplace (d, 2, T) for places (2, T)."""

    def noise(self, place: Floats) -> Floats:
        """Covariance R (d, d, T) of the noise of a return from places (2, T)."""

    def difference(self, a: Floats, b: Floats) -> Floats:
        """a - b for returns, angles wrapped to [-pi, pi)."""

    def locate(self, returns: Floats) -> tuple[Floats, Floats]:
        """Mean (2, M) and covariance (2, 2, M) of the place given a return (d, M) alone."""


@dataclass(frozen=True, slots=True)
class RangeAzimuth:
    """Range and azimuth from the origin, as Sharma 6.4.1: r = sqrt(x^2 + y^2), theta = atan2(y, x).

    sigma_range in m, sigma_azimuth in rad; the azimuth runs from the x axis towards y.
    """

    sigma_range: float
    sigma_azimuth: float

    def observe(self, place: Floats) -> Floats:
        return np.stack([np.hypot(place[0], place[1]), np.arctan2(place[1], place[0])])

    def jacobian(self, place: Floats) -> Floats:
        x, y = place
        r2 = np.maximum(x * x + y * y, 1e-6)
        r = np.sqrt(r2)
        return np.stack([np.stack([x / r, y / r]), np.stack([-y / r2, x / r2])])

    def noise(self, place: Floats) -> Floats:
        return np.broadcast_to(
            np.diag([self.sigma_range**2, self.sigma_azimuth**2])[..., None], (2, 2, place.shape[1])
        ).copy()

    def difference(self, a: Floats, b: Floats) -> Floats:
        """Of azimuths that lie within a turn of one another, by steps that cost a tenth of a modulo."""
        turn = 2 * math.pi
        d = a - b
        angle = d[1]
        angle += math.pi
        angle += turn * (angle < 0)
        angle -= turn * (angle >= turn)
        angle -= math.pi
        return d

    def locate(self, returns: Floats) -> tuple[Floats, Floats]:
        """Exact moments of ((r-w) cos(theta-v), (r-w) sin(theta-v)), w and v the noise: the unbiased
        conversion of Longbin et al. 1998, which keeps the curvature of the cross-range."""
        r, theta = returns
        once, twice = math.exp(-(self.sigma_azimuth**2) / 2), math.exp(-2 * self.sigma_azimuth**2)
        c, s = np.cos(theta), np.sin(theta)
        mean = once * np.stack([r * c, r * s])
        power = (r * r + self.sigma_range**2) / 2
        second = np.empty((2, 2, len(r)))
        second[0, 0] = power * (1 + twice * np.cos(2 * theta))
        second[1, 1] = power * (1 - twice * np.cos(2 * theta))
        second[0, 1] = second[1, 0] = power * twice * np.sin(2 * theta)
        return mean, second - linalg.outer(mean, mean)


@dataclass(frozen=True, slots=True)
class Position:
    """A Cartesian return (x, y), m, of a sensor at `origin` with polar noise: sigma_range along the line
    of sight, sqrt(sigma_cross^2 + (r sigma_azimuth)^2) across it (m, m, rad), r the range in m."""

    sigma_range: float
    sigma_cross: float
    sigma_azimuth: float = 0.0
    origin: tuple[float, float] = (0.0, 0.0)

    def observe(self, place: Floats) -> Floats:
        return place.copy()

    def jacobian(self, place: Floats) -> Floats:
        return np.broadcast_to(np.eye(2)[..., None], (2, 2, place.shape[1]))

    def noise(self, place: Floats) -> Floats:
        sight = place - np.array(self.origin)[:, None]
        r2 = np.sum(sight * sight, axis=0)
        unit = sight / np.sqrt(np.maximum(r2, 1e-6))
        across = self.sigma_cross**2 + r2 * self.sigma_azimuth**2
        R: Floats = (self.sigma_range**2 - across) * linalg.outer(unit, unit)
        R[0, 0] += across
        R[1, 1] += across
        return R

    def difference(self, a: Floats, b: Floats) -> Floats:
        return a - b

    def locate(self, returns: Floats) -> tuple[Floats, Floats]:
        return returns.copy(), self.noise(returns)


def sight_covariance(sight: Floats, along: float | Floats, across: float | Floats) -> Floats:
    """Covariances (2, 2, ...) of variance `along` the vectors `sight` (2, ...) and `across` them, each (...) and in
    units of the vector's squared length."""
    normal = np.stack([sight[1], -sight[0]])
    return np.asarray(along * linalg.outer(sight, sight) + across * linalg.outer(normal, normal))


def predict_measurement(
    model: MeasurementModel, means: Floats, covariances: Floats, returns: Floats, cubature: bool = True
) -> Prediction:
    """Moments of the return of each track, and the innovation of each return for each track.

    means (n, T), covariances (n, n, T) with x, y first; returns (d, M); `cubature`: CKF, else EKF.
    """
    n, T = means.shape
    place = np.ascontiguousarray(means[:2])
    if cubature:
        L, d = linalg.ldl(covariances)
        spread = L * np.sqrt(n * d)
        centre = model.observe(place)
        offsets = np.concatenate([spread, -spread], axis=1)
        points = np.ascontiguousarray(means[:2, None] + offsets[:2]).reshape(2, -1)
        seen = model.observe(points).reshape(len(centre), 2 * n, T)
        seen = model.difference(seen, np.broadcast_to(centre[:, None], seen.shape))
        shift = seen.mean(axis=1)
        seen = seen - shift[:, None]
        z = centre + shift
        S = np.einsum("ait,bit->abt", seen, seen) / (2 * n) + model.noise(place)
        cross = np.einsum("ait,bit->abt", offsets, seen) / (2 * n)
    else:
        H = model.jacobian(place)
        z = model.observe(place)
        cross = np.einsum("ijt,kjt->ikt", covariances[:, :2], H)
        S = np.einsum("ijt,jkt->ikt", H, cross[:2]) + model.noise(place)
    S = linalg.symmetrise(S)
    gain = np.einsum("ijt,jkt->ikt", cross, linalg.inverse(S))
    shape = (len(z), T, returns.shape[1])
    innovations = model.difference(np.broadcast_to(returns[:, None], shape), np.broadcast_to(z[:, :, None], shape))
    return Prediction(z, S, gain, innovations)
