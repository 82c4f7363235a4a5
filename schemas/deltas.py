"""Pictures that hold only what has changed (`GlobalTracks.delta`), and the whole that they make together.

Everything of a track stands in the newest picture that lists it: its density holds at the time of that one. So the
whole after a delta may hold densities of several times, none older than the last full picture.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.messages import ORIGINS, GlobalTracks

__all__ = ["Wholes", "merged", "tracks_at"]

MOST_CENTRES = 64

TEXTS = ("identity", "kind", "callsign")
PER_TRACK = ("ids", "status", "existence", "updated", "contributor_counts")
OPTIONAL: dict[str, tuple[Any, Any, tuple[int, ...]]] = {
    "identity_p": (np.float64, 0.0, ()),
    "kind_p": (np.float64, 0.0, ()),
    "marks": (np.uint8, 0, ()),
    "number": (np.uint32, 0, ()),
    "extent": (np.float64, np.nan, (3,)),
    "extent_sigma": (np.float64, np.nan, (3,)),
}
"""Columns that may be absent: their type, what absence means, and their numbers a track."""
PER_CONTRIBUTION = ("contributor_source", "contributor_epoch", "contributor_id", "contributor_influence")


class Wholes:
    """The whole picture of each centre, of at most `MOST_CENTRES`."""

    def __init__(self) -> None:
        self._newest: dict[str, GlobalTracks] = {}

    def of(self, message: GlobalTracks) -> GlobalTracks | None:
        """The whole after the next picture of a centre, as `merged` has it."""
        whole = merged(self._newest.get(message.source), message)
        if whole is not None and (message.source in self._newest or len(self._newest) < MOST_CENTRES):
            self._newest[message.source] = whole
        return whole


def merged(before: GlobalTracks | None, message: GlobalTracks) -> GlobalTracks | None:
    """The whole picture after `message`, `before` being that before it: `message` itself if it is full; else the tracks
    that it lists, and those of `before` that it neither lists nor ends. None where there is nothing to begin with: no
    full picture of this run of the centre, in this space and frame, came before."""
    if not message.delta:
        return message
    if before is None or before.delta or _run(before) != _run(message):
        return None
    ended = np.array([track for track, _, _ in message.ended], dtype=np.uint64)
    left = ~np.isin(before.ids, np.concatenate([message.ids, ended]))
    whole = _joined(tracks_at(before, np.flatnonzero(left)), message)
    return tracks_at(whole, np.argsort(whole.ids, kind="stable"))


def tracks_at(picture: GlobalTracks, rows: NDArray[np.intp]) -> GlobalTracks:
    """The picture with the tracks of these rows alone, in this order."""
    columns: dict[str, Any] = {name: getattr(picture, name)[rows] for name in PER_TRACK}
    for name in (*OPTIONAL, "track_rule", "track_origin", "track_lineage"):
        if (column := getattr(picture, name)) is not None:
            columns[name] = column[rows]
    for name in TEXTS:
        if (texts := getattr(picture, name)) is not None:
            columns[name] = tuple(texts[row] for row in rows.tolist())
    parts = rows
    if picture.counts is not None and picture.weights is not None:
        parts = _spread(picture.counts, rows)
        columns |= {"counts": picture.counts[rows], "weights": picture.weights[parts]}
    columns |= {"means": picture.means[parts], "covariances": picture.covariances[parts]}
    given = _spread(picture.contributor_counts, rows)
    return replace(picture, **columns, **{name: getattr(picture, name)[given] for name in PER_CONTRIBUTION})


def _run(picture: GlobalTracks) -> tuple[object, ...]:
    return picture.source, picture.epoch, picture.space, picture.frame


def _spread(counts: NDArray[np.uint16], rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Where the parts of these rows stand, `counts` of each track one after another."""
    ends = np.cumsum(counts, dtype=np.intp)
    some = counts[rows].astype(np.intp)
    return np.repeat(ends[rows] - np.cumsum(some), some) + np.arange(some.sum())


