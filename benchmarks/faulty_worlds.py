"""Small worlds in which sources are sound, or wrong in one way or two: what `benchmarks.faulty_sources` runs.

Ten targets or so, at 40 to 80 m/s within some 20 km, whose accelerations are the white noise that the trackers suppose
(0.5 m2/s3) where nothing else is said; sensors some kilometres apart, each with a Kalman filter for every target
(`benchmarks.worlds.kalman`), sigmas of 10 to 20 m, a scan a second.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from benchmarks.worlds.kalman import transition
from benchmarks.worlds.world import FRAME, Floats, Path, Sensor, flickers, ns, observe, scan_times, told
from schemas import LocalTracks, SensorInfo
from sensor_clients.events import Event
from sensor_clients.faults import Fault, faulty

__all__ = ["WORLDS", "Scene", "World", "Wrong"]

Q = 0.5
FINE = 0.25
BIG = np.uint64(1_000_000)


@dataclass(frozen=True)
class Wrong:
    """A fault of a source: fault, or one that changes, `later(t)`, t in s; begin, end, s, of either; deviations: it
    sends standard deviations as variances; ghosts: so many targets of its own; restart: s, when it begins anew with new
    ids; frozen: from when on, s, it says the same again and again."""

    fault: Fault = Fault()
    later: Callable[[float], Fault] | None = None
    begin: float = 0.0
    end: float = math.inf
    deviations: bool = False
    ghosts: int = 0
    restart: float = math.inf
    frozen: float = math.inf

    def at(self, time: float) -> Fault:
        """What is wrong at a time, s."""
        if not self.begin <= time < self.end:
            return Fault()
        return self.fault if self.later is None else self.later(time)


@dataclass(frozen=True)
class Scene:
    """What a world is made of. sensors; wrong by source; targets: path(rng, seconds); copies: source -> whom it says
    again, 0.4 s later, as its own; seen: source -> which targets; near: m within which a track is a target's."""

    sensors: Sequence[Sensor]
    path: Callable[[np.random.Generator, float], Path]
    wrong: Mapping[str, Wrong] = field(default_factory=dict)
    copies: Mapping[str, str] = field(default_factory=dict)
    seen: Mapping[str, Sequence[int]] = field(default_factory=dict)
    clutter: float = 0.0
    white: bool = False
    seconds: float = 120.0
    near: float = 400.0
    config: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class World:
    """What is said, (received, message) in that order; truth (S, T, 2) at the seconds 1, 2, ...; which are wrong."""

    said: list[tuple[int, SensorInfo | LocalTracks]]
    truth: Floats
    near: float
    wrong: frozenset[str]
    config: dict[str, Any]

    @classmethod
    def made(cls, scene: Scene, seed: int) -> World:
        """A world of a scene."""
        rng = np.random.default_rng(seed)
        path = scene.path(rng, scene.seconds)
        messages: list[tuple[int, SensorInfo | LocalTracks]] = []
        for sensor in scene.sensors:
            source = scene.copies.get(sensor.name)
            mine = _heard(scene, sensor, path, rng) if source is None else _again(messages, sensor.name, source)
            messages += mine
        messages.sort(key=lambda one: (one[0], one[1].source, one[1].seq))
        times = np.arange(1.0, scene.seconds + 0.5)
        wrong = frozenset({*scene.wrong, *scene.copies})
        return cls(messages, path(times)[..., :2], scene.near, wrong, {"frame": FRAME, **scene.config})


