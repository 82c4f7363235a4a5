"""What is known of one MR.CLAM robot, as data: its camera, its odometry, how robots move.

The camera tells range by the apparent height of a barcode, so its error grows with range, and it stays the same for
as long as the barcode is seen from the same side. Such an error, of correlation e^(-dt / tau) between sightings dt
apart, is taken as if it were independent from one to the next, but larger: the first sighting has the variance R, each
further one R (1 + rho) / (1 - rho) = R coth(dt / 2 tau). For a first-order Markov error of a thing that stands still
that is exact: n sightings together hold the information (1 + (n - 1) (1 - rho) / (1 + rho)) / R.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from fusion_service import linalg
from schemas import Motion
from sensor_clients.events import Parameter
from sensor_clients.filters.measurement import Floats, sight_covariance

__all__ = ["MRCLAM", "Robot", "Sight", "wrapped"]


def wrapped(angle: float) -> float:
    """The same angle in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


@dataclass(frozen=True, slots=True)
class Robot:
    """Lengths in m, times in s, angles in rad.

    The camera: standard deviations at range r are hypot(sigma_range, share_range r) and
    hypot(sigma_bearing, sigma_cross / r); correlated: tau of both errors. The odometry: speed and turn rate are
    scaled by unknown factors of standard deviation scale about 1; the way and the heading walk at random by
    walk (m/sqrt s) and turn_walk (rad/sqrt s), the heading by slip rad/sqrt s more for each rad/s that it turns.
    speed_error: of the velocity reported, m/s, per axis. gate: the probability inside the gates. reach: how long ago
    a landmark may have been seen that tells a robot where it starts; landmarks, baseline: how many it takes, and how
    far apart; cluster: landmarks nearer than this to one another are one object, whose errors are the same. strikes,
    lost: so many sightings in a row outside the gate end a track, or the belief in the own place. confirm: so many
    sightings make a track that is reported (a misread barcode stays misread for one or two).
    Other robots: speed, legs: how fast, and for how long one way; vague: a track whose standard deviation is larger is
    dropped.
    """

    sigma_range: float = 0.05
    share_range: float = 0.04
    sigma_bearing: float = 0.01
    sigma_cross: float = 0.02
    correlated: float = 5.0
    scale: float = 0.1
    walk: float = 0.02
    turn_walk: float = 0.016
    slip: float = 0.3
    speed_error: float = 0.01
    gate: float = 0.999
    reach: float = 30.0
    landmarks: int = 3
    baseline: float = 1.0
    cluster: float = 0.6
    strikes: int = 3
    lost: int = 20
    confirm: int = 3
    speed: float = 0.06
    legs: float = 30.0
    vague: float = 0.5

    @property
    def motion(self) -> Motion:
        """White acceleration of q = speed^2 / legs on each axis: as fast as the velocity of one that drives at
        `speed` and takes a new direction every `legs` s forgets its direction, 2 (speed^2 / 2) / legs."""
        return Motion("cv", self.speed**2 / self.legs)

    def noise(self, r: Floats) -> Floats:
        """Variances (2, ...) of range and bearing, m2 and rad2, at ranges (...)."""
        near = np.maximum(r, 0.1)
        return np.stack(
            [self.sigma_range**2 + (self.share_range * r) ** 2, self.sigma_bearing**2 + (self.sigma_cross / near) ** 2]
        )

    def repeated(self, dt: float) -> float:
        """How many times larger the variance of a sighting counts, `dt` s after the last of the same object."""
        return 1.0 / math.tanh(max(dt, 1e-3) / (2.0 * self.correlated))

    def parameters(self) -> list[Parameter]:
        """One row for `sensor-client list` per number."""
        rows = [Parameter(one.name, f"{getattr(self, one.name):g}", SOURCES[one.name]) for one in fields(self)]
        return [*rows, Parameter("motion", f"cv, q = {self.motion.q:g} m2/s3", "speed^2 / legs")]


CAMERA = "camera beside the surveyed landmarks"
ODOMETRY = "odometry beside motion capture, one second at a time"
SOURCES = {
    "sigma_range": CAMERA,
    "share_range": CAMERA,
    "sigma_bearing": CAMERA,
    "sigma_cross": CAMERA,
    "correlated": f"{CAMERA}: a third to a half left after 5 s",
    "scale": "chosen: what odometry without calibration may be wrong by",
    "walk": "innovations of landmarks not seen for long (NIS), and the own place beside motion capture",
    "turn_walk": ODOMETRY,
    "slip": ODOMETRY,
    "speed_error": "chosen",
    "gate": "chosen",
    "reach": "chosen",
    "landmarks": "chosen",
    "baseline": "chosen",
    "cluster": "map: barcodes stand in twos and threes",
    "strikes": "chosen",
    "confirm": "chosen: a barcode is misread once or twice, seldom more",
    "lost": "chosen",
    "speed": "odometry: what the robots drive",
    "legs": "odometry: after so long the direction is as good as new",
    "vague": "chosen",
}
"""Where each number comes from. None was tuned on what the centre makes of it."""

MRCLAM = Robot()


@dataclass(frozen=True, slots=True)
class Sight:
    """Range and bearing (left positive, from the heading) from a robot that believes itself at `origin`, m, with
    `heading`, rad; the variances count `times` as much. A `MeasurementModel`."""

    robot: Robot
    origin: tuple[float, float]
    heading: float
    times: float = 1.0

    def _sight(self, place: Floats) -> Floats:
        return np.stack([place[0] - self.origin[0], place[1] - self.origin[1]])

    def observe(self, place: Floats) -> Floats:
        x, y = self._sight(place)
        return np.stack([np.hypot(x, y), np.arctan2(y, x) - self.heading])

    def jacobian(self, place: Floats) -> Floats:
        x, y = self._sight(place)
        r2 = np.maximum(x * x + y * y, 1e-6)
        r = np.sqrt(r2)
        return np.stack([np.stack([x / r, y / r]), np.stack([-y / r2, x / r2])])

    def noise(self, place: Floats) -> Floats:
        variances = self.robot.noise(np.hypot(*self._sight(place))) * self.times
        R = np.zeros((2, 2, *variances.shape[1:]))
        R[0, 0], R[1, 1] = variances
        return R

    def difference(self, a: Floats, b: Floats) -> Floats:
        d = a - b
        d[1] = (d[1] + math.pi) % (2 * math.pi) - math.pi
        return np.asarray(d)

    def locate(self, returns: Floats) -> tuple[Floats, Floats]:
        """To first order: the bearing's error is too small to bend what it makes of a range."""
        r, angle = returns[0], returns[1] + self.heading
        unit = np.stack([np.cos(angle), np.sin(angle)])
        along, across = self.robot.noise(r) * self.times
        mean = np.array(self.origin)[:, None] + r * unit
        return mean, linalg.symmetrise(sight_covariance(unit, along, r * r * across))
