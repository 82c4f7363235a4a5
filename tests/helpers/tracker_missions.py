"""Missions of real trackers from a seed: with all that a source may declare or do that decides whether its tracks
are taken as tracklets, and whether their correlation is derived. Flown and made again as `random_missions` are."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

import schemas
from fusion_service.centre import ClockSet, Event, FusionCentre
from fusion_service.config import CentreConfig, centre_config
from tests.centre.worlds import FRAME, SECOND, SPACE, START, truth
from tests.helpers.random_missions import GENERATION, Given, Mission, _on_bus, _orders, _presence

Floats = NDArray[np.float64]
SOURCES = ("a", "b", "c", "d", "e")
SPACES = (
    ("x", "y"), ("x", "vx", "y", "vy"), ("x", "y", "vx", "vy", "ax", "ay"), ("x", "y", "z", "vx", "vy", "vz"),
    ("x", "y", "vx", "vy", "turn_rate"),
)  # fmt: skip
DERIVED: tuple[dict[str, Any], ...] = (
    {"rule": "bci", "rule_options": {"max_correlation": "derived"}},
    {"rule": "bar-shalom-campo", "rule_options": {"cross": "derived"}},
    {"rule": "bci", "rule_options": {"max_correlation": {"within": 0.9, "between": 0.2}}},
    {"rule": "ci"},
)
MOTIONS = (
    schemas.Motion("cv", 0.0), schemas.Motion("cv", 0.05), schemas.Motion("cv", 1.0), schemas.Motion("cv", 30.0),
    schemas.Motion("cv", 1e12), schemas.Motion("ca", 0.1), schemas.Motion("ct", 1.0, q_turn=1e-4),
    schemas.Motion("singer", sigma=2.0, tau=1e-6), schemas.Motion("singer", sigma=2.0, tau=20.0),
    schemas.Motion("ou", sigma=10.0, tau=60.0), schemas.Motion("still", 0.1, sigma=0.5),
)  # fmt: skip


def settings(rng: np.random.Generator) -> CentreConfig:
    """Of a centre that follows the versions of tracks, in one of the ways there are."""

    def one(*of: Any) -> Any:
        return of[int(rng.integers(len(of)))]

    way = int(rng.integers(4))
    rule = {"rule": "auto"} if way == 0 else one(*DERIVED[:2]) if way == 1 else one(*DERIVED)
    table: dict[str, Any] = {
        **rule,
        "memory": "tracklet" if way > 1 else one("restart", "tracklet", "auto") if way == 0 else "restart",
        "space": list(one(SPACE, SPACE, SPACE, *SPACES[1:])),
        "lateness": one(0.0, 2.0, 5.0),
        "coast": one(2.0, 8.0),
        "period": one(0.5, 1.0),
        "mixture_rule": one("moments", "gm-ga", "aa"),
        "min_sources": one(1, 1, 2),
        "stale_periods": one(3.0, 10.0),
        "manoeuvre": one(0.0, 20.0),
        "source_defaults": {"registration_sigma": one(0.0, 0.0, 0.0, 0.0, 0.0, 15.0)},
        "sources": {"b": {"inflation": one(1.0, 2.0), "override": one(False, True)}, "global/p": {}},
    }
    if rng.random() < 0.5:
        table["frame"] = {"kind": "enu", "lat": FRAME.lat, "lon": FRAME.lon}
    if rng.random() < 0.2:
        table["motion"] = {"kind": "cv", "q": 2.0}
    return centre_config(table)


class _Tracker:
    """A tracker of all targets: a Kalman filter each, in the plane or in a wider space."""

    def __init__(self, name: str, count: int, rng: np.random.Generator) -> None:
        self.name, self.rng, self.epoch, self.seq = name, rng, 1, 0
        self.base = 1
        self.sigma, self.q = float(rng.choice([5.0, 20.0, 60.0])), float(rng.choice([0.05, 1.0, 30.0]))
        self.every = int(rng.choice([1, 1, 2, 3]))
        self.late = float(rng.choice([0.0, 0.0, 0.0, 1.2, 3.0]))
        self.feedback = bool(rng.random() < 0.1)
        self.says = schemas.Motion("cv", self.q) if rng.random() < 0.6 else None
        self.group = str(rng.choice(["", "", "north"]))
        self.where = FRAME if rng.random() < 0.7 else schemas.Enu(59.01, -55.02, 5.0)
        self.drifts = bool(rng.random() < 0.15)
        self.space = SPACE if rng.random() < 0.7 else SPACES[int(rng.integers(len(SPACES)))]
        self.fickle = bool(rng.random() < 0.2)
        self.mixed = bool(rng.random() < 0.15)
        self.kin = rng.random() < 0.25
        self.complete = bool(rng.random() < 0.6)
        self.begin(count)

    def begin(self, count: int) -> None:
        self.x, self.P, self.t = np.zeros((count, 4)), np.tile(np.diag([1e6, 1e6, 400.0, 400.0]), (count, 1, 1)), -1.0

    def info(self) -> schemas.SensorInfo:
        rng = self.rng
        self.seq += 1
        motion = self.says or MOTIONS[int(rng.integers(len(MOTIONS)))]
        more: dict[str, Any] = {"feedback": True} if self.feedback else {}
        if self.group:
            more["correlation_group"] = self.group
        if rng.random() < 0.1:
            more["position_covariance"] = np.diag(rng.choice([0.0, 25.0, 1e4], size=3))
        return schemas.SensorInfo(
            source=self.name, epoch=self.epoch, seq=self.seq, sent=START, frame=self.where, position=(0.0, 0.0, 0.0),
            period=float(self.every), motion=motion, **more,
        )  # fmt: skip

    def look(self, states: Floats, t: float) -> NDArray[np.intp]:
        """Take measurements of these states at `t`; which targets were seen."""
        seen = np.flatnonzero(self.rng.random(len(states)) < 0.9)
        dt = t - self.t if self.t >= 0 else 0.0
        noise = self.q * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
        F = np.eye(4) + dt * np.eye(4, k=2)
        x, P = self.x @ F.T, F @ self.P @ F.T + noise
        z = states[seen, :2] + self.rng.normal(size=(len(seen), 2)) * self.sigma
        K = P[seen][:, :, :2] @ np.linalg.inv(P[seen][:, :2, :2] + self.sigma**2 * np.eye(2))
        x[seen] += (K @ (z - x[seen, :2])[..., None])[..., 0]
        P[seen] = P[seen] - K @ P[seen][:, :2]
        self.x, self.P, self.t = x, 0.5 * (P + P.swapaxes(1, 2)), t
        return seen

    def message(self, seen: NDArray[np.intp], second: float) -> schemas.LocalTracks:
        rng, space = self.rng, self.space
        if self.fickle and rng.random() < 0.15:
            space = SPACES[int(rng.integers(len(SPACES)))]
        some = seen if rng.random() < 0.9 else seen[:0]
        names = ("x", "y", "vx", "vy", "z", "vz", "ax", "ay", "turn_rate")
        x = np.concatenate([self.x[some], np.tile([50.0, 0.0, 0.0, 0.0, 0.0], (len(some), 1))], axis=1)
        P = np.zeros((len(some), 9, 9))
        P[:, range(4, 9), range(4, 9)] = [100.0, 4.0, 1.0, 1.0, 1e-3]
        P[:, :4, :4] = self.P[some]
        at = [names.index(one) for one in space]
        x, P, ids = x[:, at], P[:, at][:, :, at], some.astype(np.uint64) + np.uint64(1)
        if rng.random() < 0.05 and len(ids) > 1:
            ids[[0, 1]] = ids[[1, 0]]
        made: dict[str, Any] = {}
        if self.mixed and rng.random() < 0.7:
            made = {"counts": np.full(len(ids), 2, dtype=np.uint16), "weights": np.full(2 * len(ids), 0.5)}
            x, P = np.repeat(x, 2, axis=0), np.repeat(P, 2, axis=0)
            x[::2, 0] += self.sigma
        if self.kin:
            made["lineage"] = [(self.name,), ("a", self.name), ("a", "b"), ("A", self.name)][int(rng.integers(4))]
            if rng.random() < 0.5:
                made["track_lineage"] = rng.integers(0, 4, (len(ids), 1)).astype(np.uint8)
        if rng.random() < 0.2:
            made["identity"] = tuple(["mmsi:1", None][int(k)] for k in rng.integers(0, 2, len(ids)))
        if rng.random() < 0.1:
            made["updated"] = np.full(len(ids), START + round((second - 1) * SECOND))
        self.seq += 1
        return schemas.LocalTracks(
            source=self.name, epoch=self.epoch, seq=self.seq, sent=START, time=START + round(second * SECOND),
            complete=self.complete, space=space, frame=self.where, ids=ids, means=x, covariances=P, **made,
        )  # fmt: skip

    def sent(self, states: Floats, clock: float, number: int) -> list[schemas.Message]:
        rng = self.rng
        out: list[schemas.Message] = []
        if self.drifts and isinstance(self.where, schemas.Enu):
            self.where = dataclasses.replace(self.where, lat=self.where.lat + 1e-5)
        if rng.random() < 0.04:
            self.epoch, self.seq = self.epoch + 1, 0
            self.begin(len(states))
        if number == 1 or rng.random() < 0.08 or self.seq == 0:
            out.append(self.info())
        if number % self.every:
            return out
        for part in (0.5, 0.0) if rng.random() < 0.3 else (0.0,):
            message = self.message(self.look(states, clock - part), clock - part)
            out.append(message)
        if rng.random() < 0.06:  # the same time again with other content
            self.seq += 1
            means = message.means + rng.normal(0, 5.0, message.means.shape)
            out.append(dataclasses.replace(message, seq=self.seq, means=means))
        if rng.random() < 0.04:  # not what a tracker says
            message.covariances[:] *= rng.choice([1e-6, 1e-3, 1e3, 1e9])
        return out


@cache
def fly(seed: int, steps: int = 24) -> Mission:
    """The mission of a seed."""
    rng = np.random.default_rng(seed)
    config = settings(rng)
    centre = FusionCentre(config, generation=GENERATION, epoch=START)
    count = int(rng.integers(1, 7))
    states = truth(count, spread=float(rng.choice([200.0, 8000.0])), seed=seed)
    states[:, 2:] *= 0.2
    sources = [_Tracker(name, count, rng) for name in SOURCES[: int(rng.integers(2, 6))]]
    mission, clock = Mission(config, [], []), 0.0
    waiting: list[tuple[float, schemas.Message]] = []
    for number in range(1, steps + 1):
        clock += 1.0
        states[:, :2] += states[:, 2:]
        events: list[tuple[Event, int]] = []
        if number in (9, 17) and rng.random() < 0.2:
            back = float(rng.choice([2.0, 100.0, 7200.0]))
            events.append((ClockSet(START + round((clock - back) * SECOND)), START + round((clock - back) * SECOND)))
            if back > 50:
                clock -= back
                for source in sources:
                    source.t -= back
        now = START + round(clock * SECOND)
        if rng.random() < 0.3:
            events += [(order, now) for order in _orders(rng, mission.results, sources, now)]  # type: ignore[arg-type]
        events += [(event, now) for event in _presence(rng, sources)]  # type: ignore[arg-type]
        for source in sources:
            for message in source.sent(states, clock, number):
                if rng.random() < 0.1:
                    continue
                late = source.late if rng.random() < 0.5 else 0.0
                waiting.append((clock + late, message))
        due = [message for at, message in waiting if at <= clock or at > clock + 10]
        waiting = [(at, message) for at, message in waiting if clock < at <= clock + 10]
        events += [(_on_bus(message), now) for message in due]
        time = max(now, centre.time + 1)
        for event, received in events:
            centre.handle(event, received)
        if any(isinstance(event, ClockSet) for event, _ in events):
            time = max(now, centre.time + 1)
        mission.given.append(Given(time, events))
        mission.results.append(centre.step(time))
    return mission