def _heard(scene: Scene, sensor: Sensor, path: Path, rng: np.random.Generator) -> list[tuple[int, Any]]:
    """What a sensor says, wrong as it is."""
    wrong = scene.wrong.get(sensor.name, Wrong())
    some = scene.seen.get(sensor.name)
    also = None
    scans = int(scene.seconds / sensor.period) + 1
    if scene.clutter:
        places = flickers(rng, scans, scene.clutter, 20e3, 3.0, sensor.drop)
        also = places, np.full(places.shape[1], -1)
    if wrong.ghosts:
        times: Floats = sensor.period * np.arange(1.0, scans + 1)
        own: Floats = np.array(random_walks(wrong.ghosts)(rng, scene.seconds + 60)(times)[..., :2])
        own[(times < wrong.begin) | (times >= wrong.end)] = np.nan
        also = own, np.full(wrong.ghosts, -1)

    def visible(times: Floats, states: Floats) -> Any:
        there = np.zeros(states.shape[:2], dtype=np.bool_)
        there[:, some if some is not None else slice(None)] = True
        return there

    if also is not None:  # as many scans as there are
        also = also[0][: len(scan_times(sensor, scene.seconds))], also[1]
    out: list[tuple[int, Any]] = []
    info, run, held = None, 1, None
    for received, message, target in told(sensor, observe(sensor, path, scene.seconds, rng, seen=visible, also=also)):
        if isinstance(message, SensorInfo):
            info = message
            out.append((received, message))
            continue
        time = (message.time - ns(0.0)) / 1e9
        if time >= wrong.restart and run == 1 and info is not None:
            run = 2
            out.append((received - 1, replace(info, epoch=2, sent=received - 1)))
        if scene.white and target is not None:
            message = _drawn(message, path(np.array([time]))[0][target], rng)
        if time < wrong.frozen or held is None:
            held = message
        assert held.updated is not None
        same = {name: getattr(held, name) for name in ("ids", "means", "covariances")}
        again = replace(message, updated=held.updated + (message.time - held.time), **same)
        out.append((received, _made(again, wrong, time, sensor, run)))
    return out


def _drawn(message: LocalTracks, states: Floats, rng: np.random.Generator) -> LocalTracks:
    """The same with errors drawn anew, by what it says of them."""
    root = np.linalg.cholesky(message.covariances).astype(np.float64)
    errors = (root @ rng.normal(size=states.shape)[..., None])[..., 0]
    return replace(message, means=states + errors)


def _made(message: LocalTracks, wrong: Wrong, time: float, sensor: Sensor, run: int) -> LocalTracks:
    """A message of the `run`th run of a sensor as its fault at `time`, s, makes it."""
    fault = wrong.at(time)
    fields: dict[str, Any] = {"space": message.space, "means": message.means, "covariances": message.covariances}
    fields["updated"] = message.updated
    info = Event(message.time, "info", {"position": (*sensor.place, 0.0)})
    made = list(faulty(iter([info, Event(message.time, "tracks", fields)]), fault))[-1]
    covariances = np.array(made.fields["covariances"])
    if wrong.deviations and wrong.begin <= time < wrong.end:
        covariances = np.stack([np.diag(np.sqrt(np.diag(one))) for one in covariances]).reshape(covariances.shape)
    more = {name: made.fields[name] for name in ("means", "updated")}
    ids = message.ids if run == 1 else message.ids + BIG
    return replace(message, time=made.time, covariances=covariances, epoch=run, ids=ids, **more)


def _again(messages: list[tuple[int, Any]], name: str, source: str) -> list[tuple[int, Any]]:
    """What a source said, said again by another."""
    out = []
    for received, message in messages:
        if message.source == source:
            more = {} if isinstance(message, SensorInfo) else {"ids": message.ids + BIG}
            out.append((received + 400_000_000, replace(message, source=name, **more)))
    return out


def random_walks(
    count: int, q: float = Q, spread: float = 10e3, speed: float = 60.0, course: float | None = None
) -> Callable[[np.random.Generator, float], Path]:
    """Targets at nearly constant velocity; course: of all of them, rad."""

    def path(rng: np.random.Generator, seconds: float) -> Path:
        steps = int((seconds + 10.0) / FINE) + 2
        F, cov = transition(FINE, max(q, 1e-12))
        root = np.linalg.cholesky(cov)
        state = np.zeros((steps, count, 4))
        way = rng.uniform(0, 2 * np.pi, count) if course is None else np.full(count, course)
        speeds = speed * rng.uniform(0.7, 1.3, count)
        velocity = speeds[:, None] * np.stack([np.cos(way), np.sin(way)], axis=1)
        middle = _apart(rng, count, spread)
        state[0] = np.concatenate([middle - velocity * seconds / 2, velocity], axis=1)
        for k in range(1, steps):
            state[k] = state[k - 1] @ F.T + (rng.normal(size=(count, 4)) @ root.T) * (q > 0)
        return _between(state)

    return path


