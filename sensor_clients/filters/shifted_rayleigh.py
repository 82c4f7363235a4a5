"""The shifted Rayleigh filter of bearings (Clark, Vinter and Yaqoob 2007), batch last.

A bearing theta is taken as the direction b = (sin theta, cos theta) of a noisy displacement from the sensor,

    y = p - s + v,   v ~ N(0, sigma^2 r^2 I),   r^2 = E|p - s|^2,   p the place, s the sensor's

of which the component along b is noise of no consequence and the one across it is sigma r, the bearing's own error
at that range. With y ~ N(m, S) the range rho = |y| given its direction has a density proportional to

    rho exp(-(rho b - m)' S^-1 (rho b - m) / 2),   so that   t = rho sqrt(b' S^-1 b)   has   t exp(-(t - z)^2 / 2),

a Rayleigh density shifted by z = b' S^-1 m / sqrt(b' S^-1 b). Its mean and variance give the exact mean and covariance
of the state, K = P_xy S^-1, with nothing linearised:

    x' = x + K (E rho b - m),   P' = P - K S K' + var rho K b b' K'

Several bearings are taken in one after another: each is exact for the Gaussian of the moments left by those before,
and the order matters only as far as the posterior is not Gaussian.
"""

from __future__ import annotations

import numpy as np
from scipy.special import erfcx, ndtr

from fusion_service import linalg
from sensor_clients.filters.kalman import Estimate
from sensor_clients.filters.measurement import Floats

__all__ = ["shifted_rayleigh", "update"]

FAR = -40.0
"""Below this shift the mean and variance come from their series in 1 / z."""


def shifted_rayleigh(z: Floats) -> tuple[Floats, Floats]:
    """Mean and variance of the density proportional to t exp(-(t - z)^2 / 2), t > 0.

    With M = sqrt(2 pi) Phi(z) exp(z^2 / 2): mean (z + (z^2 + 1) M) / (1 + z M), mean square 2 + z mean.
    """
    ahead, behind = np.maximum(z, 0.0), np.clip(z, FAR, 0.0)
    small, whole = np.exp(-0.5 * ahead * ahead), np.sqrt(2 * np.pi) * ndtr(ahead)
    near = (ahead * small + (ahead * ahead + 1) * whole) / (small + ahead * whole)
    M = np.sqrt(np.pi / 2) * erfcx(-behind / np.sqrt(2))
    back = (behind + (behind * behind + 1) * M) / (1 + behind * M)
    mean = np.where(z > 0, near, back)
    variance = 2 + z * mean - mean * mean
    q = 1 / np.square(np.minimum(z, FAR))
    far = z < FAR
    mean = np.where(far, np.sqrt(q) * (2 - 12 * q + 90 * q * q) / (1 - 3 * q + 15 * q * q), mean)
    square = q * (6 - 60 * q + 630 * q * q) / (1 - 3 * q + 15 * q * q)
    return mean, np.where(far, square - mean * mean, variance)


def update(state: Estimate, sensors: Floats, bearings: Floats, sigma: float) -> Estimate:
    """Take in bearings (d, B), rad clockwise from the y axis, of standard deviation `sigma`, from sensors at
    (2, d, B) or (2, d, 1), m: one after another. The state's first two components are x and y, m."""
    for sensor, bearing in zip(sensors.swapaxes(0, 1), bearings, strict=True):
        state = _one(state, sensor, bearing, sigma)
    return state


def _one(state: Estimate, sensor: Floats, bearing: Floats, sigma: float) -> Estimate:
    x, P = state
    b = np.stack([np.sin(bearing), np.cos(bearing)])
    m = x[:2] - sensor
    S = P[:2, :2].copy()
    noise = sigma**2 * (m[0] * m[0] + m[1] * m[1] + P[0, 0] + P[1, 1])
    S[0, 0] += noise
    S[1, 1] += noise
    W = linalg.inverse(S)
    Wb = linalg.matvec(W, b)
    scale = 1 / np.sqrt(b[0] * Wb[0] + b[1] * Wb[1])
    mean, variance = shifted_rayleigh(scale * (Wb[0] * m[0] + Wb[1] * m[1]))
    K = linalg.product(P[:, :2], W)
    left = S - variance * scale * scale * linalg.outer(b, b)
    return Estimate(x + linalg.matvec(K, scale * mean * b - m), P - linalg.congruence(K, left))
