"""Between reports that are far apart, and after the last one, the picture is as uncertain as it says."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.geodesy import ecef_to_geodetic, transform
from fusion_service.motion import predict
from schemas import Motion
from tests.centre.worlds import FRAME, SPACE, START, give, info, step, tracks

Floats = NDArray[np.float64]
SEED, TARGETS, PERIOD, SCANS = 20250914, 49, 20.0, 8
SIX = ("x", "vx", "ax", "y", "vy", "ay")
OU, SINGER = Motion("ou", sigma=1.5, tau=25.0), Motion("singer", sigma=1.0, tau=8.0)
STILL = Motion("still", 0.2, sigma=0.3)
SIGMA = 5.0
"""Of a measured place on each axis, m."""


class Targets:
    """Places on a wide grid and what moves about them: position, velocity, acceleration (3, 2, T)."""

    def __init__(self, motion: Motion, rng: np.random.Generator) -> None:
        self.motion, self.rng = motion, rng
        side = round(TARGETS**0.5)
        self.grid = np.array([[100e3 * (k % side), 100e3 * (k // side)] for k in range(TARGETS)]).T
        self.state = np.zeros((3, 2, TARGETS))
        if motion.kind in ("ou", "singer"):
            self.state[1 if motion.kind == "ou" else 2] = motion.sigma * rng.normal(size=(2, TARGETS))

    def move(self, dt: float) -> None:
        """By the stochastic differential equation in its exact discrete form, for all at once."""
        if self.motion.kind == "still":
            self.state[0] += np.sqrt(self.motion.q * dt) * self.rng.normal(size=(2, TARGETS))
            self.state[1] = self.motion.sigma * self.rng.normal(size=(2, TARGETS))
            return
        n = 2 if self.motion.kind == "ou" else 3
        A, W = np.diag(np.ones(n - 1), 1), np.zeros((n, n))
        A[-1, -1], W[-1, -1] = -1 / self.motion.tau, 2 * self.motion.sigma**2 / self.motion.tau
        M = expm(np.block([[-A, W], [np.zeros((n, n)), A.T]]) * dt)
        F = M[n:, n:].T
        root = np.linalg.cholesky(F @ M[:n, n:])
        noise = root @ self.rng.normal(size=(n, 2 * TARGETS))
        self.state[:n] = (F @ self.state[:n].reshape(n, -1) + noise).reshape(n, 2, TARGETS)

    def truth(self) -> Floats:
        """x y vx vy (T, 4)."""
        return np.concatenate([self.grid + self.state[0], self.state[1]]).T


class Tracker:
    """Kalman filters of the targets in `space`, that predict with `motion` and measure places."""

    def __init__(self, targets: Targets, motion: Motion, space: tuple[str, ...]) -> None:
        n, self.motion, self.space = len(space), motion, space
        spread = np.array([50.0, motion.sigma if motion.kind == "ou" else 5.0, 2.0])
        self.x = np.zeros((n, TARGETS))
        self.P = np.repeat(
            np.diag([spread[name.count("v") + 2 * name.count("a")] ** 2 for name in space])[..., None], TARGETS, 2
        )
        self.at = [space.index("x"), space.index("y")]
        self.x[self.at] = targets.truth().T[:2] + 50.0 * targets.rng.normal(size=(2, TARGETS))

    def hear(self, targets: Targets, dt: float) -> None:
        self.x, self.P = predict(self.motion, self.space, self.x, self.P, np.full(TARGETS, dt))
        measured = targets.truth().T[:2] + SIGMA * targets.rng.normal(size=(2, TARGETS))
        for i, z in zip(self.at, measured, strict=True):
            gain = self.P[:, i] / (self.P[i, i] + SIGMA**2)
            self.x = self.x + gain * (z - self.x[i])
            self.P = self.P - gain[:, None] * self.P[None, i]
        self.P = (self.P + self.P.swapaxes(0, 1)) / 2


def nees(made: FusionCentre, second: float, truth: Floats) -> Floats:
    """NEES / 4 of each target's track (T,), and that each has exactly one."""
    picture = step(made, second).tracks
    assert len(picture.ids) == TARGETS
    nearest = np.linalg.norm(picture.means[:, None, :2] - truth[None, :, :2], axis=2).argmin(axis=0)
    assert len(set(nearest.tolist())) == TARGETS
    error = picture.means[nearest] - truth
    return np.asarray(np.einsum("ti,tij,tj->t", error, np.linalg.inv(picture.covariances[nearest]), error) / 4)


def scan(second: float, space: tuple[str, ...], means: Floats, covariances: Floats) -> schemas.LocalTracks:
    """A complete scan of r1: means (T, n), covariances (T, n, n)."""
    empty = tracks("r1", second, np.zeros((len(means), 4)))
    return replace(empty, space=space, means=means, covariances=covariances)