def _apart(rng: np.random.Generator, count: int, spread: float) -> Floats:
    return np.asarray(rng.uniform(-spread, spread, (count, 2)))


def _between(state: Floats) -> Path:
    def path(times: Floats) -> Floats:
        at = np.clip(times / FINE, 0, len(state) - 1.001)
        low = at.astype(int)
        part = (at - low)[:, None, None]
        return np.asarray((1 - part) * state[low] + part * state[low + 1])

    return path


def turning(count: int, rate: float = 2.0) -> Callable[[np.random.Generator, float], Path]:
    """Half a minute straight on, half a minute turning at `rate` degrees/s to either side, and so on."""

    def path(rng: np.random.Generator, seconds: float) -> Path:
        steps = int((seconds + 10.0) / FINE) + 2
        way, side = rng.uniform(0, 2 * np.pi, count), rng.choice([-1.0, 1.0], count)
        phase = rng.uniform(0, 60, count)
        t = FINE * np.arange(steps)[:, None]
        angle = way + np.cumsum(((t + phase) % 60 < 30) * side * math.radians(rate) * FINE, axis=0)
        velocity = 60.0 * np.stack([np.cos(angle), np.sin(angle)], axis=2)
        place = _apart(rng, count, 8e3) + np.cumsum(velocity, axis=0) * FINE
        return _between(np.concatenate([place, velocity], axis=2))

    return path


def convoy(count: int, gap: float) -> Callable[[np.random.Generator, float], Path]:
    """One behind the other at 20 m/s, all with the same course."""

    def path(rng: np.random.Generator, seconds: float) -> Path:
        steps = int((seconds + 10.0) / FINE) + 2
        t = FINE * np.arange(steps)[:, None]
        along = 20.0 * (t - seconds / 2) - gap * np.arange(count) + 3.0 * np.sin(t / 20.0 + np.arange(count))
        speed = 20.0 + 0.15 * np.cos(t / 20.0 + np.arange(count))
        return _between(np.stack([along, np.zeros_like(along), speed, np.zeros_like(along)], axis=2))

    return path


def sensors(count: int, **more: Any) -> tuple[Sensor, ...]:
    """So many, on a circle of 6 km; sigmas 10 to 20 m, phases apart."""
    out = []
    for k in range(count):
        angle = 2 * math.pi * k / count
        place = (6e3 * math.cos(angle), 6e3 * math.sin(angle))
        fields = {"period": 1.0, "phase": round(0.2 + 0.7 * k / count, 3), "q": Q, "place": place, "speed": 60.0}
        out.append(Sensor(f"s{k}", (10.0, 15.0, 20.0)[k % 3], **{**fields, **more}))
    return tuple(out)


def _one(wrong: Wrong, count: int = 3, **more: Any) -> Scene:
    return Scene(sensors(count), random_walks(10), {"s1": wrong}, **more)


def _sound() -> dict[str, Scene]:
    """Nothing is wrong."""
    ten, three = random_walks(10), sensors(3)
    slower = zip(three, (1.0, 2.0, 4.0), (0.1, 0.4, 1.2), strict=True)
    rates = tuple(replace(one, period=period, latency=late) for one, period, late in slower)
    fine = tuple(replace(one, sigma=one.sigma / 3, q=0.05, speed=20.0) for one in three)
    precise = (replace(three[0], sigma=1.5), *three[1:])
    overlap = {"s0": range(8), "s1": range(4, 12), "s2": range(8, 16)}
    correlated = {"rule": "auto", "rule_options": {"max_correlation": {"within": 1.0, "between": 0.5}}}
    return {
        "sound 2": Scene(sensors(2), ten),
        "sound 3": Scene(three, ten),
        "sound 5": Scene(sensors(5), ten),
        "sound 20": Scene(sensors(20), random_walks(6), seconds=60.0),
        "sound 3, one target": Scene(three, random_walks(1)),
        "sound 2, one target": Scene(sensors(2), random_walks(1)),
        "sound 3, 40 targets": Scene(three, random_walks(40), seconds=60.0),
        "sound 3, white": Scene(three, ten, white=True),
        "sound 2, white": Scene(sensors(2), ten, white=True),
        "convoy": Scene(fine, convoy(8, 100.0), near=50.0),
        "one direction": Scene(three, random_walks(10, course=0.5)),
        "stationary": Scene(three, random_walks(10, q=1e-4, speed=0.0)),
        "turning": Scene(sensors(3, q=10.0), turning(10)),
        "turning, q too small": Scene(sensors(3, q=1.0), turning(10)),
        "rates, latencies": Scene(rates, ten),
        "partial overlap": Scene(three, random_walks(16), seen=overlap),
        "one 10 x as precise": Scene(precise, ten),
        "declared correlation": Scene(three, ten, config=correlated),
        "clutter": Scene(three, ten, clutter=3.0),
    }


