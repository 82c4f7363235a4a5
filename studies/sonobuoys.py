"""The world of Dubey IV: a field of sonobuoys in four sub-regions, each with a tracker of its own.

States are (x, y, vx, vy) or (x, y, vx, vy, turn rate), m, m/s, rad/s; the four trackers are 1 south-west, 2 south-east,
3 north-west, 4 north-east (the order in which the paper's target meets them says so). The batch is (trackers, runs).

    CT    (4), and (5) with the signs that follow from it: cov(x, vy) = +s / Omega^2, cov(y, vx) = -s / Omega^2
    h     (7), bearing clockwise from north, R = (2 deg)^2
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.rules import Fused
from sensor_clients.filters import kalman, shifted_rayleigh, sigma_points
from sensor_clients.filters.kalman import Estimate
from sensor_clients.filters.sigma_points import Rule
from studies.study import Floats

__all__ = [
    "CT",
    "CV",
    "FILTERS",
    "KNOT",
    "Q1",
    "STEPS",
    "TRACKERS",
    "Readings",
    "Scenario",
    "T",
    "Tracks",
    "centres",
    "field",
    "fly",
    "move",
    "noise",
    "select",
    "triangulate",
    "truth",
]

KNOT = 1852 / 3600
T, STEPS, SIGMA = 15.0, 144, np.radians(2.0)
SIDE, TRACKERS, SENSORS = 10_000.0, 4, 25
RESELECT = 8
Q1, Q2 = 1.944 / 60**3, np.radians(0.1) ** 2 / 60**3
"""1.944 m^2/min^3; 0.01 deg^2/min^3, where Table I has 0.01 rad^2/min^3."""
FILTERS: dict[str, Callable[[int], Rule] | None] = {
    "SRF": None,
    "CKF": sigma_points.cubature,
    "CQKF": sigma_points.cubature_quadrature,
    "UKF": sigma_points.unscented,
    "GHF": sigma_points.gauss_hermite,
}


@dataclass(frozen=True, slots=True)
class Scenario:
    """start: m; course: rad, clockwise from north; turn: rad/s, counterclockwise, None for constant velocity."""

    number: int
    start: tuple[float, float]
    course: float
    turn: float | None

    @property
    def n(self) -> int:
        return 4 if self.turn is None else 5

    def state(self) -> Floats:
        v = 10 * KNOT
        velocity = (v * np.sin(self.course), v * np.cos(self.course))
        return np.array([*self.start, *velocity, *(() if self.turn is None else (self.turn,))])


CV = Scenario(1, (9000.0, 9000.0), np.radians(-130.0), None)
CT = Scenario(2, (8500.0, 8000.0), np.radians(-165.0), np.radians(-1.84) / 60)


@dataclass(frozen=True, slots=True)
class Readings:
    """What the paper leaves open. velocity (and turn rate) of the first estimate: "drawn", the true one and an error
    of the stated covariance, "zero", or "triangulated" as (31) has it; top_speed: v_m of (32), m/s; turn_spread:
    standard deviation of the first turn rate, rad/s; driven: process noise in the truth too; q2: rad^2/s^3; inverse:
    the trace of the inverse of the Fisher information is minimised, not of itself as printed."""

    velocity: str = "drawn"
    top_speed: float = 0.5 * KNOT
    turn_spread: float = np.radians(0.1) / 60
    driven: bool = True
    q2: float = Q2
    inverse: bool = True


class Tracks(NamedTuple):
    """Local tracks at steps 0 to K: means (K+1, N, n, M), covariances (K+1, N, n, n, M); the weights (K+1, N, M) of a
    consensus that was fed back, after which all N are the same."""

    means: Floats
    covariances: Floats
    weights: Floats | None


def centres() -> Floats:
    """Middle of each sub-region (2, N), m: where its tracker is."""
    return _corners() + 0.25 * SIDE


def _corners() -> Floats:
    return 0.5 * SIDE * np.array([[0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 1.0, 1.0]])


def field(rng: np.random.Generator, layouts: int) -> Floats:
    """Sensors (2, 25, N, layouts), m: 25 uniform in each of the four squares."""
    return _corners()[:, None, :, None] + 0.5 * SIDE * rng.random((2, SENSORS, TRACKERS, layouts))


def noise(scenario: Scenario, turn: Floats, q2: float = Q2) -> Floats:
    """Q (n, n, ...): (2), or (5) corrected, at turn rates (...)."""
    a = turn * T
    small = np.abs(a) < 0.1
    b = np.where(small, 1.0, a)
    g = np.where(small, 1 / 6 - a**2 / 120 + a**4 / 5040, (b - np.sin(b)) / b**3)
    half = 0.5 * np.sinc(a / (2 * np.pi)) ** 2
    Q = np.zeros((scenario.n, scenario.n, *a.shape))
    Q[0, 0] = Q[1, 1] = 2 * g * T**3 * Q1
    Q[0, 2] = Q[2, 0] = Q[1, 3] = Q[3, 1] = half * T**2 * Q1
    Q[0, 3] = Q[3, 0] = a * g * T**2 * Q1
    Q[1, 2] = Q[2, 1] = -a * g * T**2 * Q1
    Q[2, 2] = Q[3, 3] = T * Q1
    if scenario.n == 5:
        Q[4, 4] = q2 * T
    return Q


def move(x: Floats) -> Floats:
    """One step of (1) or (4) for states (n, ...)."""
    a = x[4] * T if len(x) == 5 else np.zeros_like(x[0])
    along, across = T * np.sinc(a / np.pi), 0.5 * T * a * np.sinc(a / (2 * np.pi)) ** 2
    c, s = np.cos(a), np.sin(a)
    out = x.copy()
    out[0] += along * x[2] - across * x[3]
    out[1] += across * x[2] + along * x[3]
    out[2], out[3] = c * x[2] - s * x[3], s * x[2] + c * x[3]
    return out


def truth(scenario: Scenario, rng: np.random.Generator, runs: int, readings: Readings, steps: int = STEPS) -> Floats:
    """True states (K+1, n, M)."""
    x = np.repeat(scenario.state()[:, None], runs, axis=1)
    path = [x]
    for _ in range(steps):
        Q = noise(scenario, x[4] if scenario.n == 5 else np.zeros(runs), readings.q2)
        root = np.linalg.cholesky(np.moveaxis(Q, -1, 0))
        w = np.einsum("mij,jm->im", root, rng.standard_normal((scenario.n, runs)))
        x = move(x) + w * readings.driven
        path.append(x)
    return np.array(path)


def select(place: Floats, sensors: Floats, count: int, inverse: bool = True) -> NDArray[np.intp]:
    """Indices (count, B) of the sensors (2, S, B) for a target at (2, B): the best pair of all, then one at a time the
    best to add. Best: least trace of the inverse of the Fisher information sum_i u_i u_i' / r_i^2, u_i across the line
    of sight; or of itself, which is what is printed."""
    d = place[:, None] - sensors
    r4 = np.maximum(d[0] ** 2 + d[1] ** 2, 1.0) ** 2
    info = np.stack([d[1] ** 2, -d[0] * d[1], d[0] ** 2]) / r4

    def cost(J: Floats) -> Floats:
        trace: Floats = J[0] + J[2]
        return trace / np.maximum(J[0] * J[2] - J[1] ** 2, 1e-300) if inverse else trace

    S, B = info.shape[1:]
    first, second = np.triu_indices(S, 1)
    best, least = np.zeros(B, dtype=np.intp), np.full(B, np.inf)
    for i in range(S - 1):
        rows = cost(info[:, i, None] + info[:, i + 1 :])
        at = rows.argmin(axis=0)
        value = np.take_along_axis(rows, at[None], 0)[0]
        best = np.where(value < least, i * (2 * S - i - 1) // 2 + at, best)
        least = np.minimum(value, least)
    chosen = [first[best], second[best]]
    every = np.arange(B)
    J = info[:, chosen[0], every] + info[:, chosen[1], every]
    while len(chosen) < count:
        value = cost(J[:, None] + info)
        for one in chosen:
            value[one, every] = np.inf
        chosen.append(value.argmin(axis=0))
        J = J + info[:, chosen[-1], every]
    return np.array(chosen)


def _bearing(x: Floats, sensors: Floats) -> Floats:
    return np.asarray(np.arctan2(x[0] - sensors[0], x[1] - sensors[1]))


def _wrapped(a: Floats, b: Floats) -> Floats:
    return np.asarray((a - b + np.pi) % (2 * np.pi) - np.pi)


def triangulate(sensors: Floats, bearings: Floats) -> tuple[Floats, Floats]:
    """Place (2, B) and covariance (2, 2, B) of two bearings (2, B) from sensors (2, 2, B): (30), (33)."""
    (x1, x2), (y1, y2) = sensors
    z1, z2 = bearings
    reach = ((y2 - y1) * np.sin(z2) - (x2 - x1) * np.cos(z2)) / np.sin(z2 - z1)
    place = np.stack([x1 + reach * np.sin(z1), y1 + reach * np.cos(z1)])
    d = place[:, None] - sensors
    slope = np.stack([d[1], -d[0]]) / (d[0] ** 2 + d[1] ** 2)
    return place, SIGMA**2 * linalg.inverse(linalg.product(slope, slope.swapaxes(0, 1)))


def _begin(readings: Readings, true: Floats, sensors: Floats, errors: Floats, drawn: Floats) -> Estimate:
    """The first estimates of a batch (B,): true states (2, n, B) of steps 0 and 1, two sensors (2, 2, B), errors of
    their bearings (2, 2, B), rad, and normal numbers (3, B) for velocity and turn rate."""
    n, B = true.shape[1:]
    at = [triangulate(sensors, _bearing(x[:, None], sensors) + v) for x, v in zip(true, errors, strict=True)]
    mean, covariance = np.zeros((n, B)), np.zeros((n, n, B))
    mean[:2], covariance[:2, :2] = at[0]
    covariance[2, 2] = covariance[3, 3] = readings.top_speed**2 / 3
    if n == 5:
        covariance[4, 4] = readings.turn_spread**2
    if readings.velocity == "drawn":
        mean[2:] = true[0, 2:] + np.sqrt(covariance[range(2, n), range(2, n)]) * drawn[: n - 2]
    elif readings.velocity == "triangulated":
        mean[2:4] = (at[1][0] - at[0][0]) / T
    return Estimate(mean, covariance)


def _steps(scenario: Scenario, name: str, q2: float) -> tuple[Callable[[Estimate], Estimate], Callable[..., Estimate]]:
    """Prediction, and update(state, sensors, bearings), of the filter `name`."""
    make = FILTERS[name]
    rule = (make or sigma_points.cubature)(scenario.n)
    F = move(np.eye(4)) if scenario.n == 4 else None

    def predict(state: Estimate) -> Estimate:
        if F is not None:
            return kalman.predict(state, F, noise(scenario, np.zeros(())))
        return sigma_points.predict(rule, move, state, noise(scenario, state.mean[4], q2))

    def update(state: Estimate, sensors: Floats, bearings: Floats) -> Estimate:
        if make is None:
            return shifted_rayleigh.update(state, sensors, bearings, SIGMA)
        R = SIGMA**2 * np.eye(len(bearings))
        seen = sensors[:, :, None]
        return sigma_points.update(rule, lambda x: _bearing(x[:, None], seen), state, R, bearings, _wrapped)

    return predict, update


def fly(
    scenario: Scenario,
    rng: np.random.Generator,
    sensors: Floats,
    count: int = 2,
    name: str = "SRF",
    consensus: Callable[[Floats, Floats], Fused] | None = None,
    readings: Readings = Readings(),
    steps: int = STEPS,
) -> tuple[Floats, Tracks]:
    """Truth (K+1, n, M) and tracks of M runs with sensors (2, 25, N, M), `count` of them selected by each tracker every
    2 min about its own estimate (the first time about the true place), by the filter `name`. consensus: the four
    posteriors are fused so, and all trackers go on from the result. The same `rng`: same truth, and errors of the
    sensors the same for any filter and rule."""
    M, n, most = sensors.shape[-1], scenario.n, 4
    true = truth(scenario, rng, M, readings, steps)
    field = sensors.reshape(2, SENSORS, TRACKERS * M)
    errors = SIGMA * rng.standard_normal((steps + 1, most, TRACKERS * M))
    drawn = rng.standard_normal((3, TRACKERS * M))
    tiled = np.tile(true, (1, 1, TRACKERS))
    every = np.arange(TRACKERS * M)
    active = field[:, select(tiled[0, :2], field, count, readings.inverse), every]
    state = _begin(readings, tiled[:2], active[:, :2], errors[:2, :2], drawn)
    predict, update = _steps(scenario, name, readings.q2)
    means = np.empty((steps + 1, TRACKERS, n, M))
    covariances = np.empty((steps + 1, TRACKERS, n, n, M))
    weights = None if consensus is None else np.empty((steps + 1, TRACKERS, M))
    for k in range(steps + 1):
        if k:
            state = predict(state)
            if k % RESELECT == 0:
                active = field[:, select(state.mean[:2], field, count, readings.inverse), every]
            z = _bearing(tiled[k, :, None], active) + errors[k, :count]
            state = update(state, active, z)
        means[k] = np.moveaxis(state.mean.reshape(n, TRACKERS, M), 1, 0)
        covariances[k] = np.moveaxis(state.covariance.reshape(n, n, TRACKERS, M), 2, 0)
        if consensus is not None and weights is not None:
            fused = consensus(means[k], covariances[k])
            means[k], covariances[k], weights[k] = fused.mean, fused.covariance, fused.weights
            state = Estimate(np.tile(fused.mean, TRACKERS), np.tile(fused.covariance, TRACKERS))
    return true, Tracks(means, covariances, weights)
