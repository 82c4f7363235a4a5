"""Whether a process is alive, and ready: by what it tells its service manager, or by what is heard of it on the bus.

Alive is what does not need to be started anew. Ready is a service that has joined the bus and steps while sources are
there, and one that stands by in step with the active one. Each answer is "" for yes, or why not.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from fusion_service.monitoring.figures import Sample, status_samples
from schemas import MessageError, Status, decode

__all__ = ["MOST_CENTRES", "Heard", "Links", "Pulse", "Recorded"]

BEAT = 60.0
"""Seconds without a beat of the watchdog after which a process is not alive."""
STALLED = 60.0
"""Seconds without a new step, while sources are there, after which a service is not ready."""
OLD = 10.0
"""Seconds after which what was heard of a centre is old."""
FORGOTTEN = 600.0
"""Seconds after which a centre of which nothing was heard is not told any more."""
MOST_CENTRES = 20


class Pulse:
    """Of this process, by what its service manager is told (`told`, on any thread). joined: whether it has the bus."""

    def __init__(self, joined: Callable[[], bool] = lambda: True, clock: Callable[[], float] = time.monotonic) -> None:
        self.status: Status | None = None
        self._joined, self._clock = joined, clock
        self._lock = threading.Lock()
        self._begun = self._stopping = False
        self._beaten = self._stepped = clock()
        self._step = -1
        self._words = ""

    def told(self, state: str, status: Status | None = None) -> None:
        """Take what the service manager is told."""
        lines, now = state.split("\n"), self._clock()
        with self._lock:
            self._begun = self._begun or "READY=1" in lines
            self._stopping = self._stopping or "STOPPING=1" in lines
            if "WATCHDOG=1" in lines or "READY=1" in lines:
                self._beaten = now
            self._words = next((line[7:] for line in lines if line.startswith("STATUS=")), self._words)
            if status is not None:
                self.status = status
                if status.step != self._step:
                    self._step, self._stepped = status.step, now

    def samples(self) -> Iterator[Sample]:
        """The figures of the newest status."""
        if (status := self.status) is not None:
            yield from status_samples(status)

    def alive(self) -> str:
        """Why it must be started anew, or "". A process that waits for the hub is alive."""
        with self._lock:
            silent = self._clock() - self._beaten
            return f"no beat for {silent:.0f} s" if self._begun and silent > BEAT else ""

    def begun(self) -> str:
        """Why it does not work yet, or any more, or ""."""
        with self._lock:
            return "it stops" if self._stopping else "" if self._begun else "it begins"

    def ready(self) -> str:
        """Why a service is not ready, or ""."""
        if fault := self.alive():
            return fault
        with self._lock:
            if self._stopping:
                return "it stops"
            if not self._begun:
                return "it begins, or waits for the hub"
            if not self._joined():
                return "the hub is away"
            if self._words.startswith("standing by"):
                return "" if self._words.startswith("standing by: at step") else self._words
            if self.status is None:
                return "no status yet"
            return _not_stepping(self.status, self._clock() - self._stepped)


def _not_stepping(status: Status, since: float) -> str:
    """Why a service with sources that are there makes no pictures, or "". since: seconds since a new step."""
    there = sum(said.get("alive") is True and said.get("stale") is not True for said in status.sources.values())
    if not there:
        return ""
    if status.step == 0:
        return f"no picture yet of {there} sources"
    return f"no step for {since:.0f} s, of {there} sources" if since > STALLED else ""


class _One(NamedTuple):
    status: Status
    heard: float


class Heard:
    """Centres on the bus, by their statuses (`take`, on any thread): of `MOST_CENTRES` at most."""

    def __init__(self, joined: Callable[[], bool] = lambda: True, clock: Callable[[], float] = time.monotonic) -> None:
        self._joined, self._clock = joined, clock
        self._lock = threading.Lock()
        self._centres: dict[str, _One] = {}

    def take(self, key: str, data: bytes) -> None:
        """A message on the key of a status."""
        try:
            message = decode(data)
        except MessageError:
            return
        if not isinstance(message, Status) or f"/{message.source}/status" not in key:
            return
        now = self._clock()
        with self._lock:
            for name in [name for name, one in self._centres.items() if now - one.heard > FORGOTTEN]:
                del self._centres[name]
            if message.source in self._centres or len(self._centres) < MOST_CENTRES:
                self._centres[message.source] = _One(message, now)

    @property
    def statuses(self) -> list[Status]:
        """The newest of each centre, by name."""
        now = self._clock()
        with self._lock:
            return [one.status for _, one in sorted(self._centres.items()) if now - one.heard <= FORGOTTEN]

    def samples(self) -> Iterator[Sample]:
        """The figures of all, each in one family."""
        for status in self.statuses:
            yield from status_samples(status)

    def ready(self) -> str:
        """Why there is nothing to be told, or ""."""
        if not self._joined():
            return "the hub is away"
        with self._lock:
            newest = max((one.heard for one in self._centres.values()), default=None)
        if newest is None:
            return "no centre was heard yet"
        age = self._clock() - newest
        return f"no centre was heard for {age:.0f} s" if age > OLD else ""


class Links:
    """Connections of a hub (`change`, on a thread of the bus)."""

    def __init__(self) -> None:
        self._there = self._opened = 0

    def change(self, common: str, where: str, there: bool) -> None:
        """One has come or gone."""
        self._there += 1 if there else -1
        self._opened += there

    def samples(self) -> Iterator[Sample]:
        """How many there are, and were."""
        yield Sample("fusion_hub_links", (), float(self._there))
        yield Sample("fusion_hub_links_opened_total", (), float(self._opened))


class Recorded:
    """What a recorder has written, by its ticks (`tick`, on its thread)."""

    def __init__(self) -> None:
        self._samples: tuple[Sample, ...] = ()

    def tick(self, samples: Iterable[Sample], path: Path) -> None:
        """A tick is done, whose file is `path`."""
        free, size = shutil.disk_usage(path.parent).free, path.stat().st_size
        self._samples = (
            *samples,
            Sample("fusion_recorder_part_bytes", (), float(size)),
            Sample("fusion_recorder_disk_free_bytes", (), float(free)),
            Sample("fusion_recorder_tick_timestamp_seconds", (), time.time()),
        )

    def samples(self) -> tuple[Sample, ...]:
        """Of the newest tick."""
        return self._samples
