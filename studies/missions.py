"""Whole missions without bus or clock: a scenario's events as messages, through `FusionCentre`, to pictures.

It is the way of the running service: messages go through the codec, as off the bus, in the order of their time; steps
are those of the message clock, and end when the last message has been heard.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from operator import attrgetter
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.clock import MessageClock
from fusion_service.metrics import gospa, nees
from schemas import GlobalTracks, LocalTracks, SensorInfo, Truth
from sensor_clients.events import Event, Scenario

__all__ = ["Told", "as_messages", "follow", "fuse", "told", "truths"]

Floats = NDArray[np.float64]

Told: TypeAlias = SensorInfo | LocalTracks
KINDS: dict[str, type[Any]] = {"info": SensorInfo, "tracks": LocalTracks, "truth": Truth}


def as_messages(source: str, events: Iterable[Event], origin: str) -> Iterator[Any]:
    """What a client publishes of its events, as it comes off the bus."""
    for seq, event in enumerate(events):
        when = {} if event.kind == "info" else {"time": event.time}
        header = {"source": source, "epoch": 1, "seq": seq, "sent": event.time, "origin": origin}
        yield schemas.decode(schemas.encode(KINDS[event.kind](**header, **when, **event.fields)))


def told(scenario: Scenario, seed: int, sensors: Sequence[str] | None = None) -> list[Told]:
    """All that the sensors of a scenario (by default all of them) say, in the order of time."""
    names = scenario.sensors if sensors is None else sensors
    each = [as_messages(name, scenario.sensors[name](seed), scenario.origin) for name in names]
    return list(heapq.merge(*each, key=attrgetter("sent")))


def truths(scenario: Scenario) -> list[Truth]:
    """The truth of a scenario."""
    return list(as_messages(scenario.name.replace(":", "-"), scenario.truth(), scenario.origin))


def fuse(messages: Sequence[Told], config: Mapping[str, Any]) -> list[GlobalTracks]:
    """The pictures of a centre of this config that hears `messages`, which come in the order of time, of sources that
    are there from the beginning."""
    centre = FusionCentre({"clock": "message", **config})
    clock = MessageClock(centre.config)
    pictures: list[GlobalTracks] = []

    def steps() -> None:
        while (time := clock.due()) is not None:
            pictures.append(centre.step(time).tracks)

    sources = {message.source for message in messages}
    for source in sources:
        clock.presence(source, True)
    for message in messages:
        centre.handle(message, message.sent)
        if isinstance(message, LocalTracks):
            clock.observe(message.source, message.epoch, message.time)
            steps()
    for source in sources:
        clock.presence(source, False)
    steps()
    return pictures


def follow(truth: Floats, means: Floats, covariances: Floats, c: float) -> Floats:
    """How well tracks, means (G, n) and covariances (G, n, n), follow targets at `truth` (T, n), x and y first, m:
    (2, T), squared error of position, m2, and NEES over n; NaN for a target that GOSPA, cut off at `c` m, gives none.
    """
    n = truth.shape[1]
    track = gospa(truth[:, :2], means[:, :2], c).assignment
    seen = track >= 0
    error = means[track[seen]] - truth[seen]
    scores = np.full((2, len(truth)), np.nan)
    scores[:, seen] = (error[:, :2] ** 2).sum(axis=1), nees(error, covariances[track[seen]]) / n
    return scores
