"""Local trackers of many targets at once, each track given the measurements of its own target: nothing is mistaken.

A tracker is a Kalman filter, linearised where its sensor is not linear (EKF), or an IMM of such, with nearly constant
velocity; the filter that has all measurements of all sensors (centralised) is one of the same kind. Batch last: means
(4, B), covariances (4, 4, B) of x, y, vx, vy.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fusion_service import linalg
from fusion_service.motion import predict
from schemas import Motion
from sensor_clients.filters import STATE, MeasurementModel, Modes
from sensor_clients.filters.imm import mix
from sensor_clients.filters.kalman import Estimate, correct
from sensor_clients.filters.mixture import moments
from studies.study import Floats

__all__ = ["Bank", "Central", "Sensor", "World", "nanoseconds", "targets", "times"]


class Sensor(NamedTuple):
    """Measures each target every `period` s, first `phase` s after the start (or one period); origin: its place, m.
    loss: share of tracks that a message lacks; late: s after which a message arrives."""

    model: MeasurementModel
    period: float = 1.0
    phase: float = 0.0
    origin: tuple[float, float] = (0.0, 0.0)
    loss: float = 0.0
    late: float = 0.0


@dataclass(frozen=True, slots=True)
class World:
    """Targets, `spacing` m apart on a grid, speeds at first of `speed` m/s (1 sigma, each axis), and who tracks them.

    How they move: nearly constant velocity of intensity q, m2/s3; or `bursts`: q jumps; or they turn, by `turn` rad/s
    half of the time (10 s straight, 10 s left, 10 s straight, 10 s right, each target at a time of its own).
    filter_q: what the trackers think (None: q), or `modes` of their IMM; declared: what they say it is (None: what they
    think); mixtures: an IMM sends its modes, else their moments. The centre steps every `period` s, `steps` times, and
    the first `warm` do not count.
    """

    sensors: tuple[Sensor, ...]
    q: float = 1.0
    bursts: Modes | None = None
    turn: float = 0.0
    filter_q: float | None = None
    modes: Modes | None = None
    declared: float | None = None
    mixtures: bool = False
    period: float = 1.0
    steps: int = 70
    warm: int = 20
    spacing: float = 20e3
    speed: float = 20.0

    @property
    def believed(self) -> tuple[float, ...]:
        """The intensities of the trackers' modes."""
        if self.modes is not None:
            return self.modes.intensities
        return (self.q if self.filter_q is None else self.filter_q,)

    @property
    def said(self) -> Motion:
        """The motion that the trackers declare."""
        if self.declared is not None:
            return Motion("cv", self.declared)
        return self.modes.motion() if self.modes is not None else Motion("cv", self.believed[0])


def nanoseconds(seconds: float) -> int:
    """Seconds as the messages have them."""
    return round(seconds * 1e9)


def times(world: World) -> dict[int, list[int]]:
    """All times, ns, at which there is something to do, in order, each with the sensors that measure then."""
    end = world.period * world.steps
    found: dict[int, list[int]] = {nanoseconds(world.period * k): [] for k in range(1, world.steps + 1)}
    for number, sensor in enumerate(world.sensors):
        first = sensor.phase or sensor.period
        for k in range(1 + int((end - first) / sensor.period + 1e-9)):
            found.setdefault(nanoseconds(first + k * sensor.period), []).append(number)
    return dict(sorted(found.items()))


def targets(world: World, count: int, rng: np.random.Generator) -> Iterator[Floats]:
    """States (4, B) of `count` targets at each of the `times`."""
    side = int(np.ceil(np.sqrt(count)))
    place = (np.stack(np.divmod(np.arange(count), side)) - 0.5 * (side - 1)) * world.spacing
    x = np.concatenate([place, world.speed * rng.standard_normal((2, count))])
    begins = rng.uniform(0.0, 40.0, count)
    bursts = world.bursts
    mode = np.zeros(count, dtype=np.intp) if bursts is None else rng.choice(2, count, p=bursts.stationary())
    last = 0
    for time in times(world):
        dt = (time - last) / 1e9
        q = np.full(count, world.q)
        if bursts is not None:
            change = bursts.transition(dt)
            mode = np.where(rng.random(count) < change[mode, 1 - mode], 1 - mode, mode)
            q = np.array(bursts.intensities)[mode]
        noise = np.linalg.cholesky(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])) * np.sqrt(q)[:, None, None]
        shock = (noise @ rng.standard_normal((2, count, 2, 1)))[..., 0]
        part = ((last / 1e9 + begins) % 40.0) // 10.0
        rate = world.turn * np.where(part == 1, 1.0, np.where(part == 3, -1.0, 0.0))
        x = _turned(x, rate, dt)
        x[:2] += shock[..., 0]
        x[2:] += shock[..., 1]
        last = time
        yield x


def _turned(x: Floats, rate: Floats, dt: float) -> Floats:
    """States after `dt` s of constant speed and turn rate (B,), rad/s."""
    angle = rate * dt
    ahead = dt * np.sinc(angle / np.pi)  # sin(a) / a
    aside = dt * np.sin(angle / 2) * np.sinc(angle / (2 * np.pi))  # (1 - cos(a)) / a
    c, s, (vx, vy) = np.cos(angle), np.sin(angle), x[2:]
    return np.stack([x[0] + ahead * vx - aside * vy, x[1] + aside * vx + ahead * vy, c * vx - s * vy, s * vx + c * vy])


