"""One source as the centre knows it: its run, its sequence, what it says of itself, its newest tracks.

Tracks are kept column by column, sorted by local id, batch axis last, in the centre's frame and the source's
own state space. `link` is the global id a track is linked to (0: none); it lives as long as the local id does
within one epoch, so a restarted client takes over nobody's links.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.centre.frames import Vote
from fusion_service.centre.intervals import NOTHING_REMEMBERED, Pace, Remembered, follow, intervals
from fusion_service.centre.places import Place, followed
from fusion_service.centre.words import Codes
from fusion_service.densities import Mixtures
from schemas import LocalTracks, SensorInfo

__all__ = [
    "EXTENT_ROWS",
    "FUSED_ROWS",
    "LINKS",
    "REMEMBERED",
    "Columns",
    "Pair",
    "Source",
    "Tracks",
    "as_mixtures",
    "empty_tracks",
    "join_tracks",
    "newest",
    "no_parts",
    "padded",
    "relinked",
    "set_links",
    "unlinked",
]

Columns = TypeVar("Columns", bound="HasParts")

EXTENT_ROWS, FUSED_ROWS = 11, 7
"""Numbers of an extent: as a local track says it, and fused (see `extents`)."""
REMEMBERED = 1024
MOST_GAPS = 2**62
"""Messages of one source whose exact repeat is recognised; older ones are too late to matter."""


class HasParts(Protocol):
    """Columns of densities that may be mixtures: `Tracks`, or the global tracks."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def mean(self) -> Floats: ...
    @property
    def covariance(self) -> Floats: ...
    @property
    def log_weight(self) -> Floats: ...
    @property
    def part_mean(self) -> Floats: ...
    @property
    def part_covariance(self) -> Floats: ...


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """T tracks of one source: mean (n, T), covariance (n, n, T), the rest (T,).

    Where some track is a mixture, parts (C > 0) hold its components, log_weight (C, T) with -inf for padding,
    part_mean (n, C, T), part_covariance (n, n, C, T), and mean and covariance are their moments; else C = 0.
    id u64; time i64 of the density; updated i64 of the last measurement; existence (NaN: not reported);
    interval i64 expected time to the next report, ns (see `intervals`); identity, kind i32 codes of what it is said to
    be (-1: not said), kind_p (NaN: not said); origin u8 index into `ORIGINS` of the message;
    link u64 global id or 0; since i64 step of the link; used i64 time of the version last fused (-1: none); judged
    i64 `updated` of the newest datum that was judged, seen i64 time of the step that did; weighed i64 newest datum of
    the others in the track when evidence was last added; data i64 how many were judged in this link; evidence f64 sum
    for the link; outside: the newest datum failed its gate; shadow u64 global id that it is a second track of, or 0;
    apart f64 sum for that; told i64 `updated` of the version whose identity and class the global track has heard;
    lineage i32 code of the sources whose data it contains (-1: its source alone); extent (E, T), what is said of the
    object's extent, E = 0 where nothing is of any (see `extents`).
    """

    id: NDArray[np.uint64]
    time: NDArray[np.int64]
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    log_weight: NDArray[np.float64]
    part_mean: NDArray[np.float64]
    part_covariance: NDArray[np.float64]
    existence: NDArray[np.float64]
    updated: NDArray[np.int64]
    interval: NDArray[np.int64]
    identity: Codes
    kind: Codes
    kind_p: NDArray[np.float64]
    origin: NDArray[np.uint8]
    lineage: NDArray[np.int32]
    extent: NDArray[np.float64]
    link: NDArray[np.uint64]
    since: NDArray[np.int64]
    used: NDArray[np.int64]
    judged: NDArray[np.int64]
    weighed: NDArray[np.int64]
    seen: NDArray[np.int64]
    data: NDArray[np.int64]
    evidence: NDArray[np.float64]
    outside: NDArray[np.bool_]
    shadow: NDArray[np.uint64]
    apart: NDArray[np.float64]
    told: NDArray[np.int64]

    def take(self, rows: Any) -> Tracks:
        """The given rows (indices or a mask)."""
        return Tracks(*(getattr(self, one.name)[..., rows] for one in fields(self)))

    def mixtures(self, rows: Any) -> Mixtures:
        """The densities of the given rows as mixtures."""
        return as_mixtures(self, rows)


