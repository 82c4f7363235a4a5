"""What centres make of the tracks of targets far apart: `trackers` publish, real `FusionCentre`s hear, all scores.

Of every estimate the errors e and what it says of them, P, are kept for each target, over the steps that count: root
of the mean of e'e in position (RMSE), mean of e' P^-1 e / n (NEES over its dimension), and the worst eigenvalue: the
largest of the mean of e e' relative to the mean of P (`consistency.excess`). Targets are independent of one another,
and so the unit of the standard errors; the errors of one are correlated over time. A sensor alone is scored as it is
heard: the last of its tracks that has arrived, predicted with the motion it declares.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import schemas
from fusion_service import linalg
from fusion_service.centre import FusionCentre
from fusion_service.motion import predict
from sensor_clients.filters import STATE
from sensor_clients.filters.mixture import moments
from studies.consistency import excess
from studies.statistics import Estimate, jackknife
from studies.study import Floats, Run
from studies.trackers import Bank, Central, World, nanoseconds, targets, times

__all__ = ["CENTRALISED", "CHUNK", "Flight", "Scores", "Task", "Way", "best_of", "flown", "told"]

FRAME = schemas.Enu(59.0, 10.0)
CHUNK = 400
"""Targets of one centre."""
GROUPS = 50
CENTRALISED = "centralised"
SETTINGS = {"frame": {"kind": "enu", "lat": 59.0, "lon": 10.0}, "coast": 1e4, "stale_periods": 1e4, "publish": "mean"}
Way = tuple[str, Mapping[str, Any]]
"""A label, and the settings of a centre."""


class Scores(NamedTuple):
    """Means over the steps for each target: errors (4, 4, M) e e', what is said of them (4, 4, M), NEES / 4 (M,)."""

    squared: Floats
    said: Floats
    nees: Floats

    def rmse(self) -> Estimate:
        """Of position, m."""
        return jackknife(lambda some: float(np.sqrt(some.mean())), self.squared[0, 0] + self.squared[1, 1], GROUPS)

    def mean_nees(self) -> Estimate:
        """NEES over its dimension."""
        return jackknife(lambda some: float(some.mean()), self.nees, GROUPS)

    def worst(self) -> Estimate:
        """The largest eigenvalue of the mean squared error relative to the mean covariance."""
        return jackknife(excess, np.stack([self.squared, self.said]), GROUPS)

    @classmethod
    def join(cls, parts: Sequence[Scores]) -> Scores:
        """Of all targets."""
        return cls(*(np.concatenate(column, axis=-1) for column in zip(*parts, strict=True)))


@dataclass(slots=True)
class _Sum:
    """Scores being summed."""

    squared: Floats = field(default_factory=lambda: np.zeros((4, 4, 1)))
    said: Floats = field(default_factory=lambda: np.zeros((4, 4, 1)))
    nees: Floats = field(default_factory=lambda: np.zeros(1))
    steps: int = 0

    def add(self, mean: Floats, covariance: Floats, truth: Floats) -> None:
        error = mean - truth
        self.squared = self.squared + linalg.outer(error, error)
        self.said = self.said + covariance
        self.nees = self.nees + linalg.quadratic(covariance, error) / len(error)
        self.steps += 1

    def scores(self) -> Scores:
        return Scores(self.squared / self.steps, self.said / self.steps, self.nees / self.steps)


class Flight(NamedTuple):
    """scores: of "centralised", of every sensor ("sensor 1"), and of every way by its label; watch: of every way the
    mean over its centres of what their status says at the end of each source, {label: {source: {what: value}}};
    failing: sources that a centre takes no tracklets of, with the reason, as often as they are."""

    scores: dict[str, Scores]
    watch: dict[str, dict[str, dict[str, float]]]
    failing: dict[str, dict[str, float]]


class Task(NamedTuple):
    """A world, the ways in which it is fused, a key of its random numbers (of one key: the same targets and
    measurements), and of how many targets at most. fed: sensors whose trackers go on, after each step, from the fused
    result of the way (of which there is one then); feedback: whether they say so."""

    world: World
    ways: tuple[Way, ...]
    key: int
    most: int | None = None
    fed: tuple[int, ...] = ()
    feedback: bool = False


