"""One source as the centre knows it: its run, its sequence, what it says of itself, its newest tracks (see `tracks`),
sorted by local id."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import among
from fusion_service.centre.frames import Vote
from fusion_service.centre.intervals import NOTHING_REMEMBERED, Pace, Remembered, follow, intervals
from fusion_service.centre.places import Place, followed
from fusion_service.centre.tracks import Pair, Step, Tracks, by_id, empty_tracks, join_tracks, renewed
from fusion_service.config import SourceConfig
from fusion_service.records import altered
from schemas import LocalTracks, SensorInfo

__all__ = ["REMEMBERED", "Source"]

REMEMBERED = 1024
MOST_GAPS = 2**62
"""Messages of one source whose exact repeat is recognised; older ones are too late to matter."""


@dataclass(slots=True)
class Source:
    """State of one source. Times are ns; -1 means never.

    interval: between its scans, ns, measured (-1: not yet). remembered: its tracks that went stale. vote: the frame it
    speaks in. why: the reason that data of it are not used, in a sentence; unused: tracks that were not, by reason.
    lag: how far behind the last step its messages come, ns, about the longest of late. places: of its newest messages
    that say one. Of the step being made: came, the time of each message with tracks, and when it came, ns; arrived, the
    ids that came; dropped, the links of tracks whose existence it judged and that complete scans list no more; pairs,
    the versions of what came, where those are followed; ahead, the time of the newest message that is for a later one.
    declared: its info, and what holds for it by that and the config.
    """

    name: str
    space: tuple[str, ...]
    tracks: Tracks
    epoch: int = -1
    info: SensorInfo | None = None
    alive: bool | None = None
    muted: bool = False
    origin: str = "live"
    waited: int = 0
    last: int = -1
    complete: int = -1
    offset: int = 0
    messages: int = 0
    scans: int = 0
    repeats: int = 0
    gaps: int = 0
    reordered: int = 0
    interval: int = -1
    remembered: Remembered = NOTHING_REMEMBERED
    vote: Vote | None = None
    why: str = ""
    unused: dict[str, int] = field(default_factory=dict)
    came: list[tuple[int, int]] = field(default_factory=list)
    arrived: list[NDArray[np.uint64]] = field(default_factory=list)
    dropped: list[NDArray[np.uint64]] = field(default_factory=list)
    ahead: int = -1
    lag: int = 0
    places: tuple[Place, ...] = ()
    pairs: list[Pair] = field(default_factory=list)
    highest: dict[str, int] = field(default_factory=dict)
    first: dict[str, int] = field(default_factory=dict)
    seen: deque[tuple[str, int, int]] = field(default_factory=deque)
    seen_set: set[tuple[str, int, int]] = field(default_factory=set)
    declared: tuple[SensorInfo | None, SourceConfig] | None = None

    def begin(self, epoch: int) -> None:
        """Forget the last run: tracks, links, sequence."""
        self.epoch, self.info, self.waited, self.last, self.complete = epoch, None, 0, -1, -1
        self.tracks = empty_tracks(len(self.space))
        self.interval, self.remembered, self.why, self.arrived = -1, NOTHING_REMEMBERED, "", []
        self.lag, self.dropped, self.pairs, self.places = 0, [], [], ()
        self.highest, self.first, self.seen, self.seen_set = {}, {}, deque(), set()

    @property
    def place(self) -> Place | None:
        """Where it was when it last said so."""
        return self.places[-1] if self.places else None

    def leave(self, reason: str, count: int) -> None:
        """Count tracks that are taken but not used."""
        if count:
            self.unused[reason] = self.unused.get(reason, 0) + count

    def is_repeat(self, kind: str, seq: int, digest: int) -> bool:
        """Whether this very message was taken before."""
        return (kind, seq, digest) in self.seen_set

    def note(self, kind: str, seq: int, digest: int) -> None:
        """Count a message into the sequence: a gap is what is missing so far, a late filler mends it."""
        self.messages += 1
        if kind not in self.highest:
            self.highest[kind] = self.first[kind] = seq
        elif seq > self.highest[kind]:
            self.gaps = min(self.gaps + seq - self.highest[kind] - 1, MOST_GAPS)
            self.highest[kind] = seq
        elif seq < self.highest[kind]:
            self.reordered += 1
            if seq > self.first[kind]:
                self.gaps = max(0, self.gaps - 1)
        key = (kind, seq, digest)
        self.seen.append(key)
        self.seen_set.add(key)
        if len(self.seen) > REMEMBERED:
            self.seen_set.discard(self.seen.popleft())

    def heard(self, received: int, time: int, last: int) -> None:
        """Tracks of `time` came at `received`, after the step at `last` (-1: none), ns."""
        late = max(last - time, 0) if last >= 0 else 0
        self.came.append((time, received))
        self.offset, self.lag = received - time, max(late, self.lag - (self.lag - late) // 8)

    def apply(
        self, messages: Sequence[LocalTracks], new: Tracks, most: int, pace: Pace, versions: bool = False,
        step: Step | None = None,
    ) -> bool:  # fmt: skip
        """Take the tracks of a complete scan, or of partial ones in a row; what a complete scan does not list is
        gone. versions: keep them. step: the one to the next table, where it is known already. False, and nothing is
        changed, if there would be more than `most` tracks."""
        space, complete, end = messages[-1].space, messages[-1].complete, messages[-1].time
        old = self.tracks if space == self.space else empty_tracks(len(space))
        if step is None:
            if len(new.id):
                new = by_id(new.take(new.time >= self.complete))
                new = altered(new, interval=intervals(new.id, new.time, self._known(old), pace))
            step = renewed(old, new, versions)
        merged, stays, pair = step
        gone = old.link[:0]
        if complete and end >= self.complete and stays.any():
            listed = ~stays | (old.time > end)
            listed[~listed] = among(old.id[~listed], messages[-1].ids)
            stays, gone = stays & listed, old.link[~listed & np.isfinite(old.existence)]
        if stays.any():
            merged = join_tracks([old.take(stays), merged])
            merged = merged.take(np.argsort(merged.id, kind="stable"))
        if len(merged.id) > most:
            return False
        self.dropped.append(gone)
        if complete:
            self.scans += end >= self.complete
            self.complete = max(self.complete, end)
        self.arrived.append(new.id)
        if space != self.space:
            self.pairs = []
        if pair is not None:
            self.pairs.append(pair)
        for message in messages:
            if 0 <= self.last < message.time:
                gap = message.time - self.last
                self.interval = follow(self.interval if self.interval > 0 else gap, gap, pace)
            self.last = max(self.last, message.time)
            if message.platform is not None:
                self.places = followed(self.places, Place(message.time, message.frame, message.platform))
        self.space, self.tracks = space, merged
        return True

    def _known(self, tracks: Tracks) -> Remembered:
        """The intervals of `tracks` and of what is remembered, sorted by id."""
        there = Remembered(tracks.id, tracks.time, tracks.interval, tracks.link)
        if not len(self.remembered.id):
            return there
        both = Remembered(*(np.concatenate(pair) for pair in zip(there, self.remembered, strict=True)))
        return both.take(np.argsort(both.id, kind="stable"))
