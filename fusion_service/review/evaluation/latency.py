"""Delays of the messages of a mission that is no replay, each kind where most messages show less than `SAME_CLOCK`:
a mission played at another time or pace has its own clock.

    bus        from `sent` to the recorder's `received`
    source     from the time of the tracks to `sent`;  centre: the same of pictures
    reaction   from the reception of the last message that a step took to that of its picture
"""

from __future__ import annotations

from array import array
from typing import NamedTuple, TypeVar

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.review.snapshots import TrackMessage
from schemas import GlobalTracks, LocalIntensity, SensorInfo, StepLog, digest

__all__ = ["BINS", "Delays", "Latency"]

StepKey = tuple[str, int, int]
Name = TypeVar("Name")
Value = TypeVar("Value")

SAME_CLOCK = 3600.0
MOST_REMEMBERED = 20_000
"""Receptions remembered until the log of their step comes."""
BINS = 40


class Latency(NamedTuple):
    """n delays, s; counts (BINS,) of a histogram between `edges` (BINS + 1,)."""

    n: int
    median: float
    p95: float
    largest: float
    counts: tuple[int, ...]
    edges: tuple[float, ...]


class Delays:
    """Gathers delays by (kind, name) as messages come; received: by the recorder, ns, None where it is not known."""

    def __init__(self) -> None:
        self._delays: dict[tuple[str, str], array[float]] = {}
        self._came: dict[StepKey, int] = {}
        self._infos_came: dict[int, int] = {}
        """By digest: every type of a source's messages has sequence numbers of its own."""
        self._steps: dict[StepKey, tuple[int | None, int | None]] = {}

    def info(self, message: SensorInfo, received: int | None) -> None:
        """A source's info."""
        if received is not None:
            _remember(self._infos_came, digest(message), received)

    def densities(self, message: TrackMessage | LocalIntensity, received: int | None) -> None:
        """Tracks, an intensity or a picture."""
        name, picture = message.source, isinstance(message, GlobalTracks)
        if _by_a_clock(message):
            self._add("centre" if picture else "source", name, message.sent - message.time)
            if received is not None:
                self._add("bus", name, received - message.sent)
        if received is None:
            return
        if not isinstance(message, GlobalTracks):
            _remember(self._came, (name, message.epoch, message.seq), received)
        elif _by_a_clock(message):
            self._react((name, message.epoch, message.step), picture=received)

    def log(self, message: StepLog) -> None:
        """A step log: what it took has come."""
        came = [
            self._infos_came.get(one.hash) or self._came.get((one.source, one.epoch, one.seq)) for one in message.taken
        ]
        newest = max((time for time in came if time is not None), default=None)
        if newest is not None:
            self._react((message.source, message.epoch, message.step), taken=newest)

    def result(self) -> dict[tuple[str, str], Latency]:
        """When all messages have come."""
        values = {key: np.frombuffer(delays, dtype=np.float64) for key, delays in self._delays.items()}
        return {key: _latency(some) for key, some in values.items() if abs(float(np.median(some))) < SAME_CLOCK}

    def _react(self, step: StepKey, picture: int | None = None, taken: int | None = None) -> None:
        """Picture and log of a step come one after the other, in either order."""
        other = self._steps.pop(step, None)
        if other is None:
            _remember(self._steps, step, (picture, taken))
            return
        picture, taken = picture or other[0], taken or other[1]
        if picture is not None and taken is not None:
            self._add("reaction", step[0], picture - taken)

    def _add(self, kind: str, name: str, delay: int) -> None:
        self._delays.setdefault((kind, name), array("d")).append(delay / 1e9)


def _by_a_clock(message: TrackMessage | LocalIntensity) -> bool:
    """Whether `sent` is of a clock: a centre that only replays a mission has none, and says the time of the step."""
    return not (isinstance(message, GlobalTracks) and message.sent == message.time)


def _remember(known: dict[Name, Value], name: Name, value: Value) -> None:
    """The newest so many; what has waited longest for what belongs to it is forgotten."""
    known[name] = value
    if len(known) > MOST_REMEMBERED:
        del known[next(iter(known))]


def _latency(delays: Floats) -> Latency:
    median, p95 = np.quantile(delays, (0.5, 0.95)).tolist()
    top = max(float(np.quantile(delays, 0.99)), float(delays.min()) + 1e-6)
    counts, edges = np.histogram(np.minimum(delays, top), bins=BINS)
    return Latency(
        len(delays), median, p95, float(delays.max()), tuple(counts.tolist()), tuple(float(edge) for edge in edges)
    )