_BLANK: dict[str, tuple[type[np.generic], float]] = {
    "link": (np.uint64, 0),
    **dict.fromkeys(("since", "used", "judged", "weighed", "seen"), (np.int64, -1)),
    "data": (np.int64, 0),
    "evidence": (np.float64, 0.0),
    "outside": (np.bool_, False),
    "shadow": (np.uint64, 0),
    "apart": (np.float64, 0.0),
    "told": (np.int64, -1),
}
LINKS = tuple(_BLANK)
"""Columns that a new version of a track takes over from the last."""
OF_THE_TRACK = ("judged", "seen", "told")
"""Those of them that a new link leaves as they are: what was done with the newest datum."""


Pair: TypeAlias = tuple[Tracks, Tracks]
"""Old versions of some tracks, and the new ones that came next."""


def empty_tracks(n: int) -> Tracks:
    """No tracks, of n components."""
    whole, real, code = np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0, dtype=np.int32)
    log_weight, part_mean, part_covariance = no_parts(n, 0)
    return Tracks(
        id=np.zeros(0, dtype=np.uint64),
        time=whole,
        mean=np.zeros((n, 0)),
        covariance=np.zeros((n, n, 0)),
        log_weight=log_weight,
        part_mean=part_mean,
        part_covariance=part_covariance,
        existence=real,
        updated=whole,
        interval=whole,
        identity=code,
        kind=code,
        kind_p=real,
        origin=np.zeros(0, dtype=np.uint8),
        lineage=code,
        extent=np.zeros((0, 0)),
        **unlinked(0),
    )


def unlinked(count: int) -> dict[str, NDArray[Any]]:
    """The columns `LINKS` of tracks that nothing is known of."""
    return {name: np.full(count, blank, dtype=kind) for name, (kind, blank) in _BLANK.items()}


def set_links(tracks: Tracks, at: NDArray[np.intp], link: NDArray[np.uint64] | np.uint64, step: int) -> None:
    """Give the tracks `at` a link in `step`, 0 for none, with nothing known of it yet. Writes the columns `LINKS`."""
    for name, (_, blank) in _BLANK.items():
        if name not in OF_THE_TRACK:
            getattr(tracks, name)[at] = blank
    tracks.link[at], tracks.since[at] = link, step


def relinked(tracks: Tracks, at: NDArray[np.intp], link: NDArray[np.uint64] | np.uint64, step: int) -> Tracks:
    """The same with other links, as `set_links` gives them."""
    new = replace(tracks, **{name: getattr(tracks, name).copy() for name in LINKS})
    set_links(new, at, link, step)
    return new


def no_parts(n: int, count: int) -> tuple[Floats, Floats, Floats]:
    """The columns of components of `count` tracks that are all Gaussian."""
    return np.zeros((0, count)), np.zeros((n, 0, count)), np.zeros((n, n, 0, count))


def join_tracks(parts: Sequence[Columns]) -> Columns:
    """One after the other; where some hold components, or an extent, all get them."""
    most = max(len(part.log_weight) for part in parts)
    if any(len(part.log_weight) != most for part in parts):
        parts = [padded(part, most) for part in parts]
    first = parts[0]
    if len({len(getattr(part, "extent", ())) for part in parts}) > 1:
        parts = [_with_extents(part) for part in parts]
    names = [one.name for one in fields(first)]
    return type(first)(*(np.concatenate([getattr(part, name) for part in parts], axis=-1) for name in names))


def _with_extents(tracks: Columns) -> Columns:
    """The same with room for extents, nothing being said of them."""
    extent = getattr(tracks, "extent")  # noqa: B009
    if len(extent):
        return tracks
    rows = EXTENT_ROWS if isinstance(tracks, Tracks) else FUSED_ROWS
    return replace(tracks, extent=np.full((rows, extent.shape[-1]), np.nan))


def as_mixtures(tracks: HasParts, rows: Any) -> Mixtures:
    """The densities of the given rows as mixtures."""
    if not len(tracks.log_weight):
        mean, covariance = tracks.mean[:, None, rows], tracks.covariance[:, :, None, rows]
        return Mixtures(np.zeros_like(mean[0]), mean, covariance)
    return Mixtures(tracks.log_weight[:, rows], tracks.part_mean[..., rows], tracks.part_covariance[..., rows])


