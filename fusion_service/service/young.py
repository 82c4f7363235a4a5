"""What is noted of tracks that begin between two checkpoints: their ids, and the local tracks that feed them.

A note is its length in four bytes, MessagePack of [names of sources, global ids u64, sources u16 as indices into the
names, epochs u64, local ids u64, where the tracks are], columns as little-endian bytes, and a byte of 1. What a kill,
or a loss of power, has left of the last note is passed over. Of a note of an earlier release it is not known where
they were.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import msgpack
import numpy as np

from fusion_service.centre import LocalKey, Whereabouts
from schemas import GlobalTracks

__all__ = ["Born", "born_in", "noted", "padded", "places_of"]

END = b"\x01"
WORD = 8


class Born(NamedTuple):
    """Of some notes, in order: (local track, global id) of all, and where the tracks were."""

    tracks: list[tuple[LocalKey, int]]
    where: list[Whereabouts]


def noted(picture: GlobalTracks, above: int, where: Callable[[int], Whereabouts]) -> bytes:
    """The note of the tracks of a picture whose ids are above `above`; empty where there are none. Its ids are
    sorted. where: tells where they are."""
    first = int(np.searchsorted(picture.ids, np.uint64(above), side="right"))
    if first == len(picture.ids):
        return b""
    counts = picture.contributor_counts.astype(np.intp)
    begin = int(counts[:first].sum())
    columns = (
        np.repeat(picture.ids[first:], counts[first:]).astype("<u8"),
        picture.contributor_source[begin:].astype("<u2"),
        picture.contributor_epoch[begin:].astype("<u8"),
        picture.contributor_id[begin:].astype("<u8"),
    )
    used, which = np.unique(columns[1], return_inverse=True)
    names = [picture.sources[one] for one in used.tolist()]
    parts = columns[0], which.astype("<u2"), columns[2], columns[3]
    body = cast(bytes, msgpack.packb([names, *(part.tobytes() for part in parts), where(above).packed()]))
    return len(body).to_bytes(4, "little") + body + END


def padded(note: bytes) -> bytes:
    """A note as it stands before another one."""
    return note.ljust(-(-len(note) // WORD) * WORD, b"\0")


def places_of(picture: GlobalTracks, above: int) -> Whereabouts:
    """Where the tracks of a picture are, as it says, whose ids are above `above`; of mixtures it is not known."""
    n = len(picture.space)
    if picture.counts is not None:
        return Whereabouts.nothing(n)
    at = picture.ids > np.uint64(above)
    mean, covariance = np.moveaxis(picture.means[at], 0, -1), np.moveaxis(picture.covariances[at], 0, -1)
    time = np.full(int(at.sum()), picture.time, dtype=np.int64)
    return Whereabouts(repr(picture.frame), picture.ids[at], time, mean, covariance)


def born_in(notes: bytes) -> Born:
    """All notes; what cannot be read ends them."""
    found = Born([], [])
    at = 0
    while at + 4 < len(notes):
        size = int.from_bytes(notes[at : at + 4], "little")
        body, end = notes[at + 4 : at + 4 + size], notes[at + 4 + size : at + 5 + size]
        if not size or end != END:
            break
        try:
            tracks, where = _read(msgpack.unpackb(body))
        except (ValueError, TypeError, LookupError, msgpack.exceptions.UnpackException):
            break
        found.tracks.extend(tracks)
        found.where.extend(where)
        at = -(-(at + 5 + size) // WORD) * WORD
    return found


def _read(packed: Any) -> Born:
    names, *parts = packed
    kinds = ("<u8", "<u2", "<u8", "<u8")
    where = [Whereabouts.unpacked(one) for one in parts[len(kinds) :]]
    parts = parts[: len(kinds)]
    tracks, sources, epochs, ids = (np.frombuffer(part, kind).tolist() for part, kind in zip(parts, kinds, strict=True))
    rows = zip(tracks, sources, epochs, ids, strict=True)
    return Born([((str(names[source]), epoch, local), track) for track, source, epoch, local in rows], where)
