"""A source that has nothing to say rests: it is in no table, and costs nothing in a step (see `quieting`)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import msgpack

from fusion_service.centre.packing import pack_source, unpack_source
from fusion_service.centre.sources import Source
from fusion_service.centre.tracks import Tracks

__all__ = ["Resting", "gone"]

SAID = ("repeats", "gaps", "reordered")


@dataclass(frozen=True, slots=True, eq=False)
class Resting:
    """A source that rests. packed: what a checkpoint holds of it; since: the step with which it began to, ns; tracks:
    none; said: what the status says of it; the rest as in `Source`."""

    name: str
    packed: bytes
    since: int
    alive: bool | None
    origin: str
    last: int
    epoch: int
    messages: int
    tracks: Tracks
    said: dict[str, Any]

    @classmethod
    def of(cls, source: Source, since: int, packed: bytes | None = None) -> Resting:
        """`source`, from the step at `since` on."""
        packed = msgpack.packb(pack_source(source)) if packed is None else packed
        one = source
        said = {name: getattr(one, name) for name in ("alive", "muted", "last", "messages", *SAID)}
        said |= {"epoch": max(one.epoch, 0), "stale": True, "resting": True, "offset": one.offset / 1e9, "tracks": 0}
        said |= {"unused": dict(sorted(one.unused.items())), "note": one.why, "refused": {}}
        return cls(one.name, packed, since, one.alive, one.origin, one.last, one.epoch, one.messages, one.tracks, said)

    @classmethod
    def from_checkpoint(cls, name: str, kept: list[Any]) -> Resting:
        """From what `kept` gave."""
        packed, since = kept
        return cls.of(unpack_source(name, msgpack.unpackb(packed)), since, packed)

    def kept(self) -> list[Any]:
        """As plain values."""
        return [self.packed, self.since]

    def woken(self) -> Source:
        """The source as it was."""
        return unpack_source(self.name, msgpack.unpackb(self.packed))


def gone(sources: Iterable[Source], resting: Iterable[Resting], speaks: bool) -> list[str]:
    """Those who may go where there is no room: they have no tracks, and their token is not there, or, for one that
    speaks, is all that was ever seen of them. The longest silent last."""
    every: list[Source | Resting] = [*sources, *resting]
    found = [one for one in every if not len(one.tracks.id)]
    found = [one for one in found if one.alive is not True or (speaks and not one.messages)]
    return [one.name for one in sorted(found, key=lambda one: (one.last, one.name), reverse=True)]