def flown(run: Run, tasks: Mapping[str, Task]) -> dict[str, Flight]:
    """All tasks with `run.runs` targets each, or as many as they want, `CHUNK` in a centre at most."""
    items = []
    for name, task in tasks.items():
        targets = min(run.runs, task.most or run.runs)
        items += [(name, first // CHUNK, min(CHUNK, targets - first)) for first in range(0, targets, CHUNK)]
    answers = run.map(partial(_fly, tasks=dict(tasks), seed=run.seed), items, "centres")
    parts: dict[str, list[Flight]] = {name: [] for name in tasks}
    for (name, _, _), answer in zip(items, answers, strict=True):
        parts[name].append(answer)
    return {name: _joined(some) for name, some in parts.items()}


def _joined(parts: Sequence[Flight]) -> Flight:
    scores = {label: Scores.join([part.scores[label] for part in parts]) for label in parts[0].scores}
    watch: dict[str, dict[str, dict[str, float]]] = {}
    failing: dict[str, dict[str, float]] = {}
    for label, sources in parts[0].watch.items():
        watch[label] = {
            source: {what: float(np.mean([part.watch[label][source][what] for part in parts])) for what in said}
            for source, said in sources.items()
        }
        failing[label] = {}
        for part in parts:
            for why, share in part.failing[label].items():
                failing[label][why] = failing[label].get(why, 0.0) + share / len(parts)
    return Flight(scores, watch, failing)


def best_of(flight: Flight) -> Scores:
    """For each target those of the sensor that states the least variance of position, in the mean."""
    alone = [scores for label, scores in flight.scores.items() if label.startswith("sensor ")]
    best = np.argmin([one.said[0, 0] + one.said[1, 1] for one in alone], axis=0)
    target = np.arange(len(best))
    return Scores(*(np.stack(column)[best, ..., target].T for column in zip(*alone, strict=True)))


def told(label: str, flight: Flight) -> tuple[Scores, float, float]:
    """Scores of a way; the least share of tracklets of any source, in %; and the normalised innovations of the source
    where they are furthest from 1. NaN where there are none."""
    watch = flight.watch[label].values()
    shares = [said["tracklets"] for said in watch]
    ratios = [said["innovation"] for said in watch if np.isfinite(said["innovation"])]
    worst = max(ratios, key=lambda ratio: abs(np.log(max(ratio, 1e-9))), default=float("nan"))
    return flight.scores[label], 100.0 * min(shares, default=float("nan")), worst


@dataclass(slots=True)
class Heard:
    """What has arrived last of each track of a sensor: time (B,) ns, mean (4, B), covariance (4, 4, B)."""

    time: NDArray[np.int64]
    mean: Floats
    covariance: Floats

    @classmethod
    def none(cls, size: int) -> Heard:
        """Nothing yet."""
        return cls(np.zeros(size, dtype=np.int64), np.zeros((4, size)), np.tile(np.eye(4)[..., None], size))

    def take(self, message: schemas.LocalTracks) -> None:
        """The tracks of a message; messages of one sensor come in the order of time."""
        at = message.ids.astype(np.intp) - 1
        mean, covariance = message.means.T, np.moveaxis(message.covariances, 0, -1)
        if message.weights is not None:
            C = len(message.weights) // len(at)
            parts = mean.reshape(4, -1, C).swapaxes(1, 2), covariance.reshape(4, 4, -1, C).swapaxes(2, 3)
            mean, covariance = moments(message.weights.reshape(-1, C).T, *parts)
        self.time[at], self.mean[:, at], self.covariance[:, :, at] = message.time, mean, covariance

    def at(self, time: int, motion: schemas.Motion) -> tuple[Floats, Floats]:
        """Predicted to a time, ns."""
        return predict(motion, STATE, self.mean, self.covariance, (time - self.time) / 1e9)


class _Mission:
    """Trackers, and centres that hear them, side by side."""

    def __init__(self, task: Task, size: int, rng: np.random.Generator) -> None:
        self.task, self.size, self.rng = task, size, rng
        world = task.world
        self.trackers = [Bank(world) for _ in world.sensors]
        self.heard = [Heard.none(size) for _ in world.sensors]
        self.central = Central(world)
        self.centres = {
            label: FusionCentre({**SETTINGS, "period": world.period, **config}) for label, config in task.ways
        }
        self.under_way: list[tuple[int, int, int, schemas.LocalTracks]] = []
        self.number = [count(1) for _ in world.sensors]
        self.sums = {name: _Sum() for name in (CENTRALISED, *map(_name, range(len(world.sensors))), *self.centres)}
        for i, sensor in enumerate(world.sensors):
            info = schemas.SensorInfo(
                source=_name(i).replace(" ", "-"), epoch=1, seq=0, sent=0, frame=FRAME, position=(*sensor.origin, 0.0),
                period=sensor.period, motion=world.said, feedback=True if task.feedback and i in task.fed else None,
            )  # fmt: skip
            for centre in self.centres.values():
                centre.handle(info, 0)

    def measure(self, time: int, i: int, truth: Floats, noise: np.random.Generator) -> None:
        """Sensor i sees all targets, and sends the tracks that are not lost."""
        sensor = self.task.world.sensors[i]
        place = truth[:2] - np.array(sensor.origin)[:, None]
        R = sensor.model.noise(place)
        L, d = linalg.ldl(R)
        z = sensor.model.observe(place) + linalg.matvec(L, np.sqrt(d) * noise.standard_normal((2, self.size)))
        self.trackers[i].update(time, sensor, z)
        self.central.add(time, sensor, z)
        sent = noise.random(self.size) >= sensor.loss
        message = self.said(time, i, sent)
        heapq.heappush(self.under_way, (time + nanoseconds(sensor.late), i, message.seq, message))

    def said(self, time: int, i: int, sent: np.ndarray[Any, np.dtype[np.bool_]]) -> schemas.LocalTracks:
        """What tracker i says."""
        tracker = self.trackers[i]
        more: dict[str, Any] = {}
        mean, covariance = (part[..., sent] for part in tracker.at(time))
        if self.task.world.mixtures:
            C, T = len(tracker.weights), int(sent.sum())
            more = {"counts": np.full(T, C, dtype=np.uint16), "weights": tracker.weights[:, sent].T.ravel()}
            mean, covariance = (part[..., sent] for part in (tracker.parts, tracker.spreads))
            mean, covariance = mean.swapaxes(1, 2).reshape(4, -1), covariance.swapaxes(2, 3).reshape(4, 4, -1)
        return schemas.LocalTracks(
            source=_name(i).replace(" ", "-"), epoch=1, seq=next(self.number[i]), sent=time, time=time, complete=False,
            space=("x", "y", "vx", "vy"), frame=FRAME, ids=np.flatnonzero(sent).astype(np.uint64) + 1,
            means=np.ascontiguousarray(mean.T), covariances=np.moveaxis(covariance, -1, 0).copy(), **more,
        )  # fmt: skip

    def step(self, time: int, truth: Floats, counts: bool) -> None:
        """Every centre makes its step."""
        arrived = []
        while self.under_way and self.under_way[0][0] <= time:
            _, i, _, message = heapq.heappop(self.under_way)
            arrived.append(message)
            self.heard[i].take(message)
        found = {}
        for label, centre in self.centres.items():
            for message in arrived:
                centre.handle(message, time)
            found[label] = picked(centre.step(time).tracks, truth)
        if counts:
            found[CENTRALISED] = self.central.at(time)
            found |= {_name(i): one.at(time, self.task.world.said) for i, one in enumerate(self.heard)}
            for label, (mean, covariance) in found.items():
                self.sums[label].add(mean, covariance, truth)
        for i in self.task.fed:
            self.trackers[i].goes_on(time, *found[next(iter(self.centres))])

    def watched(self, time: int) -> tuple[dict[str, dict[str, dict[str, float]]], dict[str, dict[str, float]]]:
        """`Flight.watch` and `failing`, after one more step."""
        watch: dict[str, dict[str, dict[str, float]]] = {}
        failing: dict[str, dict[str, float]] = {}
        for label, centre in self.centres.items():
            sources = centre.step(time).status.sources
            watch[label] = {
                source: {what: float(said.get(what, np.nan)) for what in ("tracklets", "innovation", "innovation_high")}
                for source, said in sources.items()
            }
            failing[label] = {
                f"{source}: {said['no_tracklets']}": 1.0 for source, said in sources.items() if said.get("no_tracklets")
            }
        return watch, failing


def _fly(item: tuple[str, int, int], tasks: Mapping[str, Task], seed: int) -> Flight:
    name, number, size = item
    task = tasks[name]
    world = task.world
    rngs = [np.random.default_rng([seed, task.key, number, k]) for k in range(len(world.sensors) + 1)]
    mission = _Mission(task, size, rngs[0])
    last = 0
    for (time, sensors), truth in zip(times(world).items(), targets(world, size, rngs[0]), strict=True):
        for i in sensors:
            mission.measure(time, i, truth, rngs[1 + i])
        if time % nanoseconds(world.period) == 0:
            mission.step(time, truth, time > nanoseconds(world.warm * world.period))
        last = time
    watch, failing = mission.watched(last + nanoseconds(world.period))
    return Flight({label: one.scores() for label, one in mission.sums.items()}, watch, failing)


def picked(picture: schemas.GlobalTracks, truth: Floats) -> tuple[Floats, Floats]:
    """Mean (4, B) and covariance (4, 4, B) of the global track nearest to each target."""
    away = picture.means[:, :2, None] - truth[None, :2]
    nearest = np.argmin(away[:, 0] ** 2 + away[:, 1] ** 2, axis=0)
    return picture.means[nearest].T.copy(), np.moveaxis(picture.covariances[nearest], 0, -1).copy()


def _name(i: int) -> str:
    return f"sensor {i + 1}"
