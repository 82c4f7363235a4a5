"""`Order`: what an operator tells a centre to do, and its forms in a request and in a step log.

An order is an event like any other: it is obeyed in the next step, told in its log with what it did or why not, and
obeyed again by who replays the log. Those that stand (a mute, a link, a hold) are kept in the checkpoint.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

__all__ = [
    "ABOUT",
    "MOST_NUMBER",
    "MOST_TEXT",
    "NEEDED",
    "STATES",
    "WHAT",
    "LocalId",
    "Order",
    "giver_of",
    "order_event",
    "order_of",
    "read_order",
]

MOST_NUMBER = 2**62
MOST_TEXT = 200
"""Characters of a text in an order."""
WHAT = {
    "delete": "end a global track; its local tracks start and join none until they end, or until a time",
    "link": "a local track belongs to a global track",
    "unlink": "a local track leaves its global track, and does not come back to it",
    "never-link": "a local track and a global track, or two local tracks, never belong together",
    "merge": "two global tracks are one: the first goes on",
    "split": "a local track leaves its global track and starts one of its own",
    "rename": "show a global track under a number or callsign",
    "identify": "say what a global track is",
    "mute": "refuse all that a source sends",
    "unmute": "take it again",
    "quarantine": "track a source apart: its tracks are fused with no other's",
    "release": "fuse them again",
    "drop": "forget the tracks of a source now",
    "supervise": "settle how far a source is trusted, or let the centre judge it again (state auto)",
    "withdraw": "take a standing order back, by its number",
}
"""The orders there are, and what each means."""
STATES = ("trusted", "watch", "inflated", "union", "out")
"""How far a source may be trusted, from as it is to not at all."""
_SOURCE, _LOCAL = ("source",), ("local",)
NEEDED = {
    **dict.fromkeys(("mute", "unmute", "quarantine", "release", "drop"), _SOURCE),
    **dict.fromkeys(("unlink", "never-link", "split"), _LOCAL),
    "delete": ("track",),
    "rename": ("track",),
    "identify": ("track", "identity"),
    "supervise": ("source", "state"),
    "withdraw": ("number",),
    "link": ("track", "local"),
    "merge": ("track", "other"),
}
"""What an order cannot do without."""
_INT = re.compile(r"\d{1,20}\Z", re.ASCII)


class LocalId(NamedTuple):
    """A local track. epoch: of its source's run; -1 for the one that is on."""

    source: str
    epoch: int
    id: int

    def __str__(self) -> str:
        return f"{self.source} {self.id}"


_PAIR = ("track", "local")
ABOUT = {
    **dict.fromkeys(("link", "unlink", "split"), _PAIR),
    "never-link": (*_PAIR, "against"),
    "rename": ("track", "name", "shown"),
    "identify": ("track", "identity"),
    "delete": (),
    **dict.fromkeys(("mute", "quarantine"), ("source",)),
    "supervise": ("source", "state"),
}
"""The orders that stand, and what of an order does (with who, why, until and number)."""


@dataclass(frozen=True, slots=True)
class Order:
    """An operator's order, one of `WHAT`.

    source: whom mute, unmute, quarantine, release, drop and supervise are about. track: the global id it is about;
    other: a second one (merge: the one that ends). local: a local track; against: a second one (never-link). name,
    shown, identity: what rename and identify give. state: what supervise settles, one of `STATES` or auto. number: the
    order's own (withdraw: that of another), 0 lets the centre count. who gave it, as it says, or, where `proven`, as a
    certificate does; why, until when it stands (ns; None: until what it is about ends). refused: why it was refused
    before it came to the centre, which then only logs it.
    """

    what: str
    source: str = ""
    track: int | None = None
    who: str = ""
    why: str = ""
    until: int | None = None
    other: int | None = None
    local: LocalId | None = None
    against: LocalId | None = None
    name: str = ""
    shown: int = 0
    identity: str = ""
    withdrawn: int = 0
    number: int = 0
    state: str = ""
    refused: str = ""
    proven: bool = False

    @property
    def giver(self) -> str:
        """Who gave it, and whether that is only said."""
        return giver_of(self.who, self.proven)

    def stripped(self) -> Order:
        """Without what an order of this kind is not about, as it stands."""
        about = {name: getattr(self, name) for name in (*ABOUT[self.what], "who", "proven", "why", "until", "number")}
        return Order(self.what, **about)


def giver_of(who: str, proven: bool) -> str:
    """Who gave an order, for people."""
    return who if proven else f"{who} (unproven)" if who else "?"


_DEFAULTS = {one.name: one.default for one in fields(Order) if one.name not in ("what", "source", "track")}


def order_event(order: Order) -> dict[str, Any]:
    """An order as an event of a step log, without its outcome: a free map of what differs from the defaults."""
    event: dict[str, Any] = {"kind": "order", "what": order.what, "source": order.source, "track": order.track}
    for name, default in _DEFAULTS.items():
        value = getattr(order, name)
        if value != default:
            event[name] = list(value) if isinstance(value, tuple) else value
    return event


def order_of(event: Mapping[str, Any]) -> Order | None:
    """The order of an event, of any age and from anywhere; None where it is none."""
    if event.get("kind") != "order" or not isinstance(event.get("what"), str):
        return None
    try:
        return read_order(event)
    except ValueError:
        return None


def read_order(raw: Mapping[str, Any]) -> Order:
    """The order in a map of plain values; `ValueError` in one line where a value has a wrong form. Whether it can be
    obeyed is another question."""
    values: dict[str, Any] = {}
    for one in fields(Order):
        value = raw.get(one.name)
        if value is None:
            continue
        try:
            values[one.name] = _READERS[one.name](value)
        except (ValueError, TypeError) as error:
            raise ValueError(f"the order's {one.name}: {error}") from None
    if "what" not in values:
        raise ValueError(f'an order is a map: {{"what": {" | ".join(WHAT)}, ...}}')
    return Order(**values)


def _text(value: Any) -> str:
    if not isinstance(value, str) or len(value) > MOST_TEXT or not value.isprintable():
        raise ValueError(f"must be a text of at most {MOST_TEXT} characters on one line")
    return value.strip()


def _flag(value: Any) -> bool:
    if type(value) is not bool:
        raise ValueError("must be true or false")
    return value


def _whole(top: int) -> Any:
    def read(value: Any) -> int:
        if isinstance(value, str) and _INT.match(value):
            value = int(value)
        if type(value) is not int or not 0 <= value < top:
            raise ValueError(f"must be a whole number from 0 to {top - 1}")
        return value

    return read


def _local(value: Any) -> LocalId:
    if not isinstance(value, (list, tuple)) or len(value) != 3:
        raise ValueError("must be a local track: [source, epoch or -1, id]")
    source, epoch, track = value
    return LocalId(_text(source), -1 if epoch in (None, -1) else _whole(2**64)(epoch), _whole(2**64)(track))


_U64 = _whole(2**64)
_READERS: dict[str, Any] = {
    **dict.fromkeys(("what", "source", "who", "why", "name", "identity", "state", "refused"), _text),
    **dict.fromkeys(("track", "other"), _U64),
    **dict.fromkeys(("local", "against"), _local),
    **dict.fromkeys(("until", "withdrawn"), _whole(2**63)),
    "number": _whole(MOST_NUMBER),
    "shown": _whole(2**32),
    "proven": _flag,
}
