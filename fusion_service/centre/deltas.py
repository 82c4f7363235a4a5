"""What is published at a step of a centre that steps when data arrive: the tracks that changed, between full pictures.

A picture is full at the first step of a run, at the first at or after every multiple of `period`, after steps were made
again for late data, and wherever a delta could not say what happened: a track disappears without an end (it left what
is published), or the frame changes. A
track has changed where a local track linked to it came in this step, or where its status, its labels, its newest datum
or its contributors are others than before (see `schemas.merged` for the reader's side).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import all_of, among, marked, same_ids
from fusion_service.centre.sources import Source
from fusion_service.config import CentreConfig
from fusion_service.records import altered
from schemas import GlobalTracks, tracks_at

__all__ = ["Deltas", "fed"]

COLUMNS = ("status", "updated", "marks", "number", "contributor_counts")
TEXTS = ("identity", "kind", "callsign")


def fed(sources: Iterable[Source]) -> NDArray[np.uint64]:
    """The global ids that what came in this step is linked to."""
    links = [np.zeros(0, dtype=np.uint64)]
    for source in sources:
        if source.arrived:
            came = np.concatenate(source.arrived)
            links.append(source.tracks.link[among(source.tracks.id, came)])
    return np.unique(np.concatenate(links))


class Deltas:
    """Remembers what was shown last; a centre made anew begins with a full picture."""

    def __init__(self, config: CentreConfig) -> None:
        self._period = round(config.period * 1e9)
        self._wanted = config.trigger == "arrival" and config.kind == "tracks"
        self._shown: GlobalTracks | None = None

    def of(self, picture: GlobalTracks, sources: Iterable[Source]) -> GlobalTracks:
        """What is published of a picture after a step of these sources: itself, or a delta."""
        if not self._wanted:
            return picture
        before, self._shown = self._shown, picture
        if before is None or picture.revised is not None or picture.time // self._period != before.time // self._period:
            return picture
        ended = np.array([track for track, _, _ in picture.ended], dtype=np.uint64)
        same = same_ids(before.ids, picture.ids)
        gone = before.ids[:0] if same else np.setdiff1d(before.ids, picture.ids, assume_unique=True)
        if (before.space, before.frame) != (picture.space, picture.frame) or not among(gone, ended).all():
            return picture
        which = among(picture.ids, fed(sources))
        if all_of(which):
            return altered(picture, delta=True)
        rows = marked(which | changed(before, picture))
        return altered(tracks_at(picture, rows), delta=True)


def changed(before: GlobalTracks, after: GlobalTracks) -> NDArray[np.bool_]:
    """(T,): tracks of `after` that are not in `before`, or differ in more than what a prediction changes. Both are
    sorted by id."""
    at = np.arange(len(after.ids)) if same_ids(before.ids, after.ids) else before.ids.searchsorted(after.ids)
    known = np.minimum(at, max(len(before.ids) - 1, 0))
    there = before.ids[known] == after.ids if len(before.ids) else np.zeros(len(after.ids), dtype=np.bool_)
    rows, old = marked(there), known[there]
    differs = np.zeros(len(rows), dtype=np.bool_)
    for name in COLUMNS:
        one, two = getattr(before, name), getattr(after, name)
        if one is None and two is None:
            continue
        one, two = (np.zeros(len(p.ids), np.uint8) if c is None else c for p, c in ((before, one), (after, two)))
        differs |= one[old] != two[rows]
    for name in TEXTS:
        texts, words = getattr(before, name), getattr(after, name)
        if texts is not None or words is not None:
            texts, words = texts or (None,) * len(before.ids), words or (None,) * len(after.ids)
            pairs = zip(old.tolist(), rows.tolist(), strict=True)
            differs |= np.array([texts[k] != words[row] for k, row in pairs], dtype=np.bool_)
    differs |= _members(before)[old] != _members(after)[rows]
    out = ~there
    out[rows] = differs
    return out


def _members(picture: GlobalTracks) -> NDArray[np.uint64]:
    """(T,): a sum over each track's contributors that differs where they do (but by an accident of 2^-64)."""
    names = np.array([hash_of(name) for name in picture.sources] or [0], dtype=np.uint64)
    code = names[picture.contributor_source] + picture.contributor_epoch * np.uint64(0x9E3779B97F4A7C15)
    code = (code ^ (picture.contributor_id * np.uint64(0xC2B2AE3D27D4EB4F))) * np.uint64(0xFF51AFD7ED558CCD)
    code ^= code >> np.uint64(33)
    sums = np.concatenate([np.zeros(1, dtype=np.uint64), np.cumsum(code, dtype=np.uint64)])
    ends = np.cumsum(picture.contributor_counts, dtype=np.intp)
    return np.asarray(sums[ends] - sums[ends - picture.contributor_counts], dtype=np.uint64)


def hash_of(name: str) -> int:
    """A number for a name, the same in every process."""
    return int.from_bytes(name.encode()[-8:].rjust(8, b"\0"), "little") * 0x9E3779B1 % 2**64
