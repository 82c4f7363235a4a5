"""Sources, tables and frames as plain values for a checkpoint: columns as bin of little-endian numbers."""

from __future__ import annotations

from collections import deque
from dataclasses import fields
from typing import Any, TypeVar, cast

import numpy as np

from fusion_service.arrays import from_bytes, to_bytes
from fusion_service.centre.frames import Vote
from fusion_service.centre.intervals import NOTHING_REMEMBERED, Remembered
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.places import Place
from fusion_service.centre.sources import Source
from fusion_service.centre.tracks import Tracks, empty_tracks, padded
from schemas import Ecef, Enu, Frame, Local, SensorInfo, decode, encode
from schemas.platform import pack_platform, read_platform

__all__ = ["pack_columns", "pack_frame", "pack_source", "unpack_columns", "unpack_frame", "unpack_source"]

MISSING: dict[str, float] = {
    **dict.fromkeys(("since", "used", "judged", "weighed", "seen", "told", "last_hit", "due"), -1),
    "identity": -1,
    "motion": -1,
    "lineage": -1,
    "kind": -1,
    "kind_p": np.nan,
}
"""What columns hold that may not be in a checkpoint of an earlier release; others hold 0."""
_PLAIN = (
    *("epoch", "alive", "muted", "last", "complete", "offset", "messages", "repeats", "gaps", "reordered"),
    *("origin", "waited", "highest", "first", "interval", "why", "unused", "lag"),
)
_LATER = ("interval", "why", "unused", "lag")
"""What a checkpoint of an earlier release does not hold."""
Columns = TypeVar("Columns", Tracks, Picture)


def pack_source(source: Source) -> dict[str, Any]:
    """A source."""
    packed = {name: getattr(source, name) for name in _PLAIN}
    packed["space"] = list(source.space)
    packed["seen"] = [*source.seen]
    packed["info"] = None if source.info is None else encode(source.info)
    packed["tracks"] = pack_columns(source.tracks)
    packed["remembered"] = [to_bytes(column) for column in source.remembered]
    if source.vote is not None:
        packed["vote"] = [pack_frame(source.vote.frame), list(source.vote.space), source.vote.time]
    packed["places"] = [_pack_place(one) for one in source.places]
    return packed


def unpack_source(name: str, packed: dict[str, Any]) -> Source:
    """What `pack_source` gave; raises where it is something else."""
    space = tuple(packed["space"])
    source = Source(name, space, unpack_columns(packed["tracks"], empty_tracks(len(space))))
    for plain in _PLAIN:
        if plain in packed or plain not in _LATER:
            setattr(source, plain, packed[plain])
    if "remembered" in packed:
        kinds = NOTHING_REMEMBERED
        columns = [from_bytes(one, like) for one, like in zip(packed["remembered"], kinds, strict=False)]
        if len(columns) < len(kinds):  # of an earlier release
            columns.append(np.zeros(len(columns[0]), dtype=np.uint64))
        source.remembered = Remembered(*columns)
    if "vote" in packed:
        spoken, names, time = packed["vote"]
        source.vote = Vote(unpack_frame(spoken) or Local("none"), tuple(names), time)
    source.places = tuple(_unpack_place(one) for one in packed.get("places", []))
    source.seen = deque((kind, seq, code) for kind, seq, code in packed["seen"])
    source.seen_set = set(source.seen)
    if packed["info"] is not None:
        info = decode(packed["info"])
        if not isinstance(info, SensorInfo):
            raise ValueError("another message where sensor info belongs")
        source.info = info
    return source


def _pack_place(place: Place) -> list[Any]:
    return [place.time, pack_frame(place.frame), pack_platform(place.platform)]


def _unpack_place(packed: list[Any]) -> Place:
    return Place(packed[0], unpack_frame(packed[1]) or Local("none"), read_platform(packed[2]))


def pack_columns(columns: Tracks | Picture) -> dict[str, Any]:
    """The columns of a table."""
    packed: dict[str, Any] = {"components": len(columns.log_weight)}
    for one in fields(columns):
        column = getattr(columns, one.name)
        packed[one.name] = np.ascontiguousarray(column, column.dtype.newbyteorder("<")).data  # packed uncopied
    return packed


def unpack_columns(packed: dict[str, Any], like: Columns) -> Columns:
    """What `pack_columns` gave, of the kind of the empty table `like`."""
    like = padded(like, packed["components"])
    count = len(packed["id"]) // 8
    arrays = []
    for one in fields(like):
        empty = getattr(like, one.name)
        if one.name in packed:
            flat = from_bytes(packed[one.name], empty)
        else:
            flat = np.full(count, MISSING.get(one.name, 0)).astype(empty.dtype)
        if one.name == "extent":
            held = len(flat) // max(count, 1) if one.name in packed else 0
            empty, flat = np.zeros((held, 0)), flat[: held * count]
        arrays.append(flat.reshape(*empty.shape[:-1], count))
    return type(like)(*arrays)


def pack_frame(frame: Frame | None) -> list[Any] | None:
    """A frame, or none."""
    if frame is None:
        return None
    return [frame.kind, *(getattr(frame, one.name) for one in fields(frame))]


def unpack_frame(packed: list[Any] | None) -> Frame | None:
    """What `pack_frame` gave."""
    if packed is None:
        return None
    kinds: dict[str, Any] = {"enu": Enu, "ecef": Ecef, "local": Local}
    return cast(Frame, kinds[packed[0]](*packed[1:]))
