"""One source as the centre knows it: its run, its sequence, what it says of itself, its newest tracks.

Tracks are kept column by column, sorted by local id, batch axis last, in the centre's frame and the source's
own state space. `link` is the global id a track is linked to (0: none); it lives as long as the local id does
within one epoch, so a restarted client takes over nobody's links.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion_service import geodesy, linalg
from fusion_service.centre.words import Codes, Lexicon
from fusion_service.densities import Mixtures, reduce_mixtures
from schemas import ORIGINS, Frame, Height, LocalTracks, SensorInfo

__all__ = [
    "REMEMBERED",
    "Columns",
    "Source",
    "Tracks",
    "as_mixtures",
    "empty_tracks",
    "join_tracks",
    "message_tracks",
    "newest",
    "no_parts",
    "padded",
]

Floats = NDArray[np.float64]
Columns = TypeVar("Columns", bound="HasParts")

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
    link u64 global id or 0; since i64 step of the link; fails i64 steps in a row that the link has failed;
    used i64 time of the version last fused (-1: none). identity, kind i32 codes of what it is said to be (-1: not
    said), kind_p (NaN: not said); origin u8 index into `ORIGINS` of the message; told i64 `updated` of the version
    whose identity and class the global track has heard (-1: none).
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
    link: NDArray[np.uint64]
    since: NDArray[np.int64]
    fails: NDArray[np.int64]
    used: NDArray[np.int64]
    identity: Codes
    kind: Codes
    kind_p: NDArray[np.float64]
    origin: NDArray[np.uint8]
    told: NDArray[np.int64]

    def take(self, rows: Any) -> Tracks:
        """The given rows (indices or a mask)."""
        return Tracks(*(getattr(self, one.name)[..., rows] for one in fields(self)))

    def mixtures(self, rows: Any) -> Mixtures:
        """The densities of the given rows as mixtures."""
        return as_mixtures(self, rows)


LINKS = ("link", "since", "fails", "used", "told")


def empty_tracks(n: int) -> Tracks:
    """No tracks, of n components."""
    whole, real, code = np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0, dtype=np.int32)
    ids, origin = np.zeros(0, dtype=np.uint64), np.zeros(0, dtype=np.uint8)
    log_weight, part_mean, part_covariance = no_parts(n, 0)
    return Tracks(
        id=ids,
        time=whole,
        mean=np.zeros((n, 0)),
        covariance=np.zeros((n, n, 0)),
        log_weight=log_weight,
        part_mean=part_mean,
        part_covariance=part_covariance,
        existence=real,
        updated=whole,
        link=ids,
        since=whole,
        fails=whole,
        used=whole,
        identity=code,
        kind=code,
        kind_p=real,
        origin=origin,
        told=whole,
    )


def no_parts(n: int, count: int) -> tuple[Floats, Floats, Floats]:
    """The columns of components of `count` tracks that are all Gaussian."""
    return np.zeros((0, count)), np.zeros((n, 0, count)), np.zeros((n, n, 0, count))


def join_tracks(parts: Sequence[Columns]) -> Columns:
    """One after the other; where some hold components, all get them."""
    most = max(len(part.log_weight) for part in parts)
    if any(len(part.log_weight) != most for part in parts):
        parts = [padded(part, most) for part in parts]
    first = parts[0]
    names = [one.name for one in fields(first)]
    return type(first)(*(np.concatenate([getattr(part, name) for part in parts], axis=-1) for name in names))


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


def message_tracks(
    messages: Sequence[LocalTracks],
    sound: Sequence[NDArray[np.bool_]],
    frame: Frame,
    height: Height | None,
    most: int,
    said: Lexicon,
) -> Tracks:
    """The sound tracks of messages of one space, frame and height, in `frame`, one after the other; mixtures of
    more than `most` components are reduced. said: gives texts their codes.

    Raises `geodesy.FrameError` where their frame cannot be brought into `frame`.
    """
    first = messages[0]
    means, covariances, weights, sizes = (
        np.concatenate(column) for column in zip(*map(_components, messages, sound), strict=True)
    )
    means, covariances = geodesy.transform(means, covariances, first.space, first.frame, frame, first.height or height)
    if sizes.max(initial=1) == 1:
        mean, covariance = linalg.to_last(means, 1), linalg.symmetrise(linalg.to_last(covariances, 2))
        parts = no_parts(len(mean), len(sizes))
    else:
        mixtures = Mixtures.from_rows(weights, means, covariances, sizes).normalised()
        if len(mixtures.log_weights) > most:
            mixtures = reduce_mixtures(mixtures, max_components=most)
        mean, covariance = mixtures.moments()
        parts = mixtures.log_weights, mixtures.means, linalg.symmetrise(mixtures.covariances)
    counts = [int(rows.sum()) for rows in sound]
    times = np.repeat(np.array([m.time for m in messages], dtype=np.int64), counts)
    updated = [np.full(len(m.ids), m.time) if m.updated is None else m.updated for m in messages]
    existence = [np.full(len(m.ids), np.nan) if m.existence is None else m.existence for m in messages]
    none = np.full(len(times), -1, dtype=np.int64)
    return Tracks(
        id=_gather([m.ids for m in messages], sound).astype(np.uint64),
        time=times,
        mean=mean,
        covariance=linalg.symmetrise(covariance),
        log_weight=parts[0],
        part_mean=parts[1],
        part_covariance=parts[2],
        existence=_gather(existence, sound).astype(np.float64),
        updated=np.minimum(_gather(updated, sound), times),
        link=np.zeros(len(times), dtype=np.uint64),
        since=none,
        fails=np.zeros(len(times), dtype=np.int64),
        used=none,
        **_told(messages, sound, counts, said),
        told=none,
    )


def _told(
    messages: Sequence[LocalTracks], sound: Sequence[NDArray[np.bool_]], counts: list[int], said: Lexicon
) -> dict[str, NDArray[Any]]:
    """The columns of what the tracks are said to be, and of their origin."""
    nothing = [np.full(len(m.ids), -1, dtype=np.int32) for m in messages]
    identity, kind = (
        [none if texts is None else words.codes(texts) for texts, none in zip(column, nothing, strict=True)]
        for words, column in ((said.identity, [m.identity for m in messages]), (said.kind, [m.kind for m in messages]))
    )
    sure = [np.full(len(m.ids), np.nan) if m.kind_p is None else m.kind_p for m in messages]
    origins = np.array([ORIGINS.index(m.origin) for m in messages], dtype=np.uint8)
    return {
        "identity": _gather(identity, sound),
        "kind": _gather(kind, sound),
        "kind_p": _gather(sure, sound).astype(np.float64),
        "origin": np.repeat(origins, counts),
    }


def _components(message: LocalTracks, sound: NDArray[np.bool_]) -> tuple[Floats, Floats, Floats, NDArray[np.intp]]:
    """Means, covariances and weights of the components of the sound tracks, and how many each of these has."""
    if message.counts is None or message.weights is None:
        count = int(sound.sum())
        return message.means[sound], message.covariances[sound], np.ones(count), np.ones(count, dtype=np.intp)
    counts = message.counts.astype(np.intp)
    rows = np.repeat(sound, counts)
    return message.means[rows], message.covariances[rows], message.weights[rows], counts[sound]


def _gather(columns: Sequence[NDArray[Any]], rows: Sequence[NDArray[np.bool_]]) -> NDArray[Any]:
    return np.concatenate([column[mask] for column, mask in zip(columns, rows, strict=True)])


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
