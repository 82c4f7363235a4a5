"""Missions from a seed of sources that are wrong about themselves, in every way that supervision, registration and
conduct look at: late and turned, too sure, frozen, moving, doubled, dropped. Flown and made again as `random_missions`
are."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

import schemas
from fusion_service.centre import ClockSet, Event, FusionCentre, Order
from fusion_service.config import CentreConfig, centre_config
from fusion_service.geodesy import FrameError, transform
from tests.centre.worlds import FRAME, SECOND, START
from tests.helpers.random_missions import GENERATION, Given, Mission, _on_bus, _orders, _presence

Floats = NDArray[np.float64]
LONG = ("x", "y", "z", "vx", "vy", "vz")
SPACES = (("x", "y"), ("x", "y", "vx", "vy"), LONG)
ELSEWHERE = (schemas.Enu(59.02, -55.03, 5.0), schemas.Enu(58.5, -54.0), schemas.Ecef(), schemas.Local("yard"))
STATES = ("trusted", "watch", "inflated", "union", "out", "auto")
NAMES = ("a", "b", "c", "d", "e", "f")


def settings(rng: np.random.Generator) -> CentreConfig:
    """Settings of a centre that looks at its sources, in any of the ways there are."""

    def one(*of: Any) -> Any:
        return of[int(rng.integers(len(of)))]

    frame: Any = one(None, FRAME, FRAME, FRAME, ELSEWHERE[0], ELSEWHERE[2])
    space = LONG if isinstance(frame, schemas.Ecef) else one(SPACES[1], SPACES[1], *SPACES)
    rule = one("auto", "auto", "auto", "ci", "naive", "aa", "ici", "ei", "cu", "hmd-ga", "fast-ci", "bci", "ffcc")
    memory = one("auto", "restart", "recursive", "tracklet")
    table: dict[str, Any] = {
        "space": list(space),
        "lateness": one(0.0, 2.0, 5.0),
        "coast": one(0.0, 5.0),
        "period": one(0.5, 1.0),
        "rule": rule,
        "memory": "restart" if (rule, memory) == ("auto", "recursive") else memory,
        "mixture_rule": one("moments", "gm-ga", "aa"),
        "supervision": one("off", "watch", "act", "act", "act"),
        "supervision_errors": one(0.001, 1.0),
        "registration": one("off", "estimate", "correct", "correct", "correct"),
        "registration_memory": one(1.0, 60.0, 600.0),
        "clock_sigma": one(0.0, 1.0, 1.0, 1000.0),
        "translation_sigma": one(0.0, 100.0, 100.0, 1e6),
        "heading_sigma": one(0.0, 1.0, 90.0),
        "range_sigma": one(0.0, 100.0, 1e6),
        "scale_sigma": one(0.0, 0.001, 1.0),
        "manoeuvre": one(0.0, 20.0),
        "min_sources": one(1, 1, 2),
        "fuse_origins": one(False, True),
        "remember": one(0.0, 600.0),
        "source_defaults": {"period": one(1.0, 3.0), "polar": one(False, True), "registration_sigma": one(0.0, 15.0)},
        "sources": {
            "a": {"reference": one(False, True), "identity_trust": one(0.99, 0.6)},
            "b": {"reference": one(False, False, True), "override": one(False, True), "polar": True},
            "c": {"inflation": one(1.0, 4.0), "may_start": one(True, False)},
        },
    }  # fmt: skip
    made = centre_config(table)
    return dataclasses.replace(made, frame=frame)


class _Wrong:
    """A source, and what is wrong with it."""

    def __init__(self, name: str, rng: np.random.Generator, sound: bool) -> None:
        def one(*of: Any) -> Any:
            return of[int(rng.integers(len(of)))]

        self.name, self.rng, self.epoch, self.seq, self.base = name, rng, 1, 0, 1
        self.clock = one(0.0, 0.0, 0.5, -0.5, 3.0, -2.0)
        self.shift = np.array([one(0.0, 0.0, 50.0, 1000.0), one(0.0, 0.0, -50.0)])
        self.heading = one(0.0, 0.0, 0.02, 1.0)
        self.range, self.scale = one(0.0, 0.0, 100.0), one(0.0, 0.0, 0.01)
        self.factor = one(1.0, 1.0, 1 / 3, 0.1, 1e-3, 10.0)
        self.frozen = one(1e9, 1e9, 1e9, float(rng.integers(3, 12)))
        self.freezes = one("bits", "updated", "all")
        self.jumps = rng.random() < 0.15
        self.extent = one("", "", "box", "ellipse", "some", "sizes")
        self.reference = one(None, None, "centre", "antenna", "nearest", "blob")
        self.platform = one("", "", "still", "moving", "turning", "absurd")
        self.said = rng.random() < 0.7
        self.polar, self.covers = one(None, False, True), rng.random() < 0.5
        self.identity = one("", "", "own", "copy", "twice")
        self.late = one(0.0, 0.0, 0.5, 3.0)
        self.space = one(SPACES[0], SPACES[1], SPACES[1], LONG)
        self.frame = FRAME if rng.random() < 0.7 else one(*ELSEWHERE)
        if isinstance(self.frame, schemas.Ecef):
            self.space = LONG
        self.mixed, self.complete = rng.random() < 0.1, rng.random() < 0.7
        self.every = one(1, 1, 1, 2, 4)
        self.silent = one((0, 0), (0, 0), (8, 20), (10, 14))
        self.churns = rng.random() < 0.15
        self.restarts, self.origin = rng.random() < 0.1, one("live", "live", "live", "live", "simulated")
        self.sigma = one(5.0, 20.0, 60.0)
        self.kept: Floats | None = None
        if sound:
            self.clock, self.shift, self.heading, self.range, self.scale = 0.0, np.zeros(2), 0.0, 0.0, 0.0
            self.factor, self.frozen, self.jumps, self.identity = 1.0, 1e9, False, "own"
            self.late = 0.0

    def info(self) -> schemas.SensorInfo:
        rng = self.rng
        self.seq += 1
        more: dict[str, Any] = {"polar": self.polar}
        if self.covers:
            more |= {"coverage": schemas.Disk(30e3), "detection_probability": float(rng.choice([0.5, 0.9, 1.0]))}
        if rng.random() < 0.3:
            more["position_covariance"] = np.diag(rng.choice([0.0, 25.0, 1e4], size=3))
        if rng.random() < 0.3:
            more["heading_sigma"] = float(rng.choice([0.0, 0.01, 3.0]))
        place = (0.0, 0.0, 0.0) if isinstance(self.frame, schemas.Ecef) else (500.0, -300.0, 10.0)
        return schemas.SensorInfo(
            source=self.name, epoch=self.epoch, seq=self.seq, sent=START, frame=self.frame, position=place,
            period=float(self.every), motion=schemas.Motion("cv", 1.0), **more,
        )  # fmt: skip

    def where(self, second: float) -> Floats:
        if self.platform in ("moving", "turning"):
            angle = 0.1 * second if self.platform == "turning" else 0.0
            return np.array([200.0 * np.sin(angle) + 10 * second, 200.0 * np.cos(angle), 10.0])
        return np.array([500.0, -300.0, 10.0])

    def stands(self, second: float) -> schemas.Platform | None:
        rng = self.rng
        if not self.platform or rng.random() < 0.05:
            return None
        place = self.where(second)
        if self.platform == "absurd":
            place = place * rng.choice([1.0, 1e3, -1e5, 1e6])
        if not isinstance(self.frame, schemas.Local) and self.frame != FRAME:
            moved, _ = transform(place[None], np.zeros((1, 3, 3)), ("x", "y", "z"), FRAME, self.frame)
            place = moved[0]
        covariance = None if rng.random() < 0.5 else np.diag(rng.choice([0.0, 25.0, 1e4], size=3))
        sigma = None if rng.random() < 0.5 else float(rng.choice([0.0, 0.01, 3.0]))
        heading = None if rng.random() < 0.5 else float(rng.uniform(-6, 6))
        return schemas.Platform((float(place[0]), float(place[1]), float(place[2])), covariance, heading, sigma)

    def seen(self, states: Floats, second: float) -> tuple[Floats, Floats]:
        """What it makes (T, 6) of the true states (T, 4), with its errors, and how sure (6, 6) it is of it."""
        rng, site = self.rng, self.where(second)[:2]
        away = states[:, :2] - site
        far = np.hypot(away[:, 0], away[:, 1])[:, None] + 1e-9
        c, s = np.cos(self.heading), np.sin(self.heading)
        turn = np.array([[c, -s], [s, c]])
        place = site + self.shift + (away * (1 + self.scale + self.range / far)) @ turn.T
        if self.jumps and rng.random() < 0.1:
            place = place + 5e4
        out = np.zeros((len(states), 6))
        out[:, [0, 1, 3, 4]] = np.concatenate([place, states[:, 2:] @ turn.T], axis=1)
        sigma = np.array([self.sigma, self.sigma, 10.0, 2.0, 2.0, 1.0])
        out += rng.normal(size=out.shape) * sigma
        return out, np.diag((self.factor * sigma) ** 2)

    def message(self, states: Floats, second: float) -> schemas.LocalTracks | None:
        """The message stamped `second` of targets that are at `states` (T, 4) then by its own clock."""
        rng = self.rng
        some = np.flatnonzero(rng.random(len(states)) < 0.9)
        if rng.random() < 0.05:
            some = some[:0]
        mean, covariance = self.seen(states, second)
        if second >= self.frozen and self.kept is not None and self.freezes != "updated":
            mean = self.kept
            some = np.arange(len(states)) if self.freezes == "all" else some
        self.kept = mean
        mean, covariances = mean[some], np.tile(covariance, (len(some), 1, 1))
        if self.frame != FRAME and not isinstance(self.frame, schemas.Local):
            try:
                mean, covariances = transform(mean, covariances, LONG, FRAME, self.frame)
            except FrameError:
                return None
        at = [LONG.index(name) for name in self.space]
        mean, covariances = mean[:, at], covariances[:, at][:, :, at]
        ids = some.astype(np.uint64) + np.uint64(1)
        if self.churns:
            ids = ids + np.uint64(1000 * round(abs(second)))
        made = self.more(some, second)
        if self.mixed:
            made |= {"counts": np.full(len(ids), 2, dtype=np.uint16), "weights": np.full(2 * len(ids), 0.5)}
            mean, covariances = np.repeat(mean, 2, axis=0), np.repeat(covariances, 2, axis=0)
            mean[::2, 0] += self.sigma
        self.seq += 1
        return schemas.LocalTracks(
            source=self.name, epoch=self.epoch, seq=self.seq, sent=START, time=START + round(second * SECOND),
            complete=self.complete, space=self.space, frame=self.frame, ids=ids, means=mean, origin=self.origin,
            covariances=covariances, platform=self.stands(second), **made,
        )  # fmt: skip

    def more(self, some: NDArray[np.intp], second: float) -> dict[str, Any]:
        """Columns beside the densities of the targets numbered `some` (T,)."""
        rng, n = self.rng, len(some)
        made: dict[str, Any] = {"reference": self.reference}
        if self.extent:
            extent = np.array([36.0, 9.6, 0.5]) * rng.uniform(0.5, 1.5, (n, 1))
            sigma = np.tile([2.0, 1.0, 0.1], (n, 1)) * rng.choice([1.0, 0.0, 100.0], (n, 1))
            if self.extent == "some":
                extent[rng.random(n) < 0.5] = np.nan
            if self.extent == "sizes":
                extent[rng.random((n, 3)) < 0.3] = np.nan
                sigma[rng.random((n, 3)) < 0.3] = np.nan
            made["extent"] = extent
            made["shape"] = self.extent if self.extent in schemas.SHAPES else None
            if rng.random() < 0.7:
                made["extent_sigma"] = sigma
        if self.reference and rng.random() < 0.5:
            covariance = np.tile(np.diag(rng.choice([0.0, 25.0, 1e4], size=2)), (n, 1, 1))
            covariance[rng.random(n) < 0.2] = np.nan
            made["reference_covariances"] = covariance
        words = {"own": [f"mmsi:{k}" for k in some], "copy": [f"icao:{k}" for k in some], "twice": ["mmsi:7"] * n}
        if self.identity:
            made["identity"] = tuple(None if rng.random() < 0.2 else word for word in words[self.identity])
        if rng.random() < 0.1 or (second >= self.frozen and self.freezes == "updated"):
            made["updated"] = np.full(n, START + round(min(second - 1, self.frozen) * SECOND))
        return made


def _supervising(rng: np.random.Generator, now: int) -> list[Order]:
    if rng.random() > 0.08:
        return []
    source, state = NAMES[int(rng.integers(len(NAMES)))], STATES[int(rng.integers(len(STATES)))]
    return [Order("supervise", source=source, state=state, until=None if rng.random() < 0.5 else now + 4 * SECOND)]


def _truth(rng: np.random.Generator) -> Floats:
    count = int(rng.choice([0, 1, 2, 5, 8, 12]))
    spread = float(rng.choice([100.0, 3000.0, 20_000.0]))
    states = np.concatenate([rng.uniform(-spread, spread, (count, 2)), rng.normal(0, 40, (count, 2))], axis=1)
    how = int(rng.integers(5))
    if how == 0:
        states[:, 2:] = 0.0
    elif how == 1:
        states[:, 2:] = [60.0, 10.0]
    elif how == 2:
        states[:, :2] = np.arange(count)[:, None] * [400.0, 0.0]
        states[:, 2:] = [20.0, 0.0]
    return states


@cache
def fly(seed: int, steps: int = 30, sound: bool = False, **changes: Any) -> Mission:
    """The mission of a seed; sound: of sources with nothing wrong; changes: of its settings."""
    rng = np.random.default_rng([seed, 13])
    config = dataclasses.replace(settings(rng), **changes)
    centre = FusionCentre(config, generation=GENERATION, epoch=START)
    sources = [_Wrong(name, rng, sound) for name in NAMES[: int(rng.integers(1, 7))]]
    states = _truth(rng)
    mission = Mission(config, [], [])
    waiting: list[tuple[float, schemas.Message]] = []
    clock = 0.0
    strays = rng.random() < 0.4
    for number in range(1, steps + 1):
        clock += config.period
        events: list[tuple[Event, int]] = []
        if number == steps // 2 and rng.random() < 0.2:
            back = float(rng.choice([2.0, 100.0, 7200.0]))
            clock -= back if back > 50 else 0.0
            now = START + round(clock * SECOND)
            events.append((ClockSet(now - round(back * SECOND) * (back < 50)), now))
        now = START + round(clock * SECOND)
        events += [(order, now) for order in _supervising(rng, now)]
        if strays:
            events += [(order, now) for order in _orders(rng, mission.results, sources, now)]  # type: ignore[arg-type]
            events += [(event, now) for event in _presence(rng, sources)]  # type: ignore[arg-type]
        for source in sources:
            for message in _sent(source, states, clock, number):
                waiting.append((number + source.late * (rng.random() < 0.8), message))
        due = [message for at, message in waiting if at <= number]
        waiting = [item for item in waiting if item[0] > number]
        events += [(_on_bus(message), now) for message in due]
        for event, received in events:
            centre.handle(event, received)
        time = max(now, centre.time + 1)
        mission.given.append(Given(time, events))
        mission.results.append(centre.step(time))
    return mission


def _sent(source: _Wrong, states: Floats, clock: float, number: int) -> list[schemas.Message]:
    rng = source.rng
    out: list[schemas.Message] = []
    if source.restarts and rng.random() < 0.1:
        source.epoch, source.seq = source.epoch + 1, 0
    if source.said and (number == 1 or rng.random() < 0.1):
        out.append(source.info())
    if number % source.every or source.silent[0] < number <= source.silent[1]:
        return out
    there = states.copy()
    there[:, :2] += (clock - source.clock) * there[:, 2:]
    message = source.message(there, clock)
    return out if message is None else [*out, message]
