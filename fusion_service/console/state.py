"""`State`: all that the console knows, written by the thread that listens to the bus, read by those that serve pages.

Every call holds one lock for as long as it takes, which is short: pictures are made into bytes once, when they come.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from fusion_service.console.explaining import explained
from fusion_service.console.health import Alarms, health
from fusion_service.console.histories import Histories
from fusion_service.console.packing import text
from fusion_service.console.pictures import Pictures
from fusion_service.console.places import source_place
from schemas import GlobalTracks, Message, SensorInfo, Status, StepLog

__all__ = ["Seen", "State"]

MOST_CENTRES = 8
MOST_PLACES = 500
STALE = 3.0
"""Seconds after which a picture is stale, where the centre's own pace does not say more."""
PACE = 4.0
"""Or so many times the usual time between two."""


class Seen(NamedTuple):
    """What a page has: of which centre, up to which version of picture, health, places and line of the log; the track
    that it asks for, and up to which version it has that."""

    centre: str = ""
    picture: int = -1
    health: int = -1
    places: int = -1
    line: int = 0
    track: int | None = None
    explained: tuple[int, int] = (-1, -1)


class _Centre:
    """What is known of a centre."""

    def __init__(self) -> None:
        self.pictures = Pictures()
        self.histories = Histories(self.pictures.label)
        self.alarms = Alarms()
        self.alive: bool | None = None
        self.health = ""
        self.checked = 0
        self.told = 0.0
        self.steps = 0


class State:
    """clock: monotonic seconds; wall: ns."""

    def __init__(self, clock: Callable[[], float] = time.monotonic, wall: Callable[[], int] = time.time_ns) -> None:
        self._clock, self._wall = clock, wall
        self._lock = threading.Lock()
        self._centres: dict[str, _Centre] = {}
        self._places: dict[str, dict[str, Any] | None] = {}
        self._placed = 0
        self._hub = False
        self._trouble = ""

    # What the bus brings

    def take(self, message: Message) -> None:
        """A message of a centre, or what a source says of itself."""
        with self._lock:
            if isinstance(message, SensorInfo):
                self._place(message)
                return
            centre = self._centre(message.source)
            if centre is None:
                return
            if isinstance(message, GlobalTracks):
                if centre.pictures.take(message, self._clock()):
                    centre.histories.picture(message)
            elif isinstance(message, StepLog):
                centre.histories.step(message)
                centre.steps += 1
            elif isinstance(message, Status):
                said = health(message, centre.pictures.whole, self._wall(), centre.alarms, centre.pictures.label)
                centre.health, centre.told = text(said), self._clock()
                centre.checked += 1

    def alive(self, name: str, there: bool) -> None:
        """The token of a centre came or went."""
        with self._lock:
            if (centre := self._centre(name)) is not None and centre.alive != there:
                if centre.alive is not None or there:
                    said = "is on the bus" if there else "has left the bus"
                    centre.histories.say(self._wall() // 10**6, "console", f"centre {name} {said}", not there)
                centre.alive = there
                if not there:
                    centre.pictures.interrupted()

    def hub(self, there: bool, trouble: str = "") -> None:
        """Whether the hub is there, and what is wrong if not."""
        with self._lock:
            if there != self._hub:
                for centre in self._centres.values():
                    centre.pictures.interrupted()
                    said = "the hub is back" if there else "the hub is away"
                    centre.histories.say(self._wall() // 10**6, "console", said, not there)
            self._hub, self._trouble = there, trouble[:200]

    def say(self, centre: str, words: str, bad: bool = False) -> None:
        """A line of the console's own in the log of a centre."""
        with self._lock:
            if centre in self._centres:
                self._centres[centre].histories.say(self._wall() // 10**6, "console", words, bad)

    def _centre(self, name: str) -> _Centre | None:
        if name not in self._centres and len(self._centres) < MOST_CENTRES:
            self._centres[name] = _Centre()
        return self._centres.get(name)

    def _place(self, info: SensorInfo) -> None:
        place = source_place(info)
        room = info.source in self._places or len(self._places) < MOST_PLACES
        if room and self._places.get(info.source, ()) != place:
            self._places[info.source] = place
            self._placed += 1

    # What a page gets

    def names(self) -> list[str]:
        """The centres that are known."""
        with self._lock:
            return sorted(self._centres)

    def pulse(self, name: str) -> dict[str, Any]:
        """How hub and centre are at this moment; times in ms, ages in seconds."""
        with self._lock:
            now, centre = self._clock(), self._centres.get(name)
            said: dict[str, Any] = {
                "type": "pulse",
                "now": self._wall() // 10**6,
                "hub": self._hub,
                "trouble": self._trouble,
                "centres": sorted(self._centres),
                "centre": name,
            }
            if centre is None:
                return {**said, "alive": None, "age": None, "stale": True}
            pictures = centre.pictures
            age = now - pictures.received if pictures.whole is not None else None
            patience = max(STALE, PACE * pictures.interval)
            told = now - centre.told if centre.health else None
            stale = age is None or age > patience
            return {**said, "alive": centre.alive, "age": age, "told": told, "stale": stale, "patience": patience}

    def news(self, seen: Seen) -> tuple[Seen, list[str | bytes]]:
        """What a page has not seen yet, the newest of each kind alone, and what it has seen then."""
        with self._lock:
            centre = self._centres.get(seen.centre)
            if centre is None:
                return seen, []
            out: list[str | bytes] = []
            if seen.places != self._placed:
                sources = {name: place for name, place in self._places.items() if place is not None}
                out.append(text({"type": "places", "sources": sources}))
                seen = seen._replace(places=self._placed)
            pictures, histories = centre.pictures, centre.histories
            if seen.picture != pictures.version and pictures.frame:
                fresh = pictures.texts_since(seen.picture)
                if seen.picture < 0:
                    out.append(pictures.trail())
                if fresh:
                    out.append(text({"type": "texts", "tracks": fresh}))
                out.append(pictures.frame)
                seen = seen._replace(picture=pictures.version)
            if seen.health != centre.checked and centre.health:
                out.append(centre.health)
                seen = seen._replace(health=centre.checked)
            if seen.line != histories.number:
                out.append(text({"type": "log", "lines": histories.since(seen.line)}))
                seen = seen._replace(line=histories.number)
            at = pictures.version, centre.steps
            if seen.track is not None and seen.explained != at:
                out.append(text(explained(seen.track, pictures, histories)))
                seen = seen._replace(explained=at)
            return seen, out
