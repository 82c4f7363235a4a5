"""Orders of an operator as they come over the bus."""

from __future__ import annotations

import msgpack

from fusion_service.centre import Order
from schemas import check_name

__all__ = ["read_order"]


def read_order(payload: bytes | None) -> Order:
    """The order of a MessagePack map. Raises ValueError, which says how one is written; msgpack's own errors for what
    is no MessagePack are told to who asked, too."""
    raw = msgpack.unpackb(payload or b"\x80")
    if not isinstance(raw, dict) or raw.get("what") not in ("mute", "unmute", "delete"):
        raise ValueError('an order is a map: {"what": "mute" | "unmute" | "delete", "source" or "track": ...}')
    source, track = raw.get("source", ""), raw.get("track")
    if raw["what"] == "delete" and not (type(track) is int and 0 < track < 2**64):
        raise ValueError('the order delete needs the global id: {"what": "delete", "track": id}')
    if raw["what"] != "delete":
        if not isinstance(source, str):
            raise ValueError('the orders mute and unmute need a name: {"what": "mute", "source": name}')
        check_name(source)
    return Order(raw["what"], source, track)