def _joined(old: GlobalTracks, new: GlobalTracks) -> GlobalTracks:
    """Tracks of both, the rest of `new`, which is a picture of its own: no delta."""
    both = old, new
    columns: dict[str, Any] = {name: _stacked(both, name) for name in (*PER_TRACK, *PER_CONTRIBUTION[1:])}
    columns |= {"means": _stacked(both, "means"), "covariances": _stacked(both, "covariances"), "delta": None}
    for name, (kind, absent, shape) in OPTIONAL.items():
        columns |= _filled(both, name, *(np.full((len(one.ids), *shape), absent, dtype=kind) for one in both))
    codes = (np.full(len(one.ids), ORIGINS.index(one.origin), dtype=np.uint8) for one in both)
    columns |= _filled(both, "track_origin", *codes) if old.origin != new.origin else {}
    if old.origin == new.origin and (old.track_origin is not None or new.track_origin is not None):
        codes = (np.full(len(one.ids), ORIGINS.index(one.origin), dtype=np.uint8) for one in both)
        columns |= _filled(both, "track_origin", *codes)
    for name in TEXTS:
        if any(getattr(one, name) is not None for one in both):
            columns[name] = sum((getattr(one, name) or (None,) * len(one.ids) for one in both), ())
    if any(one.counts is not None for one in both):
        columns |= _filled(both, "counts", *(np.ones(len(one.ids), dtype=np.uint16) for one in both))
        columns |= _filled(both, "weights", *(np.ones(len(one.means)) for one in both))
    columns["sources"], numbers = _named([one.sources for one in both], [one.contributor_source for one in both])
    columns["contributor_source"] = numbers.astype(np.uint16)
    if any(one.rules is not None for one in both):
        ways = [(one.rules, one.track_rule) if one.rules else ((one.rule,), None) for one in both]
        codes_of = [
            np.zeros(len(one.ids), np.uint8) if way[1] is None else way[1] for one, way in zip(both, ways, strict=True)
        ]
        columns["rules"], numbers = _named([tuple(way[0]) for way in ways], codes_of)
        columns["track_rule"] = numbers.astype(np.uint8)
    columns["lineage"], columns["track_lineage"] = _lineages(both)
    columns["shape"] = new.shape or old.shape
    return replace(new, **columns)


def _stacked(both: tuple[GlobalTracks, GlobalTracks], name: str) -> NDArray[Any]:
    return np.concatenate([getattr(one, name) for one in both])


def _filled(both: tuple[GlobalTracks, GlobalTracks], name: str, *absent: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """A column where either has it."""
    there = [getattr(one, name) for one in both]
    if all(column is None for column in there):
        return {}
    parts = [none if column is None else column for column, none in zip(there, absent, strict=True)]
    return {name: np.concatenate(parts)}


def _named(names: list[tuple[str, ...]], codes: list[NDArray[Any]]) -> tuple[tuple[str, ...], NDArray[np.intp]]:
    """The names of both, those of the second first, and the codes of both as indices of them."""
    known = list(dict.fromkeys([*names[1], *names[0]]))
    place = {name: index for index, name in enumerate(known)}
    new = [
        np.array([place[name] for name in own] or [0], dtype=np.intp)[code]
        for own, code in zip(names, codes, strict=True)
    ]
    return tuple(known), np.concatenate(new)


def _lineages(both: tuple[GlobalTracks, GlobalTracks]) -> tuple[tuple[str, ...] | None, NDArray[np.uint8] | None]:
    """The lineage of both, and each track's bits of it."""
    names = [one.lineage if one.lineage is not None else (one.source,) for one in both]
    known = tuple(dict.fromkeys([*names[1], *names[0]]))
    if all(one.lineage is None for one in both):
        return None, None
    if all(one.track_lineage is None for one in both):
        return known, None
    rows = []
    for one, own in zip(both, names, strict=True):
        bits = np.zeros((len(one.ids), len(known)), dtype=np.uint8)
        if one.track_lineage is None:
            told = np.ones((len(one.ids), len(own)), dtype=np.uint8)
        else:
            told = np.unpackbits(one.track_lineage, axis=1, count=len(own), bitorder="little")
        bits[:, [known.index(name) for name in own]] = told
        rows.append(bits)
    return known, np.packbits(np.concatenate(rows), axis=1, bitorder="little")