def padded(tracks: Columns, components: int) -> Columns:
    """The same with room for so many components."""
    had = len(tracks.log_weight)
    if had == components:
        return tracks
    log_weight = np.full((components, tracks.mean.shape[-1]), -np.inf)
    if had:
        index = np.minimum(np.arange(components), had - 1)
        log_weight[:had] = tracks.log_weight
        mean, covariance = tracks.part_mean[:, index], tracks.part_covariance[:, :, index]
    else:
        log_weight[0] = 0.0
        mean = np.repeat(tracks.mean[:, None], components, axis=1)
        covariance = np.repeat(tracks.covariance[:, :, None], components, axis=2)
    return replace(tracks, log_weight=log_weight, part_mean=mean, part_covariance=covariance)


def newest(old: Tracks, new: Tracks) -> Tracks:
    """Both, sorted by id, the newest of each id (the later given where times are equal), links kept unless the
    origin has changed.

    `old` is sorted by id; `new` may hold an id several times.
    """
    if len(old.id) and len(new.id):
        at = np.minimum(np.searchsorted(old.id, new.id), len(old.id) - 1)
        known = (old.id[at] == new.id) & (old.origin[at] == new.origin)
        kept = {name: np.where(known, getattr(old, name)[at], getattr(new, name)) for name in LINKS}
        new = replace(new, **kept)
    both = join_tracks([old, new])
    order = np.lexsort((np.arange(len(both.id)), both.time, both.id))
    last = np.append(both.id[order][1:] != both.id[order][:-1], True) if len(order) else np.zeros(0, dtype=np.bool_)
    return both.take(order[last])


def successive(old: Tracks, new: Tracks) -> Pair | None:
    """Each version of `new` with the one before it, in `old` (sorted by id) or in `new`; without those that hold no
    newer measurement than it, or of which a later one was there already. None if there is no such version."""
    if not len(old.id) or not len(new.id):
        return None
    both = join_tracks([old.take(np.isin(old.id, new.id)), new])
    order = np.lexsort((np.arange(len(both.id)), both.time, both.id))
    both, fresh = both.take(order), order >= len(both.id) - len(new.id)
    first, last = both.take(slice(None, -1)), both.take(slice(1, None))
    begun = np.maximum.accumulate(np.where(fresh, -1, np.arange(len(fresh))))[:-1]
    same = (first.id == last.id) & (begun >= 0) & (both.id[begun] == first.id) & fresh[1:]
    same &= (last.updated > first.updated) & (first.origin == last.origin)
    return (first.take(same), last.take(same)) if same.any() else None


@dataclass(slots=True)
class Source:
    """State of one source. Times are ns; -1 means never.

    interval: between its scans, ns, measured (-1: not yet). remembered: its tracks that went stale. vote: the frame it
    speaks in. why: the reason that data of it are not used, in a sentence; unused: tracks that were not, by reason.
    lag: how far behind the last step its messages come, ns, about the longest of late. places: of its newest messages
    that say one. Of the step being made: came, the time of each message with tracks, and when it came, ns; arrived, the
    ids that came; dropped, the links of tracks that complete scans list no more; pairs, the versions of what came,
    where those are followed; ahead, the time of the newest message that is for a later one.
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
        self, messages: Sequence[LocalTracks], new: Tracks, most: int, pace: Pace, versions: bool = False
    ) -> bool:
        """Take the tracks of a complete scan, or of partial ones in a row; what a complete scan does not list is
        gone. versions: keep them. False, and nothing is changed, if there would be more than `most` tracks."""
        space, complete = messages[-1].space, messages[-1].complete
        new = new.take(new.time >= self.complete)
        old = self.tracks if space == self.space else empty_tracks(len(space))
        new = replace(new, interval=intervals(new.id, new.time, self._known(old), pace))
        merged, pair = newest(old, new), successive(old, new) if versions else None
        end, gone = messages[-1].time, merged.link[:0]
        if complete and end >= self.complete:
            listed = np.isin(merged.id, messages[-1].ids) | (merged.time > end)
            merged, gone = merged.take(listed), merged.link[~listed]
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
        there = Remembered(tracks.id, tracks.time, tracks.interval)
        if not len(self.remembered.id):
            return there
        both = Remembered(*(np.concatenate(pair) for pair in zip(there, self.remembered, strict=True)))
        return both.take(np.argsort(both.id, kind="stable"))
