"""A world as data: what is true at every step, and what every source says, with what each of its tracks is a track of.

A generator says where targets are (a `Path`) and which `Sensor`s there are; `observe` makes a sensor's scans and `told`
the messages of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from benchmarks.worlds.kalman import filtered
from schemas import Coverage, Disk, Enu, LocalTracks, Motion, SensorInfo

__all__ = [
    "DELAY",
    "FALSE",
    "FRAME",
    "SPACE",
    "START",
    "Path",
    "Scan",
    "Sensor",
    "Told",
    "World",
    "flickers",
    "grid",
    "ns",
    "observe",
    "scan_times",
    "straight",
    "told",
    "world",
]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Path: TypeAlias = Callable[[Floats], Floats]
"""Times (K,), s -> states (K, T, 4), (x, y, vx, vy), NaN where a target is not there."""

SECOND = 10**9
START = 1_700_000_000 * SECOND
FRAME = Enu(59.0, 10.0)
SPACE = ("x", "y", "vx", "vy")
DELAY = 0.5
"""How far behind the clock a step is, s: the centre's own default."""
FALSE = -1
"""The target of a track of nothing."""


def ns(seconds: float) -> int:
    """Time of the world as UTC, ns."""
    return START + round(seconds * SECOND)


@dataclass(frozen=True, slots=True)
class Sensor:
    """A sensor and its tracker. sigma: of a measured position on each axis, m; q as declared, m2/s3; period, phase (of
    the first scan) and latency, s; speed: sigma of a new track's velocity, m/s; bias of all it sees, m; detection:
    probability; drop: misses in a row that end a track; range: declared coverage, m, about `place` (None: nothing is
    declared); informs: it sends a SensorInfo."""

    name: str
    sigma: float
    q: float
    period: float = 1.0
    phase: float = 0.0
    latency: float = 0.1
    speed: float = 15.0
    bias: tuple[float, float] = (0.0, 0.0)
    detection: float = 1.0
    drop: int = 3
    range: float | None = None
    place: tuple[float, float] = (0.0, 0.0)
    informs: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """What a sensor says at `time`, s: id, target (T,), mean (T, 4), covariance (T, 4, 4), updated (T,), s."""

    time: float
    id: NDArray[np.uint64]
    target: Ints
    mean: Floats
    covariance: Floats
    updated: Floats


class Told(NamedTuple):
    """A message, when it is received, ns, and the target of each of its tracks (T,), None where nobody knows."""

    received: int
    message: SensorInfo | LocalTracks
    target: Ints | None = None


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """times (S,) of the steps, ns; truth (S, T, 2), m, NaN where a target is not there; told in the order of reception;
    cutoff: c of GOSPA and the distance within which a track is near a target, m; config of the centre."""

    name: str
    variant: str
    times: NDArray[np.int64]
    truth: Floats
    told: tuple[Told, ...]
    cutoff: float
    config: dict[str, Any] = field(default_factory=dict)
    fresh: bool = False
    delay: float = DELAY

    @property
    def sources(self) -> tuple[str, ...]:
        return tuple(sorted({one.message.source for one in self.told}))


def straight(places: Floats, velocities: Floats) -> Path:
    """Targets at `places` (T, 2) at time 0, at constant velocities (T, 2)."""

    def path(times: Floats) -> Floats:
        moved = places + times[:, None, None] * velocities
        return np.concatenate([moved, np.broadcast_to(velocities, moved.shape)], axis=2)

    return path


def grid(count: int, gap: float) -> Floats:
    """`count` places (T, 2) on a square grid about 0."""
    side = int(np.ceil(np.sqrt(count)))
    rows, columns = np.divmod(np.arange(count), side)
    centred = np.stack([columns, rows], axis=1).astype(np.float64) - (side - 1) / 2
    return gap * centred


def scan_times(sensor: Sensor, seconds: float) -> Floats:
    """Its scans up to `seconds`, s: the first after `phase`, or after a period."""
    first = sensor.phase or sensor.period
    return first + sensor.period * np.arange(int((seconds - first) / sensor.period + 1e-9) + 1, dtype=np.float64)


