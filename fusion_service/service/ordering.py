"""`OrderDesk`: where operators' orders come in, and what they are answered at once.

An order is obeyed in the centre's next step. It is judged here against the picture after the last one: who ordered what
cannot be obeyed hears at once why not, everybody else when the step has obeyed it and the checkpoint is on disk
(`promises`); what it did stands under its number in the step log. Requests are MessagePack maps:

none, or {"what": "list"}           -> {"orders": [...], "time": ns}: the orders that stand
{"what": WORD, ...}                 -> {"number": n, "done": bool, "outcome": text, "track": id or nil, "kept": bool,
                                       "pending": true where it waits for a step}
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import msgpack
import numpy as np

from fusion_service.centre import NEEDED, WHAT, Centre, Order, View, judge, read_order
from fusion_service.service.promises import Promises, Reply
from fusion_service.service.suggesting import advised, find_track, suggestion
from schemas import check_name, check_source

__all__ = ["OrderDesk"]

MOST_BYTES = 64_000
MOST_FOR = 1e9


class Held(NamedTuple):
    """A source's columns that orders are judged by, as they were after a step."""

    epoch: int
    tracks: Any


class OrderDesk:
    """Answers orders on threads of the bus and hands them on; put: takes an order for the centre's next step. secured:
    who orders shows a certificate, and asks on a key of its own."""

    def __init__(self, put: Callable[[Order], None], secured: bool = False) -> None:
        self._put = put
        self._secured = secured
        self.promises = Promises()
        self._lock = threading.Lock()
        self._view = View(-1, np.zeros(0, dtype=np.uint64), {}, {})
        self._listed: list[dict[str, Any]] = []
        self._next = 1
        self._given: list[Order] = []

    def follow(self, centre: Centre) -> None:
        """After a step, or with a new centre: what orders are judged by from now on."""
        live, orders = centre.view(), centre.orders
        sources = {name: Held(source.epoch, source.tracks) for name, source in live.sources.items()}
        view = replace(live, sources=sources, standing=dict(live.standing))
        with self._lock:
            self._view, self._listed = view, orders.listed()
            self._next = max(self._next, orders.next)
            self._given.clear()

    def given(self, order: Order) -> None:
        """The centre has this order for its next step."""
        with self._lock:
            self._given.append(order)
            self._next = max(self._next, order.number + 1)

    def again(self, whole: bool) -> list[Order]:
        """What a centre made anew is to be told: the orders of the step that failed; whole: it begins with nothing,
        and is told what was ordered about sources alone, lest another order be what fails."""
        with self._lock:
            stood = [one.order for _, one in sorted(self._view.standing.items())] if whole else []
            given, self._given = self._given, []
        again = [one for one in stood + given if not whole or one.what in ("mute", "unmute", "quarantine", "release")]
        self.promises.lose(one for one in given if one not in again)
        return again

    def answer(self, payload: bytes | None, reply: Reply, operator: str = "") -> None:
        """Answer a request by `reply`, now or later. operator: whose key it came on, who is said to have ordered then,
        whatever the request says. `ValueError` in one line where it is none."""
        raw = _map(payload)
        if raw.get("what", "list") == "list":
            with self._lock:
                answer = {"orders": self._listed, "time": max(self._view.time, 0)}
            reply(msgpack.packb(answer))
            return
        if self._secured and not operator:
            raise ValueError("this centre takes orders by certificate, on the key orders/OPERATOR: give --security")
        if self.promises.full:
            raise ValueError("too many orders wait for a step: give it again later")
        raw = {**raw, **({"who": check_name(operator)} if operator else {}), "proven": self._secured}
        with self._lock:
            view = self._view
            order = self._read(dict(raw), view)
            if not order.refused:
                outcome = judge(order, view)
                if not outcome.done:
                    order = replace(order, refused=f"{outcome.text}{suggestion(order, view)}")
            if order.refused:
                outcome = judge(order, view)
            order = replace(order, number=self._next)
            self._next += 1
        if outcome.done:
            self.promises.make(order, outcome.text, advised(order, view, reply))
        self._put(order)
        if not outcome.done:
            refusal = {"number": order.number, "done": False, "outcome": outcome.text, "track": order.track}
            reply(msgpack.packb({**refusal, "kept": False}))

    def _read(self, raw: dict[str, Any], view: View) -> Order:
        """The order of a request: tracks by any of their names, `for` seconds from the last step."""
        if not isinstance(raw["what"], str) or raw["what"] not in WHAT:
            raise ValueError(f'an order is a map: {{"what": {" | ".join(WHAT)}, ...}}')
        for name in NEEDED.get(raw["what"], ()):
            if raw.get(name) is None:
                raise ValueError(f"the order {raw['what']} needs: {', '.join(NEEDED[raw['what']])}")
        if "source" in NEEDED.get(raw["what"], ()):
            check_source(raw["source"] if isinstance(raw["source"], str) else str([raw["source"]]))
        refused = ""
        for name in ("track", "other"):
            if raw.get(name) is not None:
                if type(raw[name]) is not str and not (type(raw[name]) is int and raw[name] >= 0):
                    raise ValueError(f"the order's {name}: must be a global id, or a name of one")
                try:
                    raw[name] = find_track(raw[name], view)
                except LookupError as error:
                    raw[name], refused = None, refused or str(error)
        if raw["what"] == "withdraw":
            raw["withdrawn"] = raw.get("number", raw.get("withdrawn"))
        seconds = raw.pop("for", None)
        if seconds is not None:
            if not (isinstance(seconds, (int, float)) and 0 < seconds <= MOST_FOR):
                raise ValueError("the order's for: must be seconds above 0")
            raw["until"] = max(view.time, 0) + round(seconds * 1e9)
        return read_order({**raw, "number": None, "refused": refused or None})


def _map(payload: bytes | None) -> Mapping[str, Any]:
    if not payload:
        return {}
    try:
        raw = msgpack.unpackb(payload) if len(payload) <= MOST_BYTES else None
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"an order is a MessagePack map: {error}") from None
    if not isinstance(raw, dict):
        raise ValueError('an order is a MessagePack map, as in {"what": "mute", "source": "radar-1"}')
    return raw
