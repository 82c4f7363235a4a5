"""Orders from the page: what can be ordered, in words for its dialog, and how a request of it becomes an order."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from fusion_service.order import NEEDED, STATES, WHAT, read_order

__all__ = ["ABOUT_SOURCE", "ABOUT_TRACK", "order_request", "orders_offered"]

ABOUT_TRACK = ("rename", "identify", "merge", "link", "unlink", "split", "never-link", "delete")
ABOUT_SOURCE = ("mute", "unmute", "quarantine", "release", "supervise", "drop")
ALLOWED = (
    *("what", "track", "other", "local", "against", "source", "name", "shown", "identity", "state"),
    *("number", "who", "why", "for"),
)
LONGEST_STAND = 1e9
"""Seconds."""


def orders_offered() -> dict[str, Any]:
    """By word: what it means, what it needs; and which are about a track, and about a source."""
    words = {word: {"says": WHAT[word], "needs": list(NEEDED.get(word, ()))} for word in WHAT}
    return {"words": words, "track": ABOUT_TRACK, "source": ABOUT_SOURCE, "states": [*STATES, "auto"]}


def order_request(raw: Mapping[str, Any], who: str = "") -> dict[str, Any]:
    """The request that a centre gets for what a page sends; who: of the operator's certificate, before what the page
    says. `ValueError` in one line where it is no order, or does not say who gives it."""
    unknown = [name for name in raw if name not in ALLOWED]
    if unknown:
        raise ValueError(f"an order has no {unknown[0][:40]!r}")
    said = {name: value for name, value in raw.items() if value is not None}
    if said.get("what") == "list":
        return {"what": "list"}
    if who:
        said["who"] = who
    if not isinstance(said.get("who"), str) or not said["who"].strip():
        raise ValueError("an order says who gives it")
    seconds = said.get("for")
    good = isinstance(seconds, (int, float)) and not isinstance(seconds, bool) and math.isfinite(seconds)
    if seconds is not None and not (good and 0 < seconds <= LONGEST_STAND):
        raise ValueError("the order's for: must be seconds above 0")
    tracks = ("track", "other")
    order = read_order({name: value for name, value in said.items() if name not in (*tracks, "for")})
    if order.what not in WHAT:
        raise ValueError(f"there is no order {order.what[:40]!r}: {', '.join(WHAT)}")
    missing = [name for name in NEEDED.get(order.what, ()) if name not in said]
    if missing:
        raise ValueError(f"the order {order.what} needs: {', '.join(missing)}")
    for name in tracks:
        if name in said and not (isinstance(said[name], str) and 0 < len(said[name]) <= 80):
            raise ValueError(f"the order's {name}: must be the id, number or callsign of a track, as a text")
    for name in ("local", "against"):
        if name in said:
            local = getattr(order, name)
            said[name] = [local.source, local.epoch, local.id]
    return said
