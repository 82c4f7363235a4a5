"""From queued events to sources with sound tracks: the border where every input is checked, once.

Reasons of refusal, beside those of `schemas.MessageError` (what cannot be decoded) and `schemas.FAULTS` (bad
numbers): type, muted, loop, future, old-epoch, repeat, late, space, frame, intensity, bad-info,
too-many-tracks, too-many-sources.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from fusion_service.config import CentreConfig, SourceConfig
from fusion_service.geodesy import FrameError
from fusion_service.journal import Journal
from fusion_service.sources import Source, Tracks, empty_tracks, message_tracks
from schemas import FAULTS, Entry, Frame, LocalIntensity, LocalTracks, Message, SensorInfo, check_numbers, digest

__all__ = ["Event", "Intake", "Order", "Refused", "SourceFound", "SourceLost"]

MAX_SOURCES = 1000
MAX_TRACKS = 20_000
MAX_PERIOD = 1e5


@dataclass(frozen=True, slots=True)
class SourceFound:
    """The source's liveliness token is there."""

    source: str


@dataclass(frozen=True, slots=True)
class SourceLost:
    """The source's liveliness token is gone: its tracks live on until they are stale."""

    source: str


@dataclass(frozen=True, slots=True)
class Order:
    """An operator's order: `mute` or `unmute` a source, `delete` a global track."""

    what: str
    source: str = ""
    track: int | None = None


@dataclass(frozen=True, slots=True)
class Refused:
    """Something refused, or `dropped` from a full queue, before it came here: to be counted and logged."""

    source: str
    reason: str
    count: int = 0
    dropped: bool = False


Event: TypeAlias = Message | SourceFound | SourceLost | Order | Refused
_Queued: TypeAlias = tuple[Event, int]