def flickers(rng: np.random.Generator, scans: int, number: float, area: float, life: float, drop: int) -> Floats:
    """Places (K, J, 2), NaN while it is not there, of false things uniform in a square of side `area`, m. Each is there
    for `life` scans on the average (geometric), so that a tracker that drops after `drop` misses has `number` tracks
    of them at a time."""
    before = round(6 * life) + drop
    births = rng.poisson(number / (life + drop - 1), scans + before)
    born = np.repeat(np.arange(-before, scans), births)
    ends = born + rng.geometric(1 / life, len(born))
    seen = ends > 0
    born, ends = born[seen], ends[seen]
    k = np.arange(scans)[:, None]
    there = (born <= k) & (k < ends)
    return np.where(there[..., None], rng.uniform(-area / 2, area / 2, (len(born), 2)), np.nan)


def observe(
    sensor: Sensor,
    path: Path,
    seconds: float,
    rng: np.random.Generator,
    *,
    seen: Callable[[Floats, Floats], NDArray[np.bool_]] | None = None,
    also: tuple[Floats, Ints] | None = None,
) -> list[Scan]:
    """The scans of a sensor. seen(times (K,), states (K, T, 4)) -> (K, T) says which targets it can see. also: more
    that it sees, places (K, J, 2), NaN where not there, and their targets (J,)."""
    times = scan_times(sensor, seconds)
    states = path(times)
    places, target = states[..., :2], np.arange(states.shape[1])
    if seen is not None:
        places = np.where(seen(times, states)[..., None], places, np.nan)
    if also is not None:
        places, target = np.concatenate([places, also[0]], axis=1), np.concatenate([target, also[1]])
    measured = places + np.array(sensor.bias) + sensor.sigma * rng.normal(size=places.shape)
    hit = (rng.random(places.shape[:2]) < sensor.detection) | (target == FALSE)
    measured = np.where(hit[..., None], measured, np.nan)
    tracks = filtered(times, measured, sensor.sigma, sensor.q, sensor.speed, sensor.drop, rng)
    scans = []
    for k, time in enumerate(times.tolist()):
        order = np.argsort(tracks.id[k], kind="stable")
        order = order[tracks.id[k, order] > 0]
        columns = (tracks.id, tracks.mean, tracks.covariance, tracks.updated)
        ids, mean, covariance, updated = (column[k, order] for column in columns)
        scans.append(Scan(time, ids, target[order], mean, covariance, updated))
    return scans


def told(sensor: Sensor, scans: Iterable[Scan]) -> list[Told]:
    """What the sensor publishes: its info, and each scan as complete."""
    header: dict[str, Any] = {"source": sensor.name, "epoch": 1, "origin": "simulated"}
    coverage: Coverage | None = Disk(sensor.range) if sensor.range is not None else None
    info = SensorInfo(
        **header,
        seq=0,
        sent=START,
        frame=FRAME,
        position=(*sensor.place, 0.0),
        period=sensor.period,
        motion=Motion("cv", sensor.q),
        coverage=coverage,
        detection_probability=None if coverage is None else sensor.detection,
    )
    out = [Told(START, info)] if sensor.informs else []
    for seq, scan in enumerate(scans):
        message = LocalTracks(
            **header,
            seq=seq,
            sent=ns(scan.time + sensor.latency),
            time=ns(scan.time),
            complete=True,
            space=SPACE,
            frame=FRAME,
            ids=scan.id,
            means=scan.mean,
            covariances=scan.covariance,
            updated=ns(0.0) + np.round(scan.updated * SECOND).astype(np.int64),
        )
        out.append(Told(ns(scan.time + sensor.latency), message, scan.target))
    return out


def world(
    name: str,
    variant: str,
    path: Path,
    seconds: float,
    feeds: Sequence[tuple[Sensor, Iterable[Scan]]],
    cutoff: float,
    *,
    period: float = 1.0,
    fresh: bool = False,
    **config: Any,
) -> World:
    """The world of these sources: steps every `period` s up to `seconds`, fused in `FRAME`; the rest of the config is
    the centre's own."""
    steps = period * np.arange(1, int(seconds / period + 1e-9) + 1, dtype=np.float64)
    everything = [one for sensor, scans in feeds for one in told(sensor, scans)]
    everything.sort(key=lambda one: (one.received, one.message.source, one.message.type, one.message.seq))
    times = np.array([ns(step) for step in steps.tolist()], dtype=np.int64)
    settings = {"frame": FRAME, "period": period, **config}
    return World(name, variant, times, path(steps)[..., :2], tuple(everything), cutoff, settings, fresh)
