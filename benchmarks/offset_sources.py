"""Worlds for registration: targets on all courses, and sources with errors of clock and place put in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import schemas
from fusion_service.centre import FusionCentre, StepResult

__all__ = ["FRAME", "SPACE", "Offset", "World"]

Floats = NDArray[np.float64]
SPACE = ("x", "y", "vx", "vy")
FRAME = schemas.Enu(59.0, 10.0)
SECOND = 10**9
START = 1_780_000_000 * SECOND


@dataclass(frozen=True)
class Offset:
    """A source: where it stands, m; its errors (s, m, m, rad, m, 1; as `bias` has them); sigma of places and
    velocities; lasting: correlation of successive errors of a track; tracker: its tracks are those of Kalman filters,
    of detections each second with the sigma of places; drift of its clock, s/s; claims: what it
    says of its sigmas, as a share of them; way: how fast it moves itself, m/s, and then says where it is."""

    place: tuple[float, float] = (0.0, 0.0)
    clock: float = 0.0
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    range: float = 0.0
    scale: float = 0.0
    sigma: tuple[float, float] = (20.0, 2.0)
    lasting: float = 0.0
    drift: float = 0.0
    polar: bool = False
    tracker: bool = False
    claims: float = 1.0
    way: tuple[float, float] | None = None

    def at(self, second: float) -> Floats:
        """Where it is (2,), m."""
        return np.array(self.place) + second * np.array(self.way or (0.0, 0.0))

    def says(self, states: Floats, second: float = 0.0) -> Floats:
        """What it says of true states (T, 4), written down anew from the geometry: polar coordinates about it."""
        at = self.at(second)
        d = states[:, :2] - at
        r, a = np.hypot(*d.T), np.arctan2(d[:, 1], d[:, 0])
        r, a = r * (1 + self.scale) + self.range, a + self.heading
        place = at + np.stack([r * np.cos(a), r * np.sin(a)], axis=1) + [self.x, self.y]
        speed, course = np.hypot(*states[:, 2:].T), np.arctan2(states[:, 3], states[:, 2]) + self.heading
        return np.concatenate([place, np.stack([speed * np.cos(course), speed * np.sin(course)], axis=1)], axis=1)


class World:
    """Targets at constant velocity, and a centre that hears sources of them once a second."""

    def __init__(
        self, offsets: Mapping[str, Offset], count: int = 25, speed: float = 200.0, seed: int = 1, *,
        spread: float = 30_000.0, courses: Sequence[float] | None = None,
        seen: Mapping[str, Sequence[int]] | None = None, varied: float = 0.2,
        **config: Any,
    ) -> None:  # fmt: skip
        self.rng, self.sources = np.random.default_rng(seed), dict(offsets)
        course = self.rng.uniform(0, 2 * np.pi, count) if courses is None else np.resize(courses, count)
        speeds = speed * self.rng.uniform(1 - varied, 1 + varied, count)
        self.begin = np.concatenate(
            [
                self.rng.uniform(-spread, spread, (count, 2)),
                (speeds * np.stack([np.cos(course), np.sin(course)])).T,
            ],
            axis=1,
        )
        self.seen = {name: list(range(count)) for name in offsets} | {k: list(v) for k, v in (seen or {}).items()}
        self.errors = {name: self._error(one) for name, one in self.sources.items()}
        frame = {"kind": "enu", "lat": FRAME.lat, "lon": FRAME.lon}
        self.config = {"frame": frame, "lateness": 3.0, **config}
        self.centre = FusionCentre(self.config)
        self.tracks: dict[str, tuple[Floats, Floats]] = {}
        self.second, self.epoch = 0, dict.fromkeys(offsets, 1)
        for name in self.sources:
            self.inform(name)

    def _error(self, one: Offset) -> Floats:
        return np.asarray(self.rng.normal(size=self.begin.shape) * np.repeat(one.sigma, 2))

    def inform(self, name: str) -> None:
        """The source says what it is."""
        one = self.sources[name]
        more: dict[str, Any] = (
            {"polar": True} if one.polar and "polar" in schemas.SensorInfo.__dataclass_fields__ else {}
        )
        said = schemas.SensorInfo(
            source=name, epoch=self.epoch[name], seq=0, sent=START, frame=FRAME, position=(*one.place, 0.0),
            period=1.0, motion=schemas.Motion("cv", 1.0), **more,
        )  # fmt: skip
        self.centre.handle(said, START + self.second * SECOND)

    def truth(self, second: float) -> Floats:
        """States (T, 4)."""
        out = self.begin.copy()
        out[:, :2] += second * out[:, 2:]
        return out

    def step(self) -> StepResult:
        """A second goes by."""
        self.second += 1
        for name, one in self.sources.items():
            a = one.lasting
            self.errors[name] = a * self.errors[name] + np.sqrt(1 - a * a) * self._error(one)
            clock = one.clock + one.drift * self.second
            says = one.says(self.truth(self.second - clock), self.second) + self.errors[name]
            spread = np.diag(np.repeat(one.sigma, 2) ** 2) * one.claims**2
            if one.tracker:
                says, spread = self._tracked(name, says)
            some = self.seen[name]
            message = schemas.LocalTracks(
                source=name, epoch=self.epoch[name], seq=self.second, sent=START, time=START + self.second * SECOND,
                complete=True, space=SPACE, frame=FRAME, ids=np.array(some, dtype=np.uint64) + np.uint64(1),
                means=says[some], covariances=np.tile(spread, (len(some), 1, 1)),
                platform=None if one.way is None else schemas.Platform((*one.at(self.second).tolist(), 0.0)),
            )  # fmt: skip
            self.centre.handle(message, START + self.second * SECOND + SECOND // 10)
        return self.centre.step(START + self.second * SECOND)

    def _tracked(self, name: str, detected: Floats) -> tuple[Floats, Floats]:
        """States (T, 4) and the covariance of each, after detections with what `detected` says of places."""
        x, P = self.tracks.get(name, (detected, np.diag(np.repeat(self.sources[name].sigma, 2) ** 2)))
        F, q = np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(2)), np.kron([[1 / 3, 1 / 2], [1 / 2, 1.0]], np.eye(2))
        if name in self.tracks:
            H, R = np.eye(4)[:2], np.eye(2) * self.sources[name].sigma[0] ** 2
            x, P = x @ F.T, F @ P @ F.T + q
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            x, P = x + (detected[:, :2] - x @ H.T) @ K.T, (np.eye(4) - K @ H) @ P
        self.tracks[name] = x, (P + P.T) / 2
        return self.tracks[name]

    def run(self, seconds: int) -> StepResult:
        """Several."""
        for _ in range(seconds):
            result = self.step()
        return result
