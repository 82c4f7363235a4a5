"""The whole state of a centre as versioned MessagePack: columns as bin of little-endian numbers.

It holds sources with their sequence positions, orders, links and tracks, the global tracks, and the next id.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import msgpack

from fusion_service.centre.lifecycle import Picture, empty_picture
from fusion_service.centre.packing import (
    pack_columns,
    pack_frame,
    pack_source,
    unpack_columns,
    unpack_frame,
    unpack_source,
)
from fusion_service.centre.resting import Resting
from fusion_service.centre.restoring import fit_config
from fusion_service.centre.sources import Source
from fusion_service.centre.words import Lexicon, Words
from fusion_service.errors import FusionError
from fusion_service.order import Order

if TYPE_CHECKING:
    from fusion_service.centre.intake import Intake
    from fusion_service.centre.labels import Labels

__all__ = ["CHECKPOINT_VERSION", "CheckpointError", "Glance", "glance", "pack_state", "unpack_state"]

CHECKPOINT_VERSION = 2
READABLE = (1, 2)
_ROOM = threading.local()
"""What packs, whose buffer, once it has grown to the size of a checkpoint, is there for the next one."""
NO_ERA = (0, -1, -1, 0, -1, -1)


class CheckpointError(FusionError, ValueError):
    """A checkpoint that cannot be used, and why, in one line."""


def pack_state(config_hash: str, state: dict[str, Any], intake: Intake, labels: Labels, picture: Picture) -> bytes:
    """The bytes of a checkpoint."""
    whole = {
        "v": CHECKPOINT_VERSION,
        "config_hash": config_hash,
        "kind": intake.config.kind,
        "frame": pack_frame(intake.frame),
        "frame_asked": intake.voting.asked,
        "sources": {name: pack_source(source) for name, source in sorted(intake.sources.items())},
        "resting": {name: one.kept() for name, one in sorted(intake.resting.items())},
        "picture": pack_columns(picture),
        "orders": intake.orders.kept(),
        "labels": labels.kept(),
        "said": [words.texts for words in intake.said],
        "lineages": intake.lineages.kept(),
        "awake": intake.spared.awake,
        **state,
    }
    if not hasattr(_ROOM, "packer"):
        _ROOM.packer = msgpack.Packer()
    return cast(bytes, _ROOM.packer.pack(whole))


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
        was, frame = tuple(whole["space"]), unpack_frame(whole["frame"])
        sources = {name: unpack_source(name, packed) for name, packed in whole["sources"].items()}
        picture = unpack_columns(whole["picture"], empty_picture(len(was)))
        resting = {name: Resting.from_checkpoint(name, kept) for name, kept in whole.get("resting", {}).items()}
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
    intake.resting = resting
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
