"""The whole state of a centre as versioned MessagePack: columns as bin of little-endian numbers.

It holds sources with their sequence positions, orders, links and tracks, the global tracks, and the next id.
"""

from __future__ import annotations

from collections import deque
from dataclasses import fields
from typing import TYPE_CHECKING, Any, TypeVar, cast

import msgpack
import numpy as np

from fusion_service.centre.lifecycle import Picture, empty_picture
from fusion_service.centre.sources import Source, Tracks, empty_tracks, padded
from fusion_service.centre.words import Lexicon, Words
from schemas import Ecef, Enu, Frame, Local, SensorInfo, decode, encode

if TYPE_CHECKING:
    from fusion_service.centre.intake import Intake
    from fusion_service.centre.labels import Labels

__all__ = ["CHECKPOINT_VERSION", "CheckpointError", "pack_state", "unpack_state"]

CHECKPOINT_VERSION = 1
_PLAIN = (
    *("epoch", "alive", "muted", "last", "complete", "offset", "messages", "repeats", "gaps", "reordered"),
    *("origin", "waited", "highest", "first"),
)
_ADDED: dict[str, float] = {"identity": -1, "kind": -1, "kind_p": np.nan, "origin": 0, "told": -1}
"""Columns that a checkpoint of this version may lack, and what they then hold."""
Columns = TypeVar("Columns", Tracks, Picture)


class CheckpointError(ValueError):
    """A checkpoint that cannot be used, and why, in one line."""


def pack_state(config_hash: str, state: dict[str, Any], intake: Intake, labels: Labels, picture: Picture) -> bytes:
    """The bytes of a checkpoint."""
    whole = {
        "v": CHECKPOINT_VERSION,
        "config_hash": config_hash,
        "kind": intake.config.kind,
        "frame": _pack_frame(intake.frame),
        "sources": {name: _pack_source(source) for name, source in sorted(intake.sources.items())},
        "picture": _pack_columns(picture),
        "orders": intake.orders.kept(),
        "labels": labels.kept(),
        "said": [words.texts for words in intake.said],
        **state,
    }
    return cast(bytes, msgpack.packb(whole))


def unpack_state(blob: bytes, intake: Intake, labels: Labels, space: tuple[str, ...]) -> tuple[dict[str, Any], Picture]:
    """Fill the intake, and return the rest and the picture. `CheckpointError` if it does not fit this centre."""
    try:
        whole = msgpack.unpackb(blob)
        version = whole["v"]
        if version != CHECKPOINT_VERSION:
            raise CheckpointError(f"the checkpoint is of version {version}, this is {CHECKPOINT_VERSION}")
        if whole.get("kind", "tracks") != intake.config.kind:
            raise CheckpointError(f"the checkpoint is of a centre that fuses {whole['kind']}, not {intake.config.kind}")
        if tuple(whole["space"]) != space:
            raise CheckpointError("the checkpoint is in another state space than the config")
        frame = _unpack_frame(whole["frame"])
        if intake.config.frame is not None and frame not in (None, intake.config.frame):
            raise CheckpointError("the checkpoint is in another frame than the config")
        sources = {name: _unpack_source(name, packed) for name, packed in whole["sources"].items()}
        picture = _unpack_columns(whole["picture"], empty_picture(len(space)))
        numbers = {name: int(whole[name]) for name in ("step", "time", "next_id")}
        agreeing = {(int(a), int(b)): int(count) for a, b, count in whole["agreeing"]}
        if "orders" in whole:
            intake.orders.restore(whole["orders"])
        if "labels" in whole:
            labels.restore(whole["labels"])
        intake.said = Lexicon(*(Words(texts) for texts in whole.get("said", [[], []])))
    except CheckpointError:
        raise
    except Exception as error:
        raise CheckpointError(f"the checkpoint cannot be read: {type(error).__name__}: {error}") from None
    intake.frame, intake.sources = frame or intake.config.frame, sources
    intake.mute()
    return {**numbers, "agreeing": agreeing}, picture


def _pack_source(source: Source) -> dict[str, Any]:
    packed = {name: getattr(source, name) for name in _PLAIN}
    packed["space"] = list(source.space)
    packed["seen"] = [list(key) for key in source.seen]
    packed["info"] = None if source.info is None else encode(source.info)
    packed["tracks"] = _pack_columns(source.tracks)
    return packed


def _unpack_source(name: str, packed: dict[str, Any]) -> Source:
    space = tuple(packed["space"])
    source = Source(name, space, _unpack_columns(packed["tracks"], empty_tracks(len(space))))
    for plain in _PLAIN:
        setattr(source, plain, packed[plain])
    source.seen = deque((kind, seq, code) for kind, seq, code in packed["seen"])
    source.seen_set = set(source.seen)
    if packed["info"] is not None:
        info = decode(packed["info"])
        if not isinstance(info, SensorInfo):
            raise CheckpointError("the checkpoint holds another message where sensor info belongs")
        source.info = info
    return source


def _pack_columns(columns: Tracks | Picture) -> dict[str, Any]:
    packed: dict[str, Any] = {"components": len(columns.log_weight)}
    for one in fields(columns):
        array = getattr(columns, one.name)
        packed[one.name] = np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()
    return packed


def _unpack_columns(packed: dict[str, Any], like: Columns) -> Columns:
    like = padded(like, packed["components"])
    count = len(packed["id"]) // 8
    arrays = []
    for one in fields(like):
        empty = getattr(like, one.name)
        if one.name not in packed and one.name in _ADDED:
            arrays.append(np.full(count, _ADDED[one.name]).astype(empty.dtype))
            continue
        flat = np.frombuffer(packed[one.name], dtype=empty.dtype.newbyteorder("<")).astype(empty.dtype)
        arrays.append(flat.reshape(*empty.shape[:-1], count))
    return type(like)(*arrays)


def _pack_frame(frame: Frame | None) -> list[Any] | None:
    if frame is None:
        return None
    return [frame.kind, *(getattr(frame, one.name) for one in fields(frame))]


def _unpack_frame(packed: list[Any] | None) -> Frame | None:
    if packed is None:
        return None
    kinds: dict[str, Any] = {"enu": Enu, "ecef": Ecef, "local": Local}
    return cast(Frame, kinds[packed[0]](*packed[1:]))