class Bank:
    """A tracker of B targets: mode probabilities (C, B), and the modes' means (4, C, B) and covariances."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.time = -1
        self.weights = np.zeros((0, 0))
        self.parts, self.spreads = np.zeros((4, 0, 0)), np.zeros((4, 4, 0, 0))

    def copy(self) -> Bank:
        """Another that goes on from the same; arrays are never changed in place."""
        other = Bank(self.world)
        other.time, other.weights, other.parts, other.spreads = self.time, self.weights, self.parts, self.spreads
        return other

    def _moved(self, time: int) -> tuple[Floats, Floats, Floats]:
        weights, parts, spreads = self.weights, self.parts, self.spreads
        if time == self.time:
            return weights, parts, spreads
        dt, modes = (time - self.time) / 1e9, self.world.modes
        if modes is not None:
            weights, parts, spreads = mix(weights, parts, spreads, modes.transition(dt))
        step = np.full(weights.shape[1], dt)
        moved = [
            predict(Motion("cv", q), STATE, np.ascontiguousarray(parts[:, m]), np.ascontiguousarray(P), step)
            for m, (q, P) in enumerate(zip(self.world.believed, np.moveaxis(spreads, 2, 0), strict=True))
        ]
        return weights, np.stack([x for x, _ in moved], axis=1), np.stack([P for _, P in moved], axis=2)

    def update(self, time: int, sensor: Sensor, z: Floats) -> None:
        """Take in measurements z (2, B) of that time, ns."""
        if self.time < 0:
            self._begin(time, sensor, z)
            return
        weights, parts, spreads = self._moved(time)
        updated, likelihood = [], []
        for m in range(len(weights)):
            place = parts[:2, m] - np.array(sensor.origin)[:, None]
            state = Estimate(parts[:, m], spreads[:, :, m])
            H = np.zeros((2, 4, z.shape[1]))
            H[:, :2] = sensor.model.jacobian(place)
            S = linalg.congruence(H, state.covariance) + sensor.model.noise(place)
            away = sensor.model.difference(z, sensor.model.observe(place))
            updated.append(correct(state, away, S, linalg.product(state.covariance, H.swapaxes(0, 1))))
            likelihood.append(-0.5 * (linalg.quadratic(S, away) + linalg.logdet(S)))
        score = np.array(likelihood)
        weights = weights * np.exp(score - score.max(axis=0))
        self.time, self.weights = time, weights / weights.sum(axis=0)
        self.parts = np.stack([one.mean for one in updated], axis=1)
        self.spreads = linalg.symmetrise(np.stack([one.covariance for one in updated], axis=2))

    def _begin(self, time: int, sensor: Sensor, z: Floats) -> None:
        place, spread = sensor.model.locate(z)
        mean = np.concatenate([place + np.array(sensor.origin)[:, None], np.zeros_like(place)])
        P = np.zeros((4, 4, z.shape[1]))
        P[:2, :2], P[2, 2], P[3, 3] = spread, self.world.speed**2, self.world.speed**2
        modes = self.world.modes
        share = np.ones(1) if modes is None else modes.stationary()
        self.time, self.weights = time, np.repeat(share[:, None], z.shape[1], axis=1)
        self.parts, self.spreads = np.repeat(mean[:, None], len(share), 1), np.repeat(P[:, :, None], len(share), 2)

    def goes_on(self, time: int, mean: Floats, covariance: Floats) -> None:
        """From another's estimate (4, B), (4, 4, B) of that time, ns: feedback. Only without modes."""
        self.time, self.weights = time, np.ones((1, mean.shape[1]))
        self.parts, self.spreads = mean[:, None], covariance[:, :, None]

    def at(self, time: int) -> tuple[Floats, Floats]:
        """Mean (4, B) and covariance (4, 4, B), predicted to a time, ns."""
        return moments(*self._moved(time))


class Central:
    """The filter that has all measurements which have arrived, whatever is lost of the messages between."""

    def __init__(self, world: World) -> None:
        self._base = Bank(world)
        self._open: list[tuple[int, int, int, Sensor, Floats]] = []
        self._latest = nanoseconds(max(sensor.late for sensor in world.sensors))
        self._count = 0

    def add(self, time: int, sensor: Sensor, z: Floats) -> None:
        """A measurement of that time, ns."""
        self._count += 1
        heapq.heappush(self._open, (time, self._count, time + nanoseconds(sensor.late), sensor, z))

    def at(self, time: int) -> tuple[Floats, Floats]:
        """Its estimate, as `Bank.at`; times do not decrease."""
        while self._open and self._open[0][0] <= time - self._latest:
            then, _, _, sensor, z = heapq.heappop(self._open)
            self._base.update(then, sensor, z)
        now = self._base.copy()
        for then, _, arrives, sensor, z in sorted(self._open, key=lambda one: one[:2]):
            if arrives <= time:
                now.update(then, sensor, z)
        return now.at(time)
