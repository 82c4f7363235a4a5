"""`Handover`: an operator's order to the active process to let the one that stands by go on.

It waits until one that stands by is in step, `PATIENCE` seconds at most, or until one is there, `NOBODY` seconds, and
is answered when that one has taken over, or with why not.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from typing import NamedTuple

import msgpack

from fusion_service.service.promises import Reply

__all__ = ["NOBODY", "PATIENCE", "Handover"]

PATIENCE = 5.0
"""Seconds that one that stands by may take to be in step."""
NOBODY = 2.0
"""Seconds that one may take to be there."""
MOST = 16
MOST_BYTES = 1000

log = logging.getLogger(__name__)


class _Asked(NamedTuple):
    who: str
    reply: Reply
    until: float


class Handover:
    """`take` may be called from any thread, the rest by one loop. now: seconds that only grow."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._lock = threading.Lock()
        self._asked: list[_Asked] = []

    def take(self, payload: bytes | None, operator: str, reply: Reply) -> bool:
        """Whether this is an order to hand over, which is answered later. operator: on whose key it came."""
        if not payload or len(payload) > MOST_BYTES or b"handover" not in payload:
            return False
        try:
            raw = msgpack.unpackb(payload)
        except Exception:  # whoever reads it next says what is wrong
            return False
        if not isinstance(raw, dict) or raw.get("what") != "handover":
            return False
        with self._lock:
            if taken := len(self._asked) < MOST:
                self._asked.append(_Asked(operator or str(raw.get("who", ""))[:64], reply, self._now() + PATIENCE))
        if not taken:
            _answer(reply, False, "too many ask for it")
        return True

    def due(self, others: Mapping[str, str]) -> bool:
        """Whether to hand over now. others: who stands by, and why each could not take over, "" where it could."""
        if not self._asked:
            return False
        ready = [name for name, why in others.items() if not why]
        if ready:
            log.info("%s orders to hand over to %s", self._asked[0].who or "somebody", ready[0])
            return True
        now = self._now()
        with self._lock:
            over = [one for one in self._asked if one.until - (0 if others else PATIENCE - NOBODY) <= now]
            self._asked = [one for one in self._asked if one not in over]
        said = "; ".join(f"{name} {why}" for name, why in others.items())
        for one in over:
            words = f"nobody stands by with the newest state: {said}" if said else "nobody stands by"
            _answer(one.reply, False, words)
        return False

    def done(self, term: int, why: str) -> None:
        """Another has gone on under this term, or (0) none has, and why not: all who asked are told."""
        with self._lock:
            asked, self._asked = self._asked, []
        for one in asked:
            _answer(one.reply, term > 0, f"the other one goes on, under term {term}" if term else why)


def _answer(reply: Reply, done: bool, outcome: str) -> None:
    reply(msgpack.packb({"done": done, "outcome": outcome}))
