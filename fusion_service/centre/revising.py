"""`Revision`: one time that steps are made again, for data that came late (see `history`): what goes into them, and
what is told of it.

What was decided in the steps made again is told to nobody, since it was told once already; told is what is otherwise
now: ids that are no more end as `revised`, replaced by the track that their local tracks are in, where there is one.
An id that has ended never returns: if its target was there after all, the track goes on under another.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre.events import Event
from fusion_service.centre.history import History, Key, Late, Past, key_of
from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.naming import Table
from fusion_service.centre.obeying import heirs
from fusion_service.centre.rows import NO_TRACK
from fusion_service.order import Order
from schemas import Entry, Message

__all__ = ["Revision"]

MOST_TOLD = 1000
"""Ids that are back, and sources, in one event."""
_Ids = NDArray[np.uint64]


class Revision:
    """Steps of `history` made again, from `start` on in its past, with what came `late`.

    intake, ids, following: the intake, the ids of the picture, and the next new id, all before. steps: to be made
    again; there: the ids; tables: the links of every source before.
    """

    def __init__(
        self, history: History, start: int, late: Sequence[Late], intake: Intake, ids: _Ids, following: int
    ) -> None:
        self._history, self._before, self._ids, self.following = history, intake, ids, following
        self.there = frozenset(ids.tolist())
        late = history.reached(late, start)
        self._late = {one.key for one in late}
        self._queued = {id(one.event) for one in late}
        self.steps, owed = history.rewind(start)
        self.tables: Mapping[str, Table] = {
            name: Table(source.epoch, source.tracks.id, source.tracks.link.copy())
            for name, source in intake.sources.items()
        }
        timed = [one for past in self.steps for one in past.inputs if hasattr(one[0], "time")]
        timed += [(one.event, one.received) for one in late]
        self._timed = sorted(timed, key=lambda one: getattr(one[0], "time", -1), reverse=True)
        self._wanted = self._late.union(owed)
        self._moved: dict[Key, int] = {}
        self._taken: list[Entry] = []
        self._refused: list[Entry] = []
        self._heirs: dict[int, int] = {}

    def left(self, queue: Sequence[tuple[Message, int]]) -> list[tuple[Message, int]]:
        """Of what is queued, all that is not late."""
        return [one for one in queue if id(one[0]) not in self._queued]

    def events(self, past: Past, intake: Intake, ids: _Ids) -> Iterator[tuple[Event, int]]:
        """What went into a step beside messages; what was ordered about a track that is not among `ids` now, about the
        one that has its local tracks."""
        for event, received in past.events:
            if isinstance(event, Order):
                event = replace(event, track=self._now(event.track, intake, ids))
                event = replace(event, other=self._now(event.other, intake, ids))
            yield event, received

    def feed(self, past: Past, intake: Intake) -> None:
        """Queue the messages that a step may take: those of its time, and those without one that it had."""
        ahead = max((one.clock for one in intake.treatments.values()), default=0)
        while self._timed and getattr(self._timed[-1][0], "time", -1) <= past.time + max(ahead, 0):
            intake.hold(*self._timed.pop())
        for message, received in past.inputs:
            if not hasattr(message, "time"):
                intake.hold(message, received)

    def look(self, past: Past, journal: Journal) -> None:
        """A step has been made again: what it took of what was late, or refused."""
        for entry in journal.taken():
            key = key_of(entry)
            if key in self._wanted:
                self._moved[key] = past.time
                if key in self._late:
                    self._taken.append(entry)
        self._refused += [entry for entry in journal.not_taken() if key_of(entry) in self._late]
        self._heirs |= heirs(journal.ended())

    def finish(self, intake: Intake, queue: Sequence[tuple[Message, int]]) -> None:
        """All are made: what was queued before goes into the next step, with what none of them took."""
        for message, received in (*self._timed[::-1], *queue):
            intake.hold(message, received)
        intake.succeed(self._before)
        for name, source in intake.sources.items():
            if name in self._before.sources:
                source.repeats = max(source.repeats, self._before.sources[name].repeats)

    def tell(self, journal: Journal, intake: Intake, ids: _Ids, other: Mapping[int, int]) -> int | None:
        """Tell the journal of the step what has been revised; ids: of the picture now; other: {id that had ended: the
        one it goes on under}. The time of the first step that is otherwise, ns; None where nothing has come of it."""
        for entry in self._taken:
            journal.accept(entry)
            known = self._history.reordered
            if self._overtaken(entry) and (entry.source in known or len(known) < 2 * MOST_TOLD):
                known[entry.source] += 1
        for entry in self._refused:
            journal.refuse(entry)
        if not self._moved:
            self._history.futile(len(self.steps))
            return None
        since = min(self._moved.values())
        steps = sum(past.time >= since for past in self.steps)
        self._history.told(steps, self._moved)
        gone = self._ids[~np.isin(self._ids, ids)]
        new = ids[~np.isin(ids, self._ids)]
        names = sorted({name for name, *_ in self._moved})[:MOST_TOLD]
        event = {"kind": "revised", "since": since, "steps": steps, "messages": len(self._moved), "sources": names}
        back = [list(pair) for pair in sorted(other.items())][:MOST_TOLD]
        journal.event(event | ({"back": back} if back else {}))
        journal.birth(new)
        for track in gone.tolist():
            journal.end(track, "revised", self._heir(track, intake, ids, other))
        return since

    def _overtaken(self, entry: Entry) -> bool:
        """Whether a late message came after one of its source with a higher number."""
        source = self._before.sources.get(entry.source)
        return (
            source is not None and source.epoch == entry.epoch and entry.seq < max(source.highest.values(), default=0)
        )

    def _heir(self, track: int, intake: Intake, ids: _Ids, other: Mapping[int, int]) -> int | None:
        """The track of `ids` that goes on for one that is no more."""
        heir, steps = track, 0
        while heir in self._heirs and steps < MOST_TOLD:
            heir, steps = self._heirs[heir], steps + 1
        heir = other.get(heir, heir)
        if heir == track or not _has(ids, heir):
            heir = self._now(track, intake, ids) or track
        return heir if heir != track and _has(ids, heir) else None

    def _now(self, track: int | None, intake: Intake, ids: _Ids) -> int | None:
        """The track that has most of the local tracks that were in `track`; itself where it is there, or none has."""
        if track is None or _has(ids, track):
            return track
        found: Counter[int] = Counter()
        for name, table in sorted(self.tables.items()):
            source = intake.sources.get(name)
            if source is not None and source.epoch == table.epoch:
                mine = np.isin(source.tracks.id, table.id[table.link == np.uint64(track)])
                found.update(source.tracks.link[mine & (source.tracks.link != NO_TRACK)].tolist())
        return min(found, key=lambda one: (-found[one], one)) if found else track


def _has(ids: _Ids, track: int) -> bool:
    return 0 <= track < 2**64 and bool((ids == np.uint64(track)).any())