class Intake:
    """The queue before the step, and the sources behind it."""

    def __init__(self, config: CentreConfig) -> None:
        self.config = config
        self.frame: Frame | None = config.frame
        self.sources: dict[str, Source] = {}
        self._queue: list[_Queued] = []
        self._held: Counter[str] = Counter()

    def put(self, event: Event, received: int) -> None:
        """Queue an event; beyond `max_pending` messages of one source the new one is dropped and counted."""
        name = getattr(event, "source", "")
        if self._held[name] >= self.config.max_pending and isinstance(event, (LocalTracks, LocalIntensity, SensorInfo)):
            event = Refused(name, "pending", 1, dropped=True)
        else:
            self._held[name] += 1
        self._queue.append((event, received))

    def pending(self) -> int:
        """Events queued."""
        return len(self._queue)

    def names(self) -> tuple[str, ...]:
        """All sources, sorted."""
        return tuple(sorted(self.sources))

    def nothing(self) -> Tracks:
        """No tracks, in the centre's space."""
        return empty_tracks(len(self.config.space))

    def declared(self, source: Source) -> SourceConfig:
        """What holds for a source: its own word, else the config's; with `override` the other way round."""
        said = self.config.source(source.name)
        if source.info is None or said.override:
            return said
        info = source.info
        return replace(said, period=info.period, motion=info.motion, may_start=info.may_start)

    def ready(self, source: Source) -> bool:
        """Whether its tracks may be used: it has said what it is, or had a step's time to do so."""
        return source.info is not None or source.waited > 0 or self.config.source(source.name).override

    def admit(self, time: int, last: int, journal: Journal) -> list[Order]:
        """Take all that is queued up to `time`, in canonical order; later messages stay. Returns the orders.

        last: time of the last step, or -1.
        """
        queue, self._queue = self._queue, []
        self._held.clear()
        for source in self.sources.values():
            source.waited += len(source.tracks.id) > 0 and source.info is None
        messages: list[tuple[tuple[str, int, int, str, int], Message, int]] = []
        orders: list[Order] = []
        for event, received in queue:
            if isinstance(event, (SourceFound, SourceLost)):
                self._presence(event, journal)
            elif isinstance(event, Order):
                orders.append(event)
            elif isinstance(event, Refused):
                entry = Entry(event.source, 0, 0, 0, event.reason, event.count)
                (journal.drop if event.dropped else journal.refuse)(entry)
            elif self._is_later(event, time, received):
                self._held[event.source] += 1
                self._queue.append((event, received))
            else:
                key = (event.source, event.epoch, event.seq, event.type, digest(event))
                messages.append((key, event, received))
        for order in orders:
            self._order(order, journal)
        messages.sort(key=lambda item: item[0])
        self._take(messages, last, journal)
        return orders

    def _is_later(self, event: Message, time: int, received: int) -> bool:
        return isinstance(event, (LocalTracks, LocalIntensity)) and time < event.time <= self._horizon(received)

    def _horizon(self, received: int) -> int:
        return received + round(self.config.max_future * 1e9)

    def _presence(self, event: SourceFound | SourceLost, journal: Journal) -> None:
        found = isinstance(event, SourceFound)
        source = self._source(event.source)
        if source is None:
            journal.refuse(Entry(event.source, 0, 0, 0, "too-many-sources"))
        elif source.alive is not found:
            source.alive = found
            journal.event({"kind": "found" if found else "lost", "source": event.source})

    def _order(self, order: Order, journal: Journal) -> None:
        journal.event({"kind": "order", "what": order.what, "source": order.source, "track": order.track})
        if order.what in ("mute", "unmute"):
            source = self._source(order.source)
            if source is not None:
                source.muted = order.what == "mute"

    def _source(self, name: str) -> Source | None:
        if name not in self.sources:
            if len(self.sources) >= MAX_SOURCES:
                dead = [s for s in self.sources.values() if s.alive is not True and not len(s.tracks.id)]
                if not dead:
                    return None
                del self.sources[min(dead, key=lambda s: (s.last, s.name)).name]
            self.sources[name] = Source(name, self.config.space, self.nothing())
            self.sources[name].muted = self.config.source(name).ignore
        return self.sources[name]

    def _take(
        self, messages: list[tuple[tuple[str, int, int, str, int], Message, int]], last: int, journal: Journal
    ) -> None:
        tracks: list[tuple[Source, LocalTracks, Entry]] = []
        for (name, epoch, seq, kind, code), message, received in messages:
            entry = Entry(name, epoch, seq, code)
            source = self._source(name)
            reason = "too-many-sources" if source is None else self._fault(source, message, code, last, received)
            if source is None or reason:
                journal.refuse(replace(entry, reason=reason))
                if source is not None and reason == "repeat":
                    source.repeats += 1
                continue
            if epoch > source.epoch:
                if source.epoch >= 0:
                    journal.event({"kind": "restarted", "source": name, "epoch": epoch})
                    tracks = [item for item in tracks if item[0] is not source]
                source.begin(epoch)
            source.note(kind, seq, code)
            source.origin = message.origin
            journal.take(entry)
            if isinstance(message, SensorInfo):
                if source.info is None or seq > source.info.seq:
                    source.info = message
            elif isinstance(message, LocalTracks):
                source.offset = received - message.time
                tracks.append((source, message, entry))
        self._apply(tracks, journal)

    def _fault(self, source: Source, message: Message, code: int, last: int, received: int) -> str:
        if not isinstance(message, (LocalTracks, LocalIntensity, SensorInfo)):
            return "type"
        if source.muted:
            return "muted"
        if self.config.name in (message.lineage or ()) or message.source == self.config.name:
            return "loop"
        time = getattr(message, "time", -1)
        if max(message.epoch, time) > self._horizon(received):
            return "future"
        if message.epoch < source.epoch:
            return "old-epoch"
        if message.epoch == source.epoch and source.is_repeat(message.type, message.seq, code):
            return "repeat"
        if isinstance(message, SensorInfo):
            return "" if _sound(message) else "bad-info"
        if last >= 0 and time < last - round(self.config.lateness * 1e9):
            return "late"
        if not set(self.config.space) <= set(message.space):
            return "space"
        if isinstance(message, LocalIntensity):
            return "intensity"
        return "too-many-tracks" if len(message.ids) > MAX_TRACKS else ""

    def _apply(self, items: list[tuple[Source, LocalTracks, Entry]], journal: Journal) -> None:
        for (source, message, entry), faults in zip(items, check_numbers([item[1] for item in items]), strict=True):
            for code in np.unique(faults[faults > 0]).tolist():
                journal.refuse(replace(entry, reason=FAULTS[code], count=int((faults == code).sum())))
            if self.frame is None:
                self.frame = message.frame
            try:
                new = message_tracks(message, faults == 0, self.frame, self.declared(source).height)
            except FrameError:
                journal.refuse(replace(entry, reason="frame", count=len(message.ids)))
                continue
            if len(source.tracks.id) + len(new.id) > 2 * MAX_TRACKS:
                journal.refuse(replace(entry, reason="too-many-tracks", count=len(message.ids)))
                continue
            source.apply(message, new)


def _sound(info: SensorInfo) -> bool:
    p, covariance = info.detection_probability, info.position_covariance
    return (
        0 < info.period <= MAX_PERIOD
        and 0 <= info.initiation_delay <= MAX_PERIOD
        and (p is None or 0 <= p <= 1)
        and all(math.isfinite(part) for part in info.position)
        and (covariance is None or bool(np.isfinite(covariance).all()))
    )
