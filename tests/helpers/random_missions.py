"""Missions drawn from a seed that hold all that can come in, good and bad, under random settings; flown step by step,
since orders are about tracks that there are."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

import schemas
from fusion_service.centre import (
    ClockSet,
    Event,
    FusionCentre,
    LocalId,
    NewEra,
    Order,
    Refused,
    SourceFound,
    SourceLost,
    StepResult,
    order_of,
)
from fusion_service.config import CentreConfig, centre_config
from tests.centre.worlds import FRAME, SECOND, SPACE, START, info, moved, tracks, truth

HUGE = 2**64 - 10_000
GENERATION = 400_000_000
"""Global ids from it need 61 bits: more than a float holds."""
SOURCES = ("a", "b", "c", "d")
LONG = ("x", "y", "z", "vx", "vy", "vz")


@dataclass
class Given:
    """What one step was given, in order, and when: (event, received); and its time, ns."""

    time: int
    events: list[tuple[Event, int]] = field(default_factory=list)


@dataclass
class Mission:
    """A mission as flown: settings, what every step was given, and what came of it."""

    config: CentreConfig
    given: list[Given]
    results: list[StepResult]


def settings(rng: np.random.Generator) -> CentreConfig:
    """Settings of a centre, any."""

    def one(*of: Any) -> Any:
        return of[int(rng.integers(len(of)))]

    table: dict[str, Any] = {
        "lateness": one(0.0, 2.0, 5.0),
        "coast": one(0.0, 2.0, 5.0),
        "period": one(0.5, 1.0),
        "memory": one("restart", "recursive", "tracklet", "tracklet"),
        "memory_correlation": one(1.0, 0.5),
        "rule": one("ci", "naive", "aa", "ici", "ei", "cu", "hmd-ga", "fast-ci", "auto", "auto", "bci"),
        "mixture_rule": one("moments", "gm-ga", "aa", "cu-modes"),
        "max_components": one(1, 3, 8),
        "publish": one("mixture", "mean", "mode"),
        "existence": one("consistent", "average", "geometric"),
        "min_existence": one(0.0, 0.0, 0.2, 0.6),
        "confirm_existence": one(0.0, 0.0, 0.7),
        "min_sources": one(1, 1, 2),
        "fuse_origins": one(False, True),
        "publish_status": one(
            ["tentative", "confirmed", "coasting"], ["confirmed"], ["confirmed", "coasting"], ["tentative"]
        ),
        "publish_region": one(None, None, {"kind": "disk", "radius": 6000.0}),
        "error_rate": one(1e-3, 0.1),
        "manoeuvre": one(0.0, 20.0),
        "remember": one(0.0, 600.0),
        "max_pending": one(3, 10_000),
        "frame": one(None, {"kind": "enu", "lat": FRAME.lat, "lon": FRAME.lon}),
        "source_defaults": {"false_track": one(0.1, 1.0), "gate": one(None, 0.9), "period": one(1.0, 3.0)},
        "sources": {
            "a": {"gate": one(0.999999, 0.6), "covariance_floor": one(0.0, 20.0)},
            "b": {"may_start": one(True, False), "override": one(True, False), "identity_trust": one(0.99, 0.6)},
            "d": {"ignore": one(False, False, True), "inflation": one(1.0, 4.0)},
        },
    }
    if table["rule"] == "auto" and table["memory"] == "recursive":
        table["memory"] = "restart"
    return centre_config(_without_none(table))


def _without_none(table: dict[str, Any]) -> dict[str, Any]:
    return {
        name: _without_none(value) if isinstance(value, dict) else value
        for name, value in table.items()
        if value is not None
    }


class _Source:
    """One source: what it sends at a step, good or not."""

    def __init__(self, name: str, rng: np.random.Generator) -> None:
        self.name, self.rng, self.epoch, self.seq = name, rng, int(rng.integers(1, 5)), 0
        self.base = int(rng.choice(np.array([1, 1000, HUGE, 2**63 - 3], dtype=np.uint64)))
        self.complete = bool(rng.random() < 0.6)
        self.pause = float(rng.choice([0.0, 0.0, 0.3, 0.7]))
        self.kind = str(rng.choice(["gauss", "gauss", "mixture", "long"]))
        self.existence, self.identity = bool(rng.random() < 0.4), bool(rng.random() < 0.4)
        self.frozen, self.informed = bool(rng.random() < 0.2), bool(rng.random() < 0.7)
        self.origin = str(rng.choice(["live", "live", "live", "exercise", "simulated"]))
        self.last: schemas.LocalTracks | None = None

    def info(self) -> schemas.SensorInfo:
        rng = self.rng
        declared: dict[str, Any] = {"origin": self.origin}
        if rng.random() < 0.5:
            declared |= {"coverage": schemas.Disk(float(rng.choice([2e3, 30e3]))), "detection_probability": 0.9}
            declared["detection_probability"] = float(rng.choice([0.0, 0.5, 0.9, 1.0]))
        declared["initiation_delay"] = float(rng.choice([0.0, 2.0]))
        declared["period"] = float(rng.choice([0.5, 1.0, 4.0]))
        self.seq += 1
        return info(self.name, epoch=self.epoch, seq=self.seq, **declared)

    def tracks(self, states: np.ndarray, second: float) -> schemas.LocalTracks:
        rng, count = self.rng, len(states)
        some = np.flatnonzero(rng.random(count) < 0.85)
        if rng.random() < 0.06:
            some = some[:0]
        means = states[some] + rng.normal(size=(len(some), 4)) * [30, 30, 2, 2]
        ids = [self.base + int(k) for k in some]
        if rng.random() < 0.1 and len(ids) > 1:
            ids[0], ids[1] = ids[1], ids[0]
        twin = rng.random() < 0.2 and len(some) > 0
        if twin:
            means, ids = np.concatenate([means, means[:1] + 5]), [*ids, self.base + 200]
        ids = [one % 2**64 for one in ids]
        n, at = len(ids), START + round(second * SECOND)
        made: dict[str, Any] = {"complete": self.complete, "origin": self.origin}
        covariances = np.tile(np.diag([900.0, 900.0, 4.0, 4.0]), (n, 1, 1)) * rng.choice([1.0, 1.0, 0.1, 25.0])
        if self.existence:
            made["existence"] = rng.choice([0.0, 1.0, 0.3, 0.9], size=n)
        if self.frozen or rng.random() < 0.1:
            made["updated"] = np.full(n, at - round(float(rng.choice([0, 5, 1])) * SECOND))
        if self.identity:
            words = ["mmsi:1", "mmsi:2", "icao:a", None]
            made["identity"] = tuple(words[int(k)] for k in rng.integers(0, 4, n))
            made["kind"] = tuple(["ship", "bird", None][int(k)] for k in rng.integers(0, 3, n))
            made["kind_p"] = rng.choice([0.2, 1.0], size=n)
        if self.kind == "mixture":
            counts = rng.integers(1, 4, n).astype(np.uint16)
            made["counts"] = counts
            made["weights"] = np.repeat(1.0 / np.maximum(counts, 1), counts)
            means, covariances = np.repeat(means, counts, axis=0), np.repeat(covariances, counts, axis=0)
            means = means + rng.normal(size=means.shape) * [60, 60, 3, 3]
        if self.kind == "long":
            means = np.insert(means, 2, 50.0, axis=1)
            means = np.insert(means, 5, 0.0, axis=1)
            covariances = np.tile(np.diag([900.0, 900, 900, 4, 4, 4]), (len(means), 1, 1))
            made["space"] = LONG
        self.seq += 1
        message = tracks_of(self.name, second, means, covariances, ids, self.seq, self.epoch, made)
        return self.spoilt(message)

    def spoilt(self, message: schemas.LocalTracks) -> schemas.LocalTracks:
        rng, n = self.rng, len(message.means)
        if n and rng.random() < 0.15:
            what = rng.integers(0, 7)
            row = int(rng.integers(0, n))
            if what == 0:
                message.means[row, 0] = np.nan
            elif what == 1:
                message.covariances[row, 0, 0] = rng.choice([-1.0, 0.0, np.inf, 1e300, 1e-300])
            elif what == 2:
                message.means[row] = rng.choice([1e300, -1e9, 1e8])
            elif what == 3:
                message.covariances[row] *= rng.choice([1e12, 1e-6])
            elif what == 4 and message.existence is not None:
                message.existence[0] = rng.choice([np.nan, -1.0, 2.0])
            elif what == 5 and message.weights is not None:
                message.weights[0] = rng.choice([np.nan, -1.0, 2.0])
            elif what == 6:
                updated = np.full(len(message.ids), message.time)
                updated[0] = rng.choice([-(2**63), 0, 2**63 - 1])
                message = dataclasses.replace(message, updated=updated)
        if rng.random() < 0.04:
            times = [0, 2**63 - 1, message.time + 3600 * SECOND, message.time - 3600 * SECOND]
            message = dataclasses.replace(message, time=times[int(rng.integers(0, 4))])
        return message


def tracks_of(
    name: str, second: float, means: np.ndarray, covariances: np.ndarray, ids: list[int], seq: int, epoch: int,
    made: dict[str, Any],
) -> schemas.LocalTracks:  # fmt: skip
    made = {"space": SPACE, **made}
    message = tracks(name, second, np.zeros((0, 4)), [], seq=seq, epoch=epoch, complete=made.pop("complete"))
    own: dict[str, Any] = {"ids": np.array(ids, dtype=np.uint64), "means": means, "covariances": covariances}
    return dataclasses.replace(message, **{**own, **made})


def narrowed(message: schemas.LocalTracks, space: tuple[str, ...]) -> schemas.LocalTracks:
    """The message with these components alone, as far as it has them."""
    names = tuple(name for name in space if name in message.space)
    at = [message.space.index(name) for name in names]
    covariances = message.covariances[:, at][:, :, at]
    return dataclasses.replace(message, space=names, means=message.means[:, at], covariances=covariances)


def _narrow(message: schemas.LocalTracks, seed: int) -> schemas.LocalTracks:
    """What each source tells in a mission of partial states: one places alone, others all, one changes its mind."""
    tells = (("x", "y"), None, ("y", "x", "z", "vy"), None)[(SOURCES.index(message.source[0]) + seed) % 4]
    if message.source == "b" and message.time // SECOND % 7 == seed % 7:
        tells = ("x", "y", "vx", "vy")
    return message if tells is None else narrowed(message, tells)


@cache
def fly(seed: int, steps: int = 14, partial: bool = False) -> Mission:
    """The mission of a seed; partial: with sources that do not tell all of the state."""
    rng = np.random.default_rng(seed)
    config = settings(rng)
    if partial and seed % 2:
        config = dataclasses.replace(config, space=LONG)
    centre = FusionCentre(config, generation=GENERATION, epoch=START)
    sources = [_Source(name, rng) for name in SOURCES[: int(rng.integers(2, 5))]]
    close = rng.random() < 0.5
    states = truth(int(rng.integers(1, 9)), spread=150.0 if close else 8000.0, seed=seed)
    states[:, 2:] *= 0.2
    mission = Mission(config, [], [])
    waiting: list[schemas.Message] = []
    clock = 0.0
    for number in range(1, steps + 1):
        clock += 1.0
        events: list[tuple[Event, int]] = []
        if number == 8 and rng.random() < 0.3:
            back = float(rng.choice([2.0, 100.0, 7200.0]))
            events.append((ClockSet(START + round((clock - back) * SECOND)), START + round((clock - back) * SECOND)))
            clock -= back if back > 50 else 0.0
        now = START + round(clock * SECOND)
        events += [(order, now) for order in _orders(rng, mission.results, sources, now)]
        events += [(event, now) for event in _presence(rng, sources)]
        messages, waiting = waiting, []
        for source in sources:
            sent = _sent(source, moved(states, clock), clock, number)
            for message in sent:
                if partial and isinstance(message, schemas.LocalTracks) and message.source in SOURCES:
                    message = _narrow(message, seed)
                (waiting if rng.random() < 0.12 else messages).append(message)
                if rng.random() < 0.08:
                    messages.append(message)
        events += [(_on_bus(message), now) for message in messages]
        time = max(now, centre.time + 1)
        for event, received in events:
            centre.handle(event, received)
        if any(isinstance(event, ClockSet) for event, _ in events):
            time = max(now, centre.time + 1)
        mission.given.append(Given(time, events))
        mission.results.append(centre.step(time))
    return mission


def _sent(source: _Source, states: np.ndarray, clock: float, number: int) -> list[schemas.Message]:
    rng = source.rng
    if rng.random() < 0.04:
        source.epoch, source.seq = source.epoch + int(rng.choice([1, 5])), 0
    out: list[schemas.Message] = []
    if (number == 1 and source.informed) or rng.random() < 0.1:
        out.append(source.info())
    if rng.random() < source.pause:
        return out
    for _ in range(int(rng.choice([1, 1, 2]))):
        late = float(rng.choice([0.0, 0.25, 0.5, 3.0]))
        out.append(source.tracks(states, clock - late))
    if rng.random() < 0.05:
        out.append(dataclasses.replace(out[-1], source="e"))
    return out


def _on_bus(message: schemas.Message) -> Event:
    """As it comes from the bus: decoded, or refused there."""
    try:
        return schemas.decode(schemas.encode(message))
    except schemas.MessageError as error:
        return Refused(message.source, error.reason)


def _presence(rng: np.random.Generator, sources: list[_Source]) -> list[Event]:
    events: list[Event] = []
    if rng.random() < 0.15:
        name = sources[int(rng.integers(len(sources)))].name
        events.append(SourceFound(name) if rng.random() < 0.5 else SourceLost(name))
    return events


def _orders(rng: np.random.Generator, results: list[StepResult], sources: list[_Source], now: int) -> list[Order]:
    orders: list[Order] = []
    while results and rng.random() < 0.35:
        picture = results[-1].tracks
        tracks_there = [*picture.ids.tolist(), 1, 2**64 - 1]
        names = [*picture.sources, "nobody"]
        locals_there = [
            LocalId(picture.sources[k], -1, one)
            for k, one in zip(picture.contributor_source.tolist(), picture.contributor_id.tolist(), strict=True)
        ]
        locals_there += [LocalId("a", -1, sources[0].base), LocalId("nobody", 3, 2**64 - 1)]

        def one(of: list[Any]) -> Any:
            return of[int(rng.integers(len(of)))]

        what = str(rng.choice([*_WHAT]))
        order = Order(
            what, source=one(names), track=one([*tracks_there, None]) if rng.random() < 0.9 else None,
            other=one(tracks_there), local=one(locals_there), against=one([*locals_there, None]),
            name=one(["", "Bravo"]), shown=one([0, 7]), identity=one(["mmsi:9", "mmsi:1", ""]),
            withdrawn=int(rng.integers(0, 6)), until=one([None, None, now + 3 * SECOND, 0]),
        )  # fmt: skip
        if what in ("unlink", "split") and rng.random() < 0.7:
            order = dataclasses.replace(order, track=None)
        if what == "never-link" and order.against is not None:
            order = dataclasses.replace(order, track=None)
        orders.append(order)
    return orders


_WHAT = (
    "delete", "link", "link", "unlink", "never-link", "merge", "merge", "split", "rename", "identify", "mute", "unmute",
    "unmute", "quarantine", "release", "release", "drop", "withdraw", "nonsense",
)  # fmt: skip


def again(mission: Mission, order: np.random.Generator | None = None) -> list[StepResult]:
    """The same events to another centre; with `order` the messages of every step come shuffled."""
    centre = FusionCentre(mission.config, generation=GENERATION, epoch=START)
    results = []
    for given in mission.given:
        events = given.events
        if order is not None and mission.config.max_pending > 100:  # what a full queue drops goes by arrival
            at = [
                k for k, (event, _) in enumerate(events) if isinstance(event, schemas.LocalTracks | schemas.SensorInfo)
            ]
            moved_to = order.permutation(at).tolist()
            events = list(events)
            for k, other in zip(at, moved_to, strict=True):
                events[k] = given.events[other]
        for event, received in events:
            centre.handle(event, received)
        results.append(centre.step(given.time))
    return results


def restarted(mission: Mission, after: int) -> list[StepResult]:
    """The results of the steps from `after` on, of a centre that begins from the checkpoint before them."""
    centre = FusionCentre(mission.config, generation=GENERATION, epoch=START)
    results = []
    for number, given in enumerate(mission.given):
        if number == after:
            queued = list(centre._intake.queue)
            centre = FusionCentre(mission.config, centre.checkpoint(), epoch=START)
            for message, received in queued:
                centre.handle(message, received)
        for event, received in given.events:
            centre.handle(event, received)
        result = centre.step(given.time)
        if number >= after:
            results.append(result)
    return results


def from_logs(mission: Mission) -> list[StepResult]:
    """The mission made again from its step logs and the messages alone."""
    messages = {
        schemas.digest(event): event
        for given in mission.given
        for event, _ in given.events
        if isinstance(event, schemas.LocalTracks | schemas.SensorInfo)
    }
    centre = FusionCentre(mission.config, generation=GENERATION, epoch=START)
    results = []
    for result in mission.results:
        log = schemas.decode(schemas.encode(result.log))
        assert isinstance(log, schemas.StepLog)
        for one in log.dropped:
            centre.handle(Refused(one.source, one.reason, one.count, dropped=True), 2**62)
        for event in log.events:
            kind = event["kind"]
            if kind == "era":
                centre.handle(NewEra(event["time"]), 2**62)
            elif kind in ("found", "lost"):
                centre.handle((SourceFound if kind == "found" else SourceLost)(event["source"]), 2**62)
            elif (order := order_of(event)) is not None:
                centre.handle(order, 2**62)
        for entry in log.taken:
            centre.handle(messages[entry.hash], 2**62)
        results.append(centre.step(log.time))
    return results
