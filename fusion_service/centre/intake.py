"""From queued events to sources with sound tracks: the border where every input is checked, once.

An intensity stands in its source's table as a complete scan: a track per component, its weight as existence.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import groupby
from typing import TypeAlias

import numpy as np

from fusion_service.centre import limits, notes
from fusion_service.centre.ahead import Ahead
from fusion_service.centre.batches import Checked, framed, run_key
from fusion_service.centre.clock import horizon
from fusion_service.centre.converting import Conversion
from fusion_service.centre.declared import declared_by, motion_declared, pace_of, sensor_of
from fusion_service.centre.era import ClockSet, NewEra, rebase_sources
from fusion_service.centre.events import Event, Refused, Skipped, SourceFound, SourceLost
from fusion_service.centre.frames import FrameVoting, Vote, may_be_picture, name_frame
from fusion_service.centre.intervals import Pace, silence_of
from fusion_service.centre.journal import Journal
from fusion_service.centre.lineage import Lineages
from fusion_service.centre.orders import Orders
from fusion_service.centre.pictures import as_scan, is_picture_of, source_of
from fusion_service.centre.refusing import fault
from fusion_service.centre.resting import Resting, gone
from fusion_service.centre.scans import Scan, as_tracks, size_of
from fusion_service.centre.sources import Source
from fusion_service.centre.spared import Spared
from fusion_service.centre.sparing import affordable
from fusion_service.centre.tracks import Tracks, empty_tracks
from fusion_service.centre.treatment import AS_IT_IS, Treatment
from fusion_service.centre.words import Lexicon, Words
from fusion_service.config import CentreConfig, SourceConfig
from fusion_service.geodesy import FrameError
from fusion_service.order import Order
from schemas import (
    FAULTS,
    Entry,
    Frame,
    GlobalTracks,
    LocalIntensity,
    LocalTracks,
    Message,
    MessageError,
    Motion,
    SensorInfo,
    check_source,
)

__all__ = ["Intake"]

_Queued: TypeAlias = tuple[Message, int]
_Keyed: TypeAlias = tuple[tuple[str, int, int, str, int, int], Message]


class Intake:
    """The queue before the step, and the sources behind it. Everything in it is bounded, whatever is sent."""

    def __init__(self, config: CentreConfig, ahead: Ahead | None = None) -> None:
        self.config = config
        self._nothing = empty_tracks(len(config.space))
        self.frame: Frame | None = config.frame
        self.voting = FrameVoting()
        self.reframed = False
        self.sources: dict[str, Source] = {}
        self.resting: dict[str, Resting] = {}
        self.queue: list[_Queued] = []
        self.ahead = ahead or Ahead()
        self.raw: dict[tuple[str, int, int, int], tuple[Message, int, int]] = {}
        self._held: Counter[str] = Counter()
        self._components = 0
        self.orders = Orders()
        self.said = Lexicon(Words(), Words())
        self.lineages = Lineages()
        self.treatments: dict[str, Treatment] = {}
        self._given: list[Order] = []
        self._present: dict[str, bool] = {}
        self._refused: Counter[tuple[str, str, bool]] = Counter()
        self.spared = Spared(config)
        self._dead: list[str] | None = None

    def put(self, event: Event, received: int) -> None:
        """Queue an event, but not one of the clock; messages beyond `max_pending` of one source, or `MAX_QUEUED` or
        `MAX_COMPONENTS` of all together, are dropped and counted."""
        if isinstance(event, (SourceFound, SourceLost)):
            self.wake(event.source)
            if event.source in self._present or len(self._present) < 2 * limits.MAX_SOURCES:
                self._present[event.source] = isinstance(event, SourceFound)
        elif isinstance(event, Order):
            self.wake(event.source or "")
            if len(self._given) < limits.MAX_ORDERS:
                self._given.append(event)
        elif isinstance(event, Refused):
            self._count(event.source, event.reason, max(event.count, 1), event.dropped)
        elif isinstance(event, (ClockSet, NewEra, Skipped)):
            self.spared.sleep(event)
        elif self._is_full(event):
            self._count(source_of(event), "pending", 1, dropped=True)
        else:
            self.hold(event, received)

    def hold(self, event: Message, received: int) -> None:
        """Queue a message, whatever there is."""
        self.wake(source_of(event))
        self.queue.append((event, received))
        self.ahead.make(event, self)
        self._held[source_of(event)] += 1
        self._components += size_of(event)

    def emptied(self) -> list[_Queued]:
        """The messages that are queued, which are so no more."""
        queue, self.queue, self._components = self.queue, [], 0
        self._held.clear()
        return queue

    def succeed(self, other: Intake) -> None:
        """Take over what is queued in `other` beside messages."""
        self._given, self._present, self._refused = other._given, other._present, other._refused
        self.spared.slept_as(other.spared)

    def wake(self, name: str) -> None:
        """Something is said by, or of, a source that may rest (see `resting`): it does no more."""
        if name in self.resting:
            one = self.resting.pop(name)
            source = self.sources[name] = one.woken()
            source.muted = self.config.source(name).ignore or name in self.orders.about("mute")

    def waits_for(self, name: str) -> bool:
        """Whether a message of this source is queued, or its token came or went."""
        return self._held[name] > 0 or name in self._present

    def _is_full(self, message: Message) -> bool:
        full = len(self.queue) >= limits.MAX_QUEUED or self._components + size_of(message) > limits.MAX_COMPONENTS
        return full or self._held[source_of(message)] >= self.config.max_pending

    def _count(self, source: str, reason: str, count: int, dropped: bool) -> None:
        key = (source, reason, dropped)
        if key not in self._refused and len(self._refused) >= limits.MAX_EVENTS:
            key = ("*", reason, dropped)
        self._refused[key] += count

    def pending(self) -> int:
        """Messages queued."""
        return len(self.queue)

    def waiting_refusals(self) -> Counter[str]:
        """Refusals by reason that no step has told yet."""
        waiting: Counter[str] = Counter()
        for (_, reason, dropped), count in self._refused.items():
            if not dropped:
                waiting[reason] += count
        return waiting

    @property
    def lossy(self) -> bool:
        """Whether data were dropped since the last step because there was too much to do, not for one source's flow."""
        return any(dropped and reason != "flow" for _, reason, dropped in self._refused)

    def names(self) -> tuple[str, ...]:
        """All sources, sorted."""
        return tuple(sorted(self.sources))

    def nothing(self) -> Tracks:
        """No tracks, in the centre's space."""
        return self._nothing

    def declared(self, source: Source) -> SourceConfig:
        """What holds for a source: its own word, else the config's; with `override` the other way round."""
        if source.declared is None or source.declared[0] is not source.info:
            source.declared = source.info, declared_by(self.config.source(source.name), source.info)
        return source.declared[1]

    def motion_said(self, source: Source) -> Motion | None:
        """How its tracks move, if anybody says so."""
        return motion_declared(self.declared(source), source, self.config)

    def sensor(self, source: Source) -> SensorInfo | None:
        """Its info with coverage, detection probability and initiation delay as declared; None while it has none."""
        return sensor_of(self.declared(source), source.info, source.place)

    def treatment(self, name: str) -> Treatment:
        """How the tracks of a source are treated in this step."""
        return self.treatments.get(name, AS_IT_IS)

    def pace(self, source: Source, complete: bool) -> Pace:
        """Bounds of the intervals of its tracks, that come in a complete scan or not."""
        said = self.declared(source)
        known = source.info is not None or source.name in self.config.sources or said.period != SourceConfig().period
        return pace_of(said, not known, source.interval if complete else -1, self.config)

    def ready(self, source: Source) -> bool:
        """Whether its tracks may be used: it has said what it is, or had a step's time to do so."""
        known = source.info is not None or source.waited > 0 or self.config.source(source.name).override
        return known or bool(is_picture_of(source.name))

    def is_stale(self, source: Source, time: int) -> bool:
        """Whether it has been silent for `stale_periods` of its own periods, measured or declared, and `lateness`."""
        return source.last < 0 or time - source.last > self._silence(source)

    def _silence(self, source: Source) -> int:
        return silence_of(self.pace(source, complete=True).first, self.declared(source), self.config)

    def rebase(self, time: int, now: int) -> None:
        """A new era begins at `time`, ns: nothing that is known is later, nor did it come after `now`."""
        for name in sorted(self.resting):
            self.wake(name)
        rebase_sources(self.sources.values(), time)
        self.voting.asked = min(self.voting.asked, time)
        self.queue = [(event, min(received, now)) for event, received in self.queue]

    def take_orders(self) -> list[Order]:
        """The orders given since the last step, which are obeyed before anything else of it."""
        given, self._given = self._given, []
        return given

    def mute(self) -> None:
        """Refuse the sources that the config ignores or an order mutes, and no others."""
        muted = self.orders.about("mute")
        for name, source in self.sources.items():
            source.muted = name in muted or self.config.source(name).ignore

    def admit(self, time: int, last: int, journal: Journal) -> None:
        """Take all that is queued up to `time`, in canonical order; later messages stay.

        last: time of the last step, or -1.
        """
        self._dead = None
        for source in self.sources.values():
            source.waited += len(source.tracks.id) > 0 and source.info is None
            source.scans, source.ahead, source.pairs = 0, -1, []
            source.came, source.arrived, source.dropped = [], [], []
        for name, found in sorted(self._present.items()):
            self._presence(name, found, journal)
        for (name, reason, dropped), count in sorted(self._refused.items()):
            (journal.drop if dropped else journal.refuse)(Entry(name, 0, 0, 0, reason, count))
        self.spared.note({name for name, _, dropped in self._refused if dropped}, time, last)
        self._present, self._refused, self._dead = {}, Counter(), None
        self._accept(self._due(time, journal), time, last, journal)
        self.ahead.forget(self.queue)

    def _due(self, time: int, journal: Journal) -> list[_Keyed]:
        queue, self.raw = self.emptied(), {}
        due: list[_Keyed] = []
        for event, received in queue:
            name = source_of(event)
            timed = isinstance(event, (LocalTracks, LocalIntensity, GlobalTracks))
            clock = self.treatment(name).clock
            if timed and time + clock < getattr(event, "time", -1) <= horizon(received, self.config):
                self.hold(event, received)
                if name in self.sources:
                    source = self.sources[name]
                    source.ahead = max(source.ahead, getattr(event, "time", -1))
                continue
            try:
                key = (name, event.epoch, event.seq, event.type, self.ahead.digest(event), received)
            except MessageError as error:
                journal.refuse(Entry(name, 0, 0, 0, error.reason))
            else:
                due.append((key, as_scan(event, self.config, self.frame)))
                self.raw.setdefault((*key[:3], key[4]), (event, received, getattr(event, "time", received) - clock))
        due.sort(key=lambda item: item[0])
        return due

    def _presence(self, name: str, found: bool, journal: Journal) -> None:
        source = self.admitted(name, speaks=False)
        if source is None:
            journal.refuse(Entry(name, 0, 0, 0, "too-many-sources"))
        elif source.alive is not found:
            source.alive = found
            journal.event({"kind": "found" if found else "lost", "source": name})

    @property
    def is_full(self) -> bool:
        """Whether there is no room for another source but in place of one that is dead."""
        return len(self.sources) + len(self.resting) >= limits.MAX_SOURCES

    def blank(self, name: str) -> Source:
        """A source of which nothing is known."""
        source = Source(name, self.config.space, self.nothing())
        source.muted = self.config.source(name).ignore or name in self.orders.about("mute")
        return source

    def admitted(self, name: str, speaks: bool = True) -> Source | None:
        """The source of that name, made if there is room: the longest silent dead one goes for it, and for one that
        speaks one of which there was nothing but a token."""
        self.wake(name)
        if name in self.sources:
            return self.sources[name]
        try:
            check_source(name)
        except ValueError:
            return None
        if self.is_full and name not in self.config.sources:
            if self._dead is None:
                self._dead = gone(self.sources.values(), self.resting.values(), speaks)
            if not self._dead:
                return None
            longest = self._dead.pop()
            del (self.resting if longest in self.resting else self.sources)[longest]
        self.sources[name] = self.blank(name)
        return self.sources[name]

    def _accept(self, messages: list[_Keyed], time: int, last: int, journal: Journal) -> None:
        tracks: list[tuple[Source, Scan, Entry]] = []
        for (name, epoch, seq, kind, code, received), message in messages:
            entry = Entry(name, epoch, seq, code)
            known = self.sources.get(name)
            about = known or self.blank(name)
            reason = fault(self.config, about, message, code, last, received, lambda one: self.is_stale(one, time))
            source = None if reason else known or self.admitted(name)
            if source is None:
                journal.refuse(replace(entry, reason=reason or "too-many-sources"))
                if known is not None:
                    known.repeats += reason == "repeat"
                    known.why = notes.refusal(reason, message, last, received, self.config) or known.why
                continue
            if epoch != source.epoch:
                if source.epoch >= 0:
                    journal.event({"kind": "restarted", "source": name, "epoch": epoch})
                    tracks = [item for item in tracks if item[0] is not source]
                source.begin(epoch)
            source.note(kind, seq, code)
            source.origin = message.origin
            journal.accept(entry)
            if isinstance(message, SensorInfo):
                if source.info is None or seq > source.info.seq:
                    source.info = message
            elif isinstance(message, Scan):
                source.heard(received, message.time, last)
                tracks.append((source, message, entry))
        self._apply(tracks, time, journal)

    def _settle_frame(self, checked: list[Checked], time: int, journal: Journal) -> None:
        """Let the sources that speak vote on the frame of the picture (see `frames`)."""
        for (source, message, _), faults in checked:
            if (faults == 0).any():
                source.vote = Vote(message.frame, message.space, time)
        if self.config.frame is not None:
            return
        votes = {
            source.name: source.vote
            for source in self.sources.values()
            if source.vote is not None
            and source.alive is not False
            and not source.muted
            and time - source.vote.time <= self._silence(source)
        }
        frame = self.voting.settle(votes, self.frame, self.config, time)
        if frame is None:
            return
        if self.frame is not None:
            self.reframed = True
            for source in self.sources.values():
                source.tracks = empty_tracks(len(source.space))
        self.frame = frame
        journal.event({"kind": "frame", "source": min(name for name, vote in votes.items() if vote.frame == frame)})

    def _apply(self, items: list[tuple[Source, Scan, Entry]], time: int, journal: Journal) -> None:
        codes = self.ahead.faults([item[1] for item in items])
        checked = [
            ((source, as_tracks(message, faults), entry), faults)
            for (source, message, entry), faults in zip(items, codes, strict=True)
        ]
        checked = affordable(checked, self.config, journal)
        self._settle_frame(checked, time, journal)
        checked = [((source, framed(one, self.frame), entry), faults) for (source, one, entry), faults in checked]
        runs = [[item for _, item in run] for _, run in groupby(enumerate(checked), key=run_key)]
        conversion, total = Conversion(runs, self), sum(len(one.tracks.id) for one in self.sources.values())
        for place, batch in enumerate(runs):
            source, first, _ = batch[0][0]
            for (_, _, entry), faults in batch:
                for code in np.unique(faults[faults > 0]).tolist() if faults.any() else ():
                    journal.refuse(replace(entry, reason=FAULTS[code], count=int((faults == code).sum())))
            if self.frame is None and may_be_picture(first.frame, self.config.space):
                source.leave("frame", sum(int((faults == 0).sum()) for _, faults in batch))
                source.why = notes.frame_waiting(name_frame(first.frame))
                continue
            try:
                messages, new, pace, step = conversion.of(place)
            except FrameError as error:
                reason, source.why = "frame", notes.frame_refused(str(error))
            else:
                total -= len(source.tracks.id)
                most, follow = min(limits.MAX_TOTAL - total, limits.MAX_TRACKS), self.config.follows
                reason = "" if source.apply(messages, new, most, pace, follow, step) else "too-many-tracks"
                total += len(source.tracks.id)
            if reason:
                for (_, message, entry), _ in batch:
                    journal.refuse(replace(entry, reason=reason, count=len(message.ids)))