def mission(
    motion: Motion, told: Motion, space: tuple[str, ...], ends: bool = False, settings: dict[str, Any] | None = None
) -> tuple[float, float]:
    """Mean of NEES/n over the steps between reports and 60 s after the last, and its standard error over targets.
    ends: only over the time after the last, and the source starts anew then, with no tracks."""
    targets = Targets(motion, np.random.default_rng(SEED))
    tracker = Tracker(targets, told, space)
    made = FusionCentre({"lateness": 1.0, "period": 5.0, **(settings or {})})
    give(made, info("r1", motion=told, period=PERIOD))
    scores: list[Floats] = []
    second = 0.0
    for number in range(SCANS):
        last = number == SCANS - 1
        tracker.hear(targets, PERIOD if number else 0.0)
        give(made, scan(second, space, tracker.x.T, np.moveaxis(tracker.P, -1, 0)))
        for k in range(13 if last else 4):
            if ends and last and k == 1:
                nothing = scan(second, space, np.zeros((0, len(space))), np.zeros((0, len(space), len(space))))
                give(made, replace(nothing, epoch=2))
            score = nees(made, second, targets.truth())
            if k and (last or (number >= 3 and not ends)):
                scores.append(score)
            targets.move(5.0)
            second += 5.0
    mine = np.mean(scores, axis=0)
    return float(mine.mean()), float(mine.std(ddof=1) / TARGETS**0.5)


@pytest.mark.parametrize(
    ("motion", "space"), [(OU, SPACE), (SINGER, SIX), (STILL, SPACE)], ids=["ou", "singer", "still"]
)
@pytest.mark.parametrize("ends", [False, True], ids=["gaps", "coasting"])
def test_errors_are_what_the_picture_says(motion: Motion, space: tuple[str, ...], ends: bool) -> None:
    """ends: the source starts anew, and the picture coasts with the motion of the centre, `motion`."""
    if ends and motion is SINGER:
        pytest.skip("a picture without acceleration coasts with what covers it: below")
    mean, error = mission(motion, motion, space, ends, {"motion": motion, "coast": 100.0})
    print(f"seed {SEED} {motion.kind}: NEES/n {mean:.3f} +- {error:.3f}")
    assert abs(mean - 1) < 4 * error
    assert error < 0.15


@pytest.mark.parametrize(("motion", "ends"), [(SINGER, False), (SINGER, True)], ids=["gaps", "coasting"])
def test_an_acceleration_that_nobody_has_is_covered(motion: Motion, ends: bool) -> None:
    """Tracker and picture in x y vx vy: never surer than they may be."""
    mean, error = mission(motion, motion, SPACE, ends, {"motion": motion, "coast": 100.0})
    print(f"seed {SEED} singer without acceleration: NEES/n {mean:.3f} +- {error:.3f}")
    assert 0.3 < mean < 1 + 4 * error


@pytest.mark.parametrize(("told", "honest"), [(Motion("cv", 1e-3), False), (Motion("ou", sigma=3.0, tau=25.0), True)])
def test_a_wrong_motion_is_seen(told: Motion, honest: bool) -> None:
    """What the other tests measure tells a motion that says too little from one that says too much."""
    mean, error = mission(OU, told, SPACE, settings={"motion": Motion("cv", 1.0)})
    print(f"seed {SEED} told {told}: NEES/n {mean:.3f} +- {error:.3f}")
    assert (mean < 1 - 4 * error) if honest else (mean > 1 + 4 * error)


@pytest.mark.parametrize("frame", [schemas.Ecef(), FRAME, schemas.Enu(57.0, -52.0)], ids=["ecef", "own", "far"])
def test_a_turning_aircraft_keeps_its_height_in_every_picture(frame: schemas.Frame) -> None:
    """250 m/s, 3 degrees a second, 10 km high, predicted over a whole turn less a quarter."""
    wanted = ("x", "y", "z", "vx", "vy", "vz")
    space, rate, seconds = (*wanted, "turn_rate"), np.radians(3.0), 90.0
    made = FusionCentre({"space": list(wanted), "frame": frame, "lateness": 1.0})
    mean = np.array([[0.0, 0.0, 10_000.0, 250.0, 0.0, 0.0, rate]])
    covariance = np.diag([30.0, 30.0, 30.0, 1.0, 1.0, 1.0, 1e-4])[None] ** 2
    message = scan(0, space, mean, covariance)
    give(made, info("r1", motion=Motion("ct", 0.1, 1e-8), period=60.0), message)
    picture = step(made, seconds).tracks
    here, _ = transform(picture.means, picture.covariances, wanted, frame, schemas.Ecef())
    start, _ = transform(mean[:, :6], covariance[:, :6, :6], wanted, FRAME, schemas.Ecef())
    height = float(ecef_to_geodetic(*here[0, :3])[2] - ecef_to_geodetic(*start[0, :3])[2])
    local, _ = transform(picture.means, picture.covariances, wanted, frame, FRAME)
    radius = 250.0 / rate
    print(f"{frame.kind}: {height:+.2f} m")
    assert abs(height) < (2 * radius) ** 2 / (2 * 6.37e6) + 1
    np.testing.assert_allclose(local[0, :2] - mean[0, :2], [-radius, radius], atol=10)
    assert picture.time - START == round(seconds * 1e9)
