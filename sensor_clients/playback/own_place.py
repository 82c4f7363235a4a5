"""Where a robot is, by its odometry and the landmarks of a known map: an extended Kalman filter.

    state       x, y, heading, a, b          a, b: the odometry's speed and turn rate are off by 1 + a and 1 + b
    predict     x' = x + (1+a) v dt cos h,   y' = y + (1+a) v dt sin h,   h' = h + (1+b) w dt
    update      range |m - p| and bearing atan2(m - p) - h of landmark m, those outside the gate left out

It begins with what it sees: the landmarks seen in the last seconds, each once, put together by odometry, are laid on
the map (rotation and shift of least squares; Umeyama 1991), then by Gauss and Newton in range and bearing, whose
normal matrix gives the covariance. Until then, and when the landmarks contradict it for long, it has no place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from fusion_service.metrics import chi2_quantile
from sensor_clients.filters.measurement import Floats
from sensor_clients.playback.robot import Robot, wrapped

__all__ = ["OwnPlace", "Pose"]

SECOND = 1e-9
DEGENERATE = 1e12
"""Condition from which the sightings do not determine a pose."""


class Pose(NamedTuple):
    """x, y (m) and heading (rad) (3,), with their covariance (3, 3)."""

    mean: Floats
    covariance: Floats

    @property
    def heading_shift(self) -> Floats:
        """How far (2,) the place is likely off for each rad that the heading is: P_ph / P_hh, m/rad."""
        return np.asarray(self.covariance[:2, 2] / self.covariance[2, 2])

    @property
    def common(self) -> Floats:
        """Covariance (2, 2), m2, of the place given the heading: a shift that is the same for all that is seen."""
        g = self.heading_shift
        return np.asarray(self.covariance[:2, :2] - np.outer(g, g) * self.covariance[2, 2])

    def turning(self, place: Floats) -> Floats:
        """Covariance (2, 2), m2, of the rest at `place` (2,): what the heading moves there, the own place with it.
        With `common` it is the whole effect of the pose on what is seen there."""
        sight = place - self.mean[:2]
        u = self.heading_shift + np.array([-sight[1], sight[0]])
        return np.asarray(np.outer(u, u) * self.covariance[2, 2])


class _Sighting(NamedTuple):
    """A landmark at `time`, ns, as seen from `dead` (3,), the pose by odometry alone."""

    time: int
    landmark: int
    range: float
    bearing: float
    dead: Floats


class OwnPlace:
    """One robot's belief about its own pose, event by event in the order of time."""

    def __init__(self, robot: Robot, landmarks: Mapping[int, Floats]) -> None:
        self.robot, self.landmarks = robot, landmarks
        self._object = _objects(landmarks, robot.cluster)
        self.mean: Floats | None = None
        self.covariance: Floats = np.zeros((5, 5))
        self.refused = 0
        self._gate = chi2_quantile(robot.gate, 2)
        self._time: int | None = None
        self._command = (0.0, 0.0)
        self._dead = np.zeros(3)
        self._last: dict[int, int] = {}
        self._pending: list[_Sighting] = []
        self._strikes = 0

    def pose(self) -> Pose | None:
        """Where it is at the time of the last event; None while it does not know."""
        return None if self.mean is None else Pose(self.mean[:3], self.covariance[:3, :3])

    def state(self) -> tuple[Floats, Floats] | None:
        """Mean (4,) and covariance (4, 4) of x, y, vx, vy: what it reports of itself."""
        if self.mean is None:
            return None
        speed = self._command[0] * (1 + self.mean[3])
        c, s = math.cos(self.mean[2]), math.sin(self.mean[2])
        J = np.zeros((4, 5))
        J[0, 0] = J[1, 1] = 1.0
        J[2, 2], J[2, 3] = -speed * s, self._command[0] * c
        J[3, 2], J[3, 3] = speed * c, self._command[0] * s
        P = J @ self.covariance @ J.T
        P[2, 2] += self.robot.speed_error**2
        P[3, 3] += self.robot.speed_error**2
        return np.array([self.mean[0], self.mean[1], speed * c, speed * s]), (P + P.T) / 2

    def command(self, time: int, speed: float, turn: float) -> None:
        """From `time` on the odometry says `speed`, m/s, and `turn`, rad/s."""
        self.advance(time)
        self._command = speed, turn

    def advance(self, time: int) -> None:
        """Predict to `time`, ns."""
        dt = 0.0 if self._time is None else max(0.0, (time - self._time) * SECOND)
        self._time = time
        if not dt:
            return
        (v, w), robot = self._command, self.robot
        middle = self._dead[2] + w * dt / 2
        self._dead = self._dead + np.array([v * dt * math.cos(middle), v * dt * math.sin(middle), w * dt])
        if self.mean is None:
            return
        way, turn = v * dt, w * dt
        x, y, h, a, b = self.mean
        c, s = math.cos(h + (1 + b) * turn / 2), math.sin(h + (1 + b) * turn / 2)
        F = np.eye(5)
        F[0, 2], F[0, 3] = -(1 + a) * way * s, way * c
        F[1, 2], F[1, 3] = (1 + a) * way * c, way * s
        F[2, 4] = turn
        self.mean = np.array([x + (1 + a) * way * c, y + (1 + a) * way * s, h + (1 + b) * turn, a, b])
        self.covariance = F @ self.covariance @ F.T
        moving = robot.walk**2 * dt
        self.covariance[[0, 1, 2], [0, 1, 2]] += [moving, moving, (robot.turn_walk**2 + (robot.slip * w) ** 2) * dt]

    def see(self, time: int, landmark: int, distance: float, bearing: float) -> None:
        """A landmark at `distance`, m, and `bearing`, rad, at `time`, ns."""
        self.advance(time)
        last = self._last.get(self._object[landmark])
        times = 1.0 if last is None else self.robot.repeated((time - last) * SECOND)
        if self.mean is None:
            self._pending.append(_Sighting(time, landmark, distance, bearing, self._dead))
            self._begin(time)
            return
        nu, H, R = self._compare(self.mean[:3], landmark, distance, bearing)
        H5 = np.hstack([H, np.zeros((2, 2))])
        S = H5 @ self.covariance @ H5.T
        if not nu @ np.linalg.solve(S + np.diag(R), nu) <= self._gate:
            self.refused += 1
            self._strikes += 1
            if self._strikes >= self.robot.lost:
                self.mean, self._pending, self._last, self._strikes = None, [], {}, 0
            return
        self._strikes = 0
        self._last[self._object[landmark]] = time
        S = S + np.diag(R) * times
        K = np.linalg.solve(S, H5 @ self.covariance).T
        self.mean = self.mean + K @ nu
        self.covariance = self.covariance - K @ S @ K.T
        self.covariance = (self.covariance + self.covariance.T) / 2

    def _compare(self, pose: Floats, landmark: int, distance: float, bearing: float) -> tuple[Floats, Floats, Floats]:
        """Innovation (2,), its Jacobian by the pose (2, 3) and its variances (2,)."""
        x, y = self.landmarks[landmark] - pose[:2]
        r = max(math.hypot(x, y), 1e-3)
        nu = np.array([distance - r, wrapped(bearing - math.atan2(y, x) + pose[2])])
        H = np.array([[-x / r, -y / r, 0.0], [y / r**2, -x / r**2, -1.0]])
        return nu, H, self.robot.noise(np.array(r))

    def _begin(self, time: int) -> None:
        """Lay what was seen lately on the map, if that is enough and agrees."""
        robot = self.robot
        newest = {one.landmark: one for one in self._pending if (time - one.time) * SECOND <= robot.reach}
        self._pending = list(newest.values())
        places = np.array([self.landmarks[one.landmark] for one in self._pending])
        if len(places) < robot.landmarks or np.ptp(places, axis=0).max() < robot.baseline:
            return
        fit = self._lay(places, time)
        if fit is None:
            del self._pending[0]
            return
        pose, covariance = fit
        self.mean = np.concatenate([pose, np.zeros(2)])
        self.covariance = np.diag([0.0, 0.0, 0.0, robot.scale**2, robot.scale**2])
        self.covariance[:3, :3] = covariance
        self._last = {self._object[one.landmark]: one.time for one in self._pending}
        self._pending = []

    def _lay(self, places: Floats, time: int) -> tuple[Floats, Floats] | None:
        """The pose now and its covariance by the pending sightings; None if they contradict each other."""
        seen = [self._relative(one) for one in self._pending]
        found = np.array([[r * math.cos(b), r * math.sin(b)] for r, b in seen])
        away, there = found - found.mean(axis=0), places - places.mean(axis=0)
        h = math.atan2(float((away[:, 0] * there[:, 1] - away[:, 1] * there[:, 0]).sum()), float((away * there).sum()))
        turned = np.array([[math.cos(h), -math.sin(h)], [math.sin(h), math.cos(h)]]) @ found.mean(axis=0)
        pose = np.array([*(places.mean(axis=0) - turned), h])
        objects = [self._object[one.landmark] for one in self._pending]
        shared = np.array([[float(objects.count(one))] for one in objects])
        ages = np.array([(time - one.time) * SECOND for one in self._pending])
        for _ in range(10):
            rows = [self._compare(pose, one.landmark, r, b) for one, (r, b) in zip(self._pending, seen, strict=True)]
            nu, H, R = (np.array(column) for column in zip(*rows, strict=True))
            R = R * shared + np.outer(ages, [self.robot.walk**2, self.robot.turn_walk**2])
            normal = np.einsum("kai,ka,kaj->ij", H, 1 / R, H)
            if not np.isfinite(normal).all() or np.linalg.cond(normal) > DEGENERATE:
                return None
            pose = pose + np.linalg.solve(normal, np.einsum("kai,ka,ka->i", H, 1 / R, nu))
        misfit = float((nu**2 / R).sum())
        if not misfit <= chi2_quantile(self.robot.gate, 2 * len(rows) - 3):
            return None
        pose[2] = wrapped(float(pose[2]))
        return pose, np.linalg.inv(normal)

    def _relative(self, one: _Sighting) -> tuple[float, float]:
        """Range and bearing of a sighting as they would be from where the robot is now, by odometry."""
        angle = one.dead[2] + one.bearing
        x = one.dead[0] + one.range * math.cos(angle) - self._dead[0]
        y = one.dead[1] + one.range * math.sin(angle) - self._dead[1]
        return math.hypot(x, y), wrapped(math.atan2(y, x) - self._dead[2])


def _objects(landmarks: Mapping[int, Floats], cluster: float) -> dict[int, int]:
    """Which object each landmark is on: the first of those, by number, that it is near to."""
    found: dict[int, int] = {}
    for number, place in sorted(landmarks.items()):
        near = (one for one in found if found[one] == one and math.dist(place, landmarks[one]) < cluster)
        found[number] = next(near, number)
    return found
