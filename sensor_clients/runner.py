"""Publishing a scenario at its pace: an event of scenario time t is due at start_at + (t - t0) / speed.

What is late is published at once, in order, so a client that started late or was held up catches up.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable

from sensor_clients.events import Event
from sensor_clients.publisher import TrackPublisher, TruthPublisher

__all__ = ["pace"]


def pace(
    events: Iterable[Event],
    publisher: TrackPublisher | TruthPublisher,
    *,
    start: int,
    start_at: float,
    speed: float,
    stop: threading.Event,
    clock: Callable[[], float] = time.time,
) -> int:
    """Publish `events` with `publisher` (a `TrackPublisher` or `TruthPublisher`); returns how many it was.

    start: scenario time t0, ns; start_at: wall clock of t0, Unix seconds; speed: scenario seconds per second.
    Ends early, within a wait, once `stop` is set. `clock` gives Unix seconds.
    """
    published = 0
    for event in events:
        time_due = event.time if event.due is None else event.due
        due = start_at + (time_due - start) * 1e-9 / speed
        while not stop.is_set() and (wait := due - clock()) > 0:
            stop.wait(min(wait, 1.0))
        if stop.is_set():
            break
        if isinstance(publisher, TruthPublisher):
            publisher.truth(time=event.time, **event.fields)
        elif event.kind == "info":
            publisher.info(**event.fields)
        elif event.kind == "intensity":
            publisher.intensity(time=event.time, **event.fields)
        else:
            publisher.tracks(time=event.time, **event.fields)
        published += 1
    return published
