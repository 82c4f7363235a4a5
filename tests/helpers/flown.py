"""Missions flown in this process by the real centre, and recorded by the real recorder: what a test says, each step."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from signal import SIGTERM
from typing import Any

import numpy as np

import schemas
from fusion_service.centre import FusionCentre, IntensityCentre, Order, SourceFound, SourceLost, StepResult
from fusion_service.config import centre_config
from fusion_service.recording import RawMessage, Recorder, read
from fusion_service.review.replay import Replay, run_replay
from tests.centre.worlds import SECOND, START, info, moved, seen, tracks, truth

SOURCES = ("r1", "r2", "r3")
REALM = "sea"

__all__ = [
    "REALM",
    "SIGTERM",
    "SOURCES",
    "Flight",
    "edited",
    "messy",
    "pictures",
    "places",
    "raws",
    "record",
    "verified",
]


class Flight:
    """A centre, and everything that crosses the bus as (key, bytes, receive time) in the order of its coming."""

    def __init__(self, config: dict[str, Any], generation: int = 7) -> None:
        self.config = centre_config(config)
        self.log: list[tuple[str, bytes, int]] = []
        self.steps: list[StepResult] = []
        self.begin(None, generation)

    def begin(self, checkpoint: bytes | None, generation: int) -> None:
        """Start the centre, anew or from a checkpoint."""
        kind = IntensityCentre if self.config.kind == "intensity" else FusionCentre
        self.centre = kind(self.config, checkpoint, generation=generation, epoch=START + generation)

    def put(self, message: schemas.Message, at: float, *, give: bool = True) -> None:
        """A message of a source or of the world, recorded, and given to the centre."""
        received = START + round(at * SECOND)
        what = {"local_tracks": "tracks", "local_intensity": "intensity", "sensor_info": "info"}.get(message.type)
        key = schemas.truth_key(message.source, REALM)
        if what is not None:
            key = schemas.local_key(message.source, what, REALM)
        elif message.type == "global_tracks":
            key = schemas.global_key(message.source, "tracks", REALM)
        if give and message.type != "truth":
            self.centre.handle(message, received)
        self.log.append((key, schemas.encode(message), received))

    def step(self, at: float) -> StepResult:
        """A step, published as the service does."""
        result = self.centre.step(START + round(at * SECOND))
        received = START + round((at + 0.2) * SECOND)
        for what, part in (("tracks", result.tracks), ("log", result.log)):
            data = schemas.encode(dataclasses.replace(part, sent=received))
            self.log.append((schemas.global_key(self.config.name, what, REALM), data, received))
        self.steps.append(result)
        return result

    def record(self, path: Path, *, draw: bool = False) -> Path:
        return record(path, self.log, draw=draw)


def record(path: Path, log: Iterable[tuple[str, bytes, int]], *, draw: bool = False) -> Path:
    with Recorder(path, realm=REALM, draw=draw) as recorder:
        for number, (key, data, received) in enumerate(log):
            recorder.handle(key, data, received)
            if number % 100 == 99:
                recorder.tick()
    return path


def raws(path: Path) -> list[RawMessage]:
    return list(read(path))


def verified(path: Path, **asked: Any) -> Replay:
    """What comes of making a recording again as it was."""
    return run_replay(path, verify=True, say=lambda line: None, **asked)


def pictures(path: Path, centre: str) -> list[schemas.GlobalTracks]:
    """The recorded pictures of a centre, as they came."""
    key = schemas.global_key(centre, "tracks", REALM)
    return [schemas.decode(raw.data) for raw in raws(path) if raw.key == key]  # type: ignore[misc]


def edited(log: Sequence[tuple[str, bytes, int]], change: Callable[[Any], Any]) -> list[tuple[str, bytes, int]]:
    """The log with every message replaced by what `change` makes of it; None leaves it out."""
    out = []
    for key, data, received in log:
        message = change(schemas.decode(data))
        if message is not None:
            out.append((key, schemas.encode(message), received))
    return out


def messy(config: dict[str, Any], *, steps: int = 14, targets: int = 8, seed: int = 11) -> Flight:
    """Late, lost, repeated and bad messages, restarts of a source and of the centre, tokens, orders."""
    flight = Flight({"lateness": 2.0, "coast": 2.0, **config})
    rng, states = np.random.default_rng(seed), truth(targets)
    epochs = dict.fromkeys(SOURCES, 1)
    told: set[tuple[str, int]] = set()
    late: list[Any] = []
    for second in range(1, steps + 1):
        for message in late:
            flight.centre.handle(message, START + second * SECOND)
        late = []
        if second == 6:
            epochs["r2"] = 2
        for name, epoch in epochs.items():
            if rng.random() < 0.1:
                continue
            chosen = rng.permutation(targets)[: rng.integers(targets - 3, targets + 1)]
            at = second - 0.25 * int(rng.integers(0, 3))
            message = tracks(
                name, at, seen(moved(states, at), rng)[chosen], chosen + 1, seq=second, epoch=epoch,
                complete=bool(rng.random() < 0.7),
            )  # fmt: skip
            if rng.random() < 0.1:
                message.means[0, 0] = np.nan
            if (name, epoch) not in told and second > 1:
                told.add((name, epoch))
                flight.put(info(name, epoch=epoch), second - 0.01)
            waits = rng.random() < 0.15
            flight.put(message, second, give=not waits)
            late += [message] if waits else []
            if rng.random() < 0.1:
                flight.centre.handle(message, START + second * SECOND)
        if second == 3:
            flight.centre.handle(SourceFound("r1"), START)
        if second == 8:
            flight.centre.handle(SourceLost("r1"), START)
            flight.centre.handle(Order("mute", "r3"), START)
        if second == 10:
            flight.centre.handle(Order("unmute", "r3"), START)
            flight.begin(flight.centre.checkpoint(), 9)
        flight.step(second)
    return flight


def places(
    flight: Flight,
    seconds: Sequence[float],
    seen_by: Callable[[str, float], dict[int, Sequence[float]]],
    judging: Sequence[str] = (),
) -> None:
    """Fly: at each second every source lists the tracks that `seen_by(source, second)` gives, by id, as (x, y), with
    a standard deviation of 30 m; the truth of target 1 stands at (0, 0). judging: sources that report existence."""
    for name in SOURCES:
        flight.put(info(name), seconds[0] - 0.5)
    for second in seconds:
        world = schemas.Truth(
            source="world", epoch=1, seq=round(second), sent=START, time=START + round(second * SECOND),
            space=("x", "y"), frame=tracks("r1", 0, []).frame, ids=np.array([1, 2], dtype=np.uint64),
            means=np.array([[0.0, 0.0], [50_000.0, 0.0]]),
        )  # fmt: skip
        flight.put(world, second)
        for name in SOURCES:
            listed = seen_by(name, second)
            rows = [[*map(float, place), 0.0, 0.0] for place in listed.values()]
            judged = np.full(len(listed), 0.95) if name in judging else None
            scan = tracks(name, second, np.array(rows).reshape(-1, 4), list(listed), existence=judged)
            flight.put(scan, second + 0.05)
        flight.step(second)
