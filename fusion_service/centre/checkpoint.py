"""The whole state of a centre as versioned MessagePack: columns as bin of little-endian numbers.

It holds sources with their sequence positions, orders, links and tracks, the global tracks, and the next id.
"""

from __future__ import annotations

from collections import deque
from dataclasses import fields
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

import msgpack
import numpy as np

from fusion_service.arrays import from_bytes, to_bytes
from fusion_service.centre.frames import Vote
from fusion_service.centre.intervals import NOTHING_REMEMBERED, Remembered
from fusion_service.centre.lifecycle import Picture, empty_picture
from fusion_service.centre.places import Place
from fusion_service.centre.restoring import fit_config
from fusion_service.centre.sources import Source
from fusion_service.centre.tracks import Tracks, empty_tracks, padded
from fusion_service.centre.words import Lexicon, Words
from fusion_service.errors import FusionError
from fusion_service.order import Order
from schemas import Ecef, Enu, Frame, Local, SensorInfo, decode, encode
from schemas.platform import pack_platform, read_platform

if TYPE_CHECKING:
    from fusion_service.centre.intake import Intake
    from fusion_service.centre.labels import Labels

__all__ = ["CHECKPOINT_VERSION", "CheckpointError", "Glance", "glance", "pack_state", "unpack_state"]

CHECKPOINT_VERSION = 2
READABLE = (1, 2)
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
NO_ERA = (0, -1, -1, 0, -1, -1)
Columns = TypeVar("Columns", Tracks, Picture)


class CheckpointError(FusionError, ValueError):
    """A checkpoint that cannot be used, and why, in one line."""


def pack_state(config_hash: str, state: dict[str, Any], intake: Intake, labels: Labels, picture: Picture) -> bytes:
    """The bytes of a checkpoint."""
    whole = {
        "v": CHECKPOINT_VERSION,
        "config_hash": config_hash,
        "kind": intake.config.kind,
        "frame": _pack_frame(intake.frame),
        "frame_asked": intake.voting.asked,
        "sources": {name: _pack_source(source) for name, source in sorted(intake.sources.items())},
        "picture": _pack_columns(picture),
        "orders": intake.orders.kept(),
        "labels": labels.kept(),
        "said": [words.texts for words in intake.said],
        "lineages": intake.lineages.kept(),
        "awake": intake.spared.awake,
        **state,
    }
    return cast(bytes, msgpack.packb(whole))


def unpack_state(blob: bytes, intake: Intake, labels: Labels) -> tuple[dict[str, Any], Picture]:
    """Fill intake and labels, and return the rest and the picture, in the space and frame of the config.
    `CheckpointError` if it is of another kind of centre, or cannot be read."""
    try:
        whole = msgpack.unpackb(blob)
        version = whole["v"]
        if version not in READABLE:
            raise CheckpointError(f"the checkpoint is of version {version}, this is {CHECKPOINT_VERSION}")
        if whole.get("kind", "tracks") != intake.config.kind:
            raise CheckpointError(f"the checkpoint is of a centre that fuses {whole['kind']}, not {intake.config.kind}")
        was, frame = tuple(whole["space"]), _unpack_frame(whole["frame"])
        sources = {name: _unpack_source(name, packed) for name, packed in whole["sources"].items()}
        picture = _unpack_columns(whole["picture"], empty_picture(len(was)))
        picture = fit_config(sources, picture, was, frame, intake.config)
        asked = int(whole.get("frame_asked", -1))
        era = [int(part) for part in whole.get("era", NO_ERA)]
        numbers = {name: int(whole[name]) for name in ("step", "time", "next_id")}
        _restore_words(whole, sources, intake, labels)
    except CheckpointError:
        raise
    except Exception as error:
        raise CheckpointError(f"the checkpoint cannot be read: {type(error).__name__}: {error}") from None
    intake.frame, intake.sources, intake.voting.asked = intake.config.frame or frame, sources, asked
    intake.spared.awake = int(whole.get("awake", -1))
    intake.mute()
    promised = whole.get("promised", {"since": -1, "ids": []})
    return {**numbers, "era": era, "own": whole.get("own"), "promised": promised}, picture


class Glance(NamedTuple):
    """Of a checkpoint: the time of its step, ns, -1 before the first, and the generation of the newest id given."""

    time: int
    generation: int


