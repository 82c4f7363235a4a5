"""What a client has to say, as data: a scenario yields `Event`s in the order of time, a runner publishes them.

No clock and no bus here, so every client can be listened to in a test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

__all__ = ["Event", "Parameter", "Scenario"]


class Event(NamedTuple):
    """One message: its time (of the scenario, int ns UTC), which publisher method says it, and with what; due: when it
    is published, where that is not its time.

    kind "info": fields of `schemas.SensorInfo`; "tracks", "intensity": of the publisher's method of that name
    without the time; "truth": of `TruthPublisher.truth` without the time.
    """

    time: int
    kind: Literal["info", "tracks", "intensity", "truth"]
    fields: dict[str, Any]
    due: int | None = None


class Parameter(NamedTuple):
    """A number the scenario stands on, and where it comes from ("chosen" where the source is silent)."""

    name: str
    value: str
    source: str


@dataclass(frozen=True, slots=True)
class Scenario:
    """A world to listen to. start: ns UTC; duration: s; origin as in the message header.

    `sensors` maps each sensor's name to what it says, given a seed; `truth` says where the objects are.
    """

    name: str
    summary: str
    start: int
    duration: float
    origin: str
    parameters: tuple[Parameter, ...]
    sensors: Mapping[str, Callable[[int], Iterator[Event]]]
    truth: Callable[[], Iterator[Event]]
