"""What was meant by a name in an order that is none, and which there are, in the words of who gives orders."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from fusion_service.centre import Order, View
from fusion_service.hints.words import did_you_mean
from fusion_service.service.promises import Reply

__all__ = ["advised", "find_track", "suggestion"]

COUNTERS = 2**32
LISTED = 8


def find_track(name: Any, view: View) -> int:
    """The global id that a whole id, a number or callsign given by an order, or the short number of a recording (7,
    2.7) names. `LookupError` in one line where it is none, or several."""
    text = str(name).strip()
    given = _given(view)
    if text in given:
        return given[text]
    match = re.fullmatch(r"(?:(\d{1,10})\.)?(\d{1,20})", text, flags=re.ASCII)
    ids: NDArray[np.uint64] = view.ids
    found = ids[:0]
    if match and int(match[2]) < 2**64:
        number = int(match[2])
        found = ids[ids == np.uint64(number)] if not match[1] else found
        if not len(found) and number < COUNTERS:
            found = ids[ids % np.uint64(COUNTERS) == np.uint64(number)]
    if len(found) == 1:
        return int(found[0])
    if len(found):
        known = ", ".join(str(one) for one in found[:LISTED].tolist())
        raise LookupError(f"{text} is several tracks: {known}: give the whole id")
    alike = {one for called, one in given.items() if called.casefold() == text.casefold()}
    if len(alike) == 1:
        return alike.pop()
    raise LookupError(f"there is no track {text}: known are {_tracks(view)}{did_you_mean(text, given)}")


def _given(view: View) -> dict[str, int]:
    """Numbers and callsigns that orders have given, of tracks."""
    found: dict[str, int] = {}
    for one in view.standing.values():
        if one.order.what == "rename" and one.order.track:
            for called in (one.order.name, str(one.order.shown or "")):
                if called:
                    found.setdefault(called, one.order.track)
    return found


def _tracks(view: View) -> str:
    """The tracks that there are, as they are shown: by the number that an order gave, or their short one where that is
    one track's alone, and their callsign."""
    renamed = {one.order.track: one.order for one in view.standing.values() if one.order.what == "rename"}
    ids = view.ids.tolist()
    often = Counter(one % COUNTERS for one in ids)
    told = []
    for one in ids[:LISTED]:
        order = renamed.get(one)
        short = one % COUNTERS if often[one % COUNTERS] == 1 else one
        number = str((order.shown if order is not None else 0) or short)
        told.append(f"{number} ({order.name})" if order is not None and order.name else number)
    return (", ".join(told) or "none") + (" ..." if len(ids) > LISTED else "")


def suggestion(order: Order, view: View) -> str:
    """Which source was meant by one that is not known; "" where none, or a known one, is named."""
    names = [order.source, *(one.source for one in (order.local, order.against) if one is not None)]
    unknown = [name for name in names if name and name not in view.sources]
    return next((hint for name in unknown if (hint := did_you_mean(name, sorted(view.sources)))), "")


def advised(order: Order, view: View, reply: Reply) -> Reply:
    """`reply`, after which who muted a source that nobody knows hears which there are: it may be meant so."""
    if not order.source or order.source in view.sources or order.what not in ("mute", "quarantine"):
        return reply
    if not view.sources:
        return reply
    known = ", ".join(sorted(view.sources)[:LISTED])
    more = " ..." if len(view.sources) > LISTED else ""
    return _adding(f" (known are {known}{more}){did_you_mean(order.source, sorted(view.sources))}", reply)


def _adding(advice: str, reply: Reply) -> Callable[[bytes | Exception], None]:
    def told(answer: bytes | Exception) -> None:
        if isinstance(answer, bytes):
            said = msgpack.unpackb(answer)
            answer = msgpack.packb({**said, "outcome": f"{said['outcome']}{advice}"})
        reply(answer)

    return told