def _alone() -> dict[str, Scene]:
    """One of three is wrong, in one way or in two."""
    faults = {
        "clock .2 s": Fault(clock=0.2),
        "clock .5 s": Fault(clock=0.5),
        "clock 1.5 s": Fault(clock=1.5),
        "clock 3 s": Fault(clock=3.0),
        "clock -3 s": Fault(clock=-3.0),
        "shift 50 m": Fault(x=30.0, y=40.0),
        "shift 200 m": Fault(x=120.0, y=-160.0),
        "heading .3 deg": Fault(heading=0.3),
        "heading 1 deg": Fault(heading=1.0),
        "range 100 m": Fault(range=100.0),
        "sigma x 1/3": Fault(sigma=1 / 3),
        "sigma x 1/10": Fault(sigma=0.1),
        "sigma x 3": Fault(sigma=3.0),
        "clock .5 s + shift 50 m": Fault(clock=0.5, x=30.0, y=40.0),
        "shift 200 m + sigma 1/3": Fault(x=200.0, sigma=1 / 3),
    }
    covered = {"range": 60e3, "detection": 0.95}
    return {name: _one(Wrong(fault)) for name, fault in faults.items()} | {
        "range 100 m, polar": _one(Wrong(Fault(range=100.0)), config={"sources": {"s1": {"polar": True}}}),
        "deviations": _one(Wrong(deviations=True)),
        "frozen": _one(Wrong(frozen=40.0)),
        "ghosts": replace(_one(Wrong(ghosts=4)), sensors=sensors(3, **covered)),
        "copy": Scene(sensors(4), random_walks(10), copies={"s3": "s0"}),
        "drift 10 ms/s": _one(Wrong(later=lambda t: Fault(clock=0.01 * t))),
        "restart": _one(Wrong(restart=60.0)),
        **{
            f"{name}, 100 to 200 s": _one(Wrong(faults[name], begin=100.0, end=200.0), seconds=300.0)
            for name in ("shift 200 m", "clock .5 s", "sigma x 1/3")
        },
    }


def _more() -> dict[str, Scene]:
    """Two of five are wrong; one of two is."""
    ten, five = random_walks(10), sensors(5)
    shifted = Wrong(Fault(x=200.0))
    faults = {
        "clock .5 s": Wrong(Fault(clock=0.5)),
        "shift 50 m": Wrong(Fault(x=30.0, y=40.0)),
        "shift 200 m": shifted,
        "sigma x 1/3": Wrong(Fault(sigma=1 / 3)),
        "sigma x 1/10": Wrong(Fault(sigma=0.1)),
        "sigma x 3": Wrong(Fault(sigma=3.0)),
        "frozen": Wrong(frozen=40.0),
    }
    unlike = {"s1": faults["clock .5 s"], "s3": faults["sigma x 1/3"]}
    ghosts = {"s1": Wrong(ghosts=3), "s3": Wrong(ghosts=3)}
    return {
        "two of 5: clock .5, sigma 1/3": Scene(five, ten, unlike),
        "two of 5 shifted alike": Scene(five, ten, {"s1": shifted, "s3": shifted}),
        "two of 5 with ghosts": Scene(sensors(5, range=60e3, detection=0.95), ten, ghosts),
        **{f"2: {name}": _one(wrong, count=2) for name, wrong in faults.items()},
    }


WORLDS = _sound() | _alone() | _more()