def glance(blob: bytes) -> Glance:
    """What a checkpoint says at a glance; (-1, 0) of one that cannot be read."""
    try:
        whole = msgpack.unpackb(blob)
        time, following = int(whole["time"]), int(whole["next_id"])
    except Exception:
        return Glance(-1, 0)
    return Glance(time, following >> 32) if 0 <= following < 2**64 else Glance(-1, 0)


def _restore_words(whole: dict[str, Any], sources: dict[str, Source], intake: Intake, labels: Labels) -> None:
    """What was ordered and said. In a checkpoint of an earlier release a muted source is all there is of orders."""
    intake.lineages.restore(whole.get("lineages", {"names": [], "sets": []}))
    intake.said = Lexicon(*(Words(texts) for texts in whole.get("said", [[], []])))
    if "labels" in whole:
        labels.restore(whole["labels"])
    if "orders" in whole:
        intake.orders.restore(whole["orders"])
        return
    for name, source in sorted(sources.items()):
        if source.muted and not intake.config.source(name).ignore:
            intake.orders.stand(intake.orders.numbered(Order("mute", name)))


def _pack_source(source: Source) -> dict[str, Any]:
    packed = {name: getattr(source, name) for name in _PLAIN}
    packed["space"] = list(source.space)
    packed["seen"] = [*source.seen]
    packed["info"] = None if source.info is None else encode(source.info)
    packed["tracks"] = _pack_columns(source.tracks)
    packed["remembered"] = [to_bytes(column) for column in source.remembered]
    if source.vote is not None:
        packed["vote"] = [_pack_frame(source.vote.frame), list(source.vote.space), source.vote.time]
    packed["places"] = [_pack_place(one) for one in source.places]
    return packed


def _unpack_source(name: str, packed: dict[str, Any]) -> Source:
    space = tuple(packed["space"])
    source = Source(name, space, _unpack_columns(packed["tracks"], empty_tracks(len(space))))
    for plain in _PLAIN:
        if plain in packed or plain not in _LATER:
            setattr(source, plain, packed[plain])
    if "remembered" in packed:
        kinds = NOTHING_REMEMBERED
        columns = [from_bytes(one, like) for one, like in zip(packed["remembered"], kinds, strict=False)]
        if len(columns) < len(kinds):  # of an earlier release
            columns.append(np.zeros_like(columns[0]))
        source.remembered = Remembered(*columns)
    if "vote" in packed:
        spoken, names, time = packed["vote"]
        source.vote = Vote(_unpack_frame(spoken) or Local("none"), tuple(names), time)
    source.places = tuple(_unpack_place(one) for one in packed.get("places", []))
    source.seen = deque((kind, seq, code) for kind, seq, code in packed["seen"])
    source.seen_set = set(source.seen)
    if packed["info"] is not None:
        info = decode(packed["info"])
        if not isinstance(info, SensorInfo):
            raise CheckpointError("the checkpoint holds another message where sensor info belongs")
        source.info = info
    return source


def _pack_place(place: Place) -> list[Any]:
    return [place.time, _pack_frame(place.frame), pack_platform(place.platform)]


def _unpack_place(packed: list[Any]) -> Place:
    return Place(packed[0], _unpack_frame(packed[1]) or Local("none"), read_platform(packed[2]))


def _pack_columns(columns: Tracks | Picture) -> dict[str, Any]:
    packed: dict[str, Any] = {"components": len(columns.log_weight)}
    for one in fields(columns):
        column = getattr(columns, one.name)
        packed[one.name] = np.ascontiguousarray(column, column.dtype.newbyteorder("<")).data  # packed uncopied
    return packed


def _unpack_columns(packed: dict[str, Any], like: Columns) -> Columns:
    like = padded(like, packed["components"])
    count = len(packed["id"]) // 8
    arrays = []
    for one in fields(like):
        empty = getattr(like, one.name)
        blank = np.full(count, MISSING.get(one.name, 0)).astype(empty.dtype)
        flat = blank if one.name not in packed else from_bytes(packed[one.name], empty)
        if one.name == "extent":
            held = len(flat) // max(count, 1) if one.name in packed else 0
            empty, flat = np.zeros((held, 0)), flat[: held * count]
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
