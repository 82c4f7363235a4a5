"""One source as the centre knows it: its run, its sequence, what it says of itself, its newest tracks.

Tracks are kept column by column, sorted by local id, batch axis last, in the centre's frame and the source's
own state space. `link` is the global id a track is linked to (0: none); it lives as long as the local id does
within one epoch, so a restarted client takes over nobody's links.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service import geodesy, linalg
from fusion_service.densities import moments
from schemas import Frame, Height, LocalTracks, SensorInfo

__all__ = ["REMEMBERED", "Source", "Tracks", "empty_tracks", "message_tracks", "newest"]

REMEMBERED = 1024
MOST_GAPS = 2**62
"""Messages of one source whose exact repeat is recognised; older ones are too late to matter."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """T tracks of one source: mean (n, T), covariance (n, n, T), the rest (T,).

    id u64; time i64 of the density; updated i64 of the last measurement; existence (NaN: not reported);
    link u64 global id or 0; since i64 step of the link; fails i64 steps in a row that the link has failed;
    used i64 time of the version last fused (-1: none).
    """

    id: NDArray[np.uint64]
    time: NDArray[np.int64]
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    existence: NDArray[np.float64]
    updated: NDArray[np.int64]
    link: NDArray[np.uint64]
    since: NDArray[np.int64]
    fails: NDArray[np.int64]
    used: NDArray[np.int64]

    def take(self, rows: Any) -> Tracks:
        """The given rows (indices or a mask)."""
        return Tracks(*(getattr(self, one.name)[..., rows] for one in fields(self)))


LINKS = ("link", "since", "fails", "used")


def empty_tracks(n: int) -> Tracks:
    """No tracks, of n components."""
    whole, real = np.zeros(0, dtype=np.int64), np.zeros(0)
    ids = np.zeros(0, dtype=np.uint64)
    return Tracks(ids, whole, np.zeros((n, 0)), np.zeros((n, n, 0)), real, whole, ids, whole, whole, whole)


def message_tracks(
    messages: Sequence[LocalTracks], sound: Sequence[NDArray[np.bool_]], frame: Frame, height: Height | None
) -> Tracks:
    """The sound tracks of messages of one space, frame and height, in `frame`, one after the other; mixtures as
    their mean and covariance.

    Raises `geodesy.FrameError` where their frame cannot be brought into `frame`.
    """
    first = messages[0]
    parts = [moments(m.means, m.covariances, m.weights, m.counts) for m in messages]
    means = np.concatenate([mean[rows] for (mean, _), rows in zip(parts, sound, strict=True)])
    covariances = np.concatenate([spread[rows] for (_, spread), rows in zip(parts, sound, strict=True)])
    means, covariances = geodesy.transform(means, covariances, first.space, first.frame, frame, first.height or height)
    counts = [int(rows.sum()) for rows in sound]
    times = np.repeat(np.array([m.time for m in messages], dtype=np.int64), counts)
    updated = [np.full(len(m.ids), m.time) if m.updated is None else m.updated for m in messages]
    existence = [np.full(len(m.ids), np.nan) if m.existence is None else m.existence for m in messages]
    none = np.full(len(times), -1, dtype=np.int64)
    return Tracks(
        id=_gather([m.ids for m in messages], sound).astype(np.uint64),
        time=times,
        mean=linalg.to_last(means, 1),
        covariance=linalg.symmetrise(linalg.to_last(covariances, 2)),
        existence=_gather(existence, sound).astype(np.float64),
        updated=np.minimum(_gather(updated, sound), times),
        link=np.zeros(len(times), dtype=np.uint64),
        since=none,
        fails=np.zeros(len(times), dtype=np.int64),
        used=none,
    )


def _gather(columns: Sequence[NDArray[Any]], rows: Sequence[NDArray[np.bool_]]) -> NDArray[Any]:
    return np.concatenate([column[mask] for column, mask in zip(columns, rows, strict=True)])


def newest(old: Tracks, new: Tracks) -> Tracks:
    """Both, sorted by id, the newest of each id (the later given where times are equal), links kept.

    `old` is sorted by id; `new` may hold an id several times.
    """
    if len(old.id) and len(new.id):
        at = np.minimum(np.searchsorted(old.id, new.id), len(old.id) - 1)
        known = old.id[at] == new.id
        kept = {name: np.where(known, getattr(old, name)[at], getattr(new, name)) for name in LINKS}
        new = replace(new, **kept)
    both = Tracks(*(np.concatenate([getattr(old, one.name), getattr(new, one.name)], axis=-1) for one in fields(old)))
    order = np.lexsort((np.arange(len(both.id)), both.time, both.id))
    last = np.append(both.id[order][1:] != both.id[order][:-1], True) if len(order) else np.zeros(0, dtype=np.bool_)
    return both.take(order[last])


@dataclass(slots=True)
class Source:
    """State of one source. Times are ns; -1 means never."""

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
    highest: dict[str, int] = field(default_factory=dict)
    first: dict[str, int] = field(default_factory=dict)
    seen: deque[tuple[str, int, int]] = field(default_factory=deque)
    seen_set: set[tuple[str, int, int]] = field(default_factory=set)

    def begin(self, epoch: int) -> None:
        """Forget the last run: tracks, links, sequence."""
        self.epoch, self.info, self.waited, self.last, self.complete = epoch, None, 0, -1, -1
        self.tracks = empty_tracks(len(self.space))
        self.highest, self.first, self.seen, self.seen_set = {}, {}, deque(), set()

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

    def apply(self, messages: Sequence[LocalTracks], new: Tracks, most: int) -> bool:
        """Take the tracks of a complete scan, or of partial ones in a row; what a complete scan does not list is
        gone. False, and nothing is changed, if there would be more than `most` tracks."""
        space, complete = messages[-1].space, messages[-1].complete
        new = new.take(new.time >= self.complete)
        old = self.tracks if space == self.space else empty_tracks(len(space))
        merged = newest(old, new)
        end = messages[-1].time
        if complete and end >= self.complete:
            listed = np.isin(merged.id, messages[-1].ids)
            merged = merged.take(listed | (merged.time > end))
        if len(merged.id) > most:
            return False
        if complete:
            self.scans += end >= self.complete
            self.complete = max(self.complete, end)
        self.last = max(self.last, *(message.time for message in messages))
        self.space, self.tracks = space, merged
        return True
