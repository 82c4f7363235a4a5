"""Centres that take each other's pictures, in one process: who hears whom is a graph, and every target is a run.

Targets move by white-noise acceleration on a wide grid; every sensor follows each of them with a Kalman filter of the
right model, or (`Q` = 0) says a new, independent measurement of the whole state in every step. In every second each
centre is given the reports of its sensors and the pictures that the others made the second before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import schemas
from fusion_service.centre import FusionCentre
from tests.centre.worlds import FRAME, SECOND, SPACE, START, info

Floats = NDArray[np.float64]
F = np.block([[np.eye(2), np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])
NOISE = np.block([[np.eye(2) / 3, np.eye(2) / 2], [np.eye(2) / 2, np.eye(2)]])
H = np.hstack([np.eye(2), np.zeros((2, 2))])
TREE = {"A": (), "B": (), "top": ("A", "B")}
RING = {"A": ("C",), "B": ("A",), "C": ("B",)}
PAIR = {"A": ("B",), "B": ("A",)}
MESH = {"A": ("B", "C"), "B": ("A", "C"), "C": ("A", "B")}


@dataclass
class Sensor:
    """A Kalman filter per target: sigma (2,) of its measurements along the axes; alive: it still reports."""

    sigma: Floats
    mean: Floats
    covariance: Floats

    def follow(self, states: Floats, q: float, rng: np.random.Generator) -> None:
        count = len(states)
        if q == 0.0:
            spread = np.concatenate([self.sigma, self.sigma / 10])
            self.mean = states + rng.normal(size=states.shape) * spread
            self.covariance = np.tile(np.diag(spread**2), (count, 1, 1))
            return
        noise = np.diag(self.sigma**2)
        predicted = F @ self.covariance[0] @ F.T + q * NOISE
        gain = predicted @ H.T @ np.linalg.inv(H @ predicted @ H.T + noise)
        seen = states[:, :2] + rng.normal(size=(count, 2)) * self.sigma
        mean = self.mean @ F.T
        self.mean = mean + (seen - mean @ H.T) @ gain.T
        keep = np.eye(4) - gain @ H
        self.covariance = np.tile(keep @ predicted @ keep.T + gain @ noise @ gain.T, (count, 1, 1))


@dataclass
class Network:
    """Centres by name, each with sensors of its own, and whom each of them hears. told: pictures go with their lineage.
    alive (targets,): the sensors have a track of it; coasting: they go on listing those that they lost."""

    hears: Mapping[str, Sequence[str]]
    sigmas: Mapping[str, Sequence[tuple[float, float]]]
    targets: int = 60
    q: float = 1.0
    seed: int = 1
    exchange: bool = True
    told: bool = True
    config: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        side = int(np.ceil(np.sqrt(self.targets)))
        grid = 20_000.0 * np.stack(np.divmod(np.arange(self.targets), side), axis=1)
        self.states = np.concatenate([grid, self.rng.normal(0, 10, (self.targets, 2))], axis=1)
        self.second = 0
        self.coasting = False
        self.lost = START
        self.alive = np.ones(self.targets, dtype=np.bool_)
        self.centres: dict[str, FusionCentre] = {}
        self.sensors: dict[str, Sensor] = {}
        self.pictures: dict[str, schemas.GlobalTracks] = {}
        self.lengths: dict[str, list[int]] = {name: [] for name in self.hears}
        start = np.diag([100.0, 100.0, 25.0, 25.0])
        for name, others in self.hears.items():
            listened: dict[str, Any] = {f"global/{one}": {} for one in others} if self.exchange else {}
            given = {"name": name, "lateness": 3.0, "motion": schemas.Motion("cv", self.q), "sources": listened}
            self.centres[name] = FusionCentre({**given, **self.config})
            for k, sigma in enumerate(self.sigmas[name]):
                source = f"{name}{k}"
                noise = self.rng.multivariate_normal(np.zeros(4), start, self.targets)
                self.sensors[source] = Sensor(
                    np.array(sigma), self.states + noise, np.tile(start, (self.targets, 1, 1))
                )
                said = info(source, motion=schemas.Motion("cv", self.q))
                self.centres[name].handle(said, START)

    def step(self) -> dict[str, schemas.GlobalTracks]:
        """One second: the pictures of all centres."""
        self.second += 1
        noise = self.rng.multivariate_normal(np.zeros(4), self.q * NOISE, self.targets) if self.q else 0.0
        self.states = self.states @ F.T + noise
        now, made = START + self.second * SECOND, {}
        for sensor in self.sensors.values():
            sensor.follow(self.states, self.q, self.rng)
        for name, centre in self.centres.items():
            for k in range(len(self.sigmas[name])):
                centre.handle(self._report(f"{name}{k}", now), now)
            for other in self.hears[name] if self.exchange else ():
                if other in self.pictures:
                    centre.handle(self._picture(other), now)
            result = centre.step(now)
            made[name] = result.tracks
            self.lengths[name].append(len(result.tracks.ids))
            assert not result.status.refused, (name, result.status.refused)
        self.pictures = made
        return made

    def _picture(self, name: str) -> schemas.Message:
        picture = self.pictures[name]
        if not self.told:
            picture = replace(picture, lineage=None, track_lineage=None)
        return schemas.decode(schemas.encode(picture))

    def _report(self, source: str, now: int) -> schemas.LocalTracks:
        sensor, shown = self.sensors[source], self.alive | self.coasting
        updated = np.where(self.alive, now, self.lost)
        return schemas.LocalTracks(
            source=source,
            epoch=1,
            seq=self.second,
            sent=now,
            time=now,
            complete=True,
            space=SPACE,
            frame=FRAME,
            ids=np.flatnonzero(shown).astype(np.uint64) + np.uint64(1),
            means=sensor.mean[shown],
            covariances=sensor.covariance[shown],
            updated=updated[shown],
        )

    def errors(self, picture: schemas.GlobalTracks) -> tuple[Floats, Floats]:
        """Of the track nearest to each target: errors (T, 4) and what is stated (T, 4, 4). Fails where one has none."""
        gap = np.linalg.norm(picture.means[None, :, :2] - self.states[:, None, :2], axis=2)
        nearest = gap.argmin(axis=1)
        assert (gap.min(axis=1) < 2_000).all(), "a target without a track"
        return picture.means[nearest] - self.states, picture.covariances[nearest]


@dataclass
class Score:
    """rmse, m; nees over n; worst eigenvalue of true over stated error, and its standard error over the targets."""

    rmse: float
    nees: float
    worst: float
    error: float


def scores(network: Network, steps: int, skip: int = 30) -> dict[str, Score]:
    """Of every centre over `steps` steps, the first `skip` left out."""
    whitened: dict[str, list[Floats]] = {name: [] for name in network.centres}
    squares: dict[str, list[float]] = {name: [] for name in network.centres}
    for _ in range(steps):
        for name, picture in network.step().items():
            if network.second > skip:
                error, stated = network.errors(picture)
                white = np.linalg.solve(np.linalg.cholesky(stated), error[:, :, None])[:, :, 0]
                whitened[name].append(white)
                squares[name].append(float((error[:, :2] ** 2).sum(axis=1).mean()))
    found = {}
    for name, parts in whitened.items():
        white = np.stack(parts)  # (steps, targets, 4)
        each = np.einsum("sti,stj->tij", white, white) / len(white)
        values, vectors = np.linalg.eigh(each.mean(axis=0))
        along = np.einsum("i,tij,j->t", vectors[:, -1], each, vectors[:, -1])
        found[name] = Score(
            float(np.sqrt(np.mean(squares[name]))),
            float((white**2).sum(axis=2).mean() / 4),
            float(values[-1]),
            float(along.std() / np.sqrt(len(along))),
        )
    return found
