"""`Promises`: who ordered hears what became of it when a step has obeyed it, and the checkpoint of that is on disk.

Where no step comes within `PATIENCE` (the clock of the messages stands, the period is long) the order is written down
by itself, and answered as one that waits for its step.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import msgpack

from fusion_service.centre import Order

__all__ = ["MOST_WAITING", "PATIENCE", "Promises", "Reply"]

PATIENCE = 1.5
"""Seconds that an answer waits for a step."""
MOST_WAITING = 256
"""Orders that no step has obeyed yet, answered or not."""

Reply: TypeAlias = Callable[[bytes | Exception], None]


@dataclass(frozen=True, slots=True)
class _Promise:
    order: Order
    outcome: str
    reply: Reply
    until: float

    def answer(self, done: bool, outcome: str, kept: bool, **more: Any) -> None:
        number, track = self.order.number, self.order.track
        said = {"number": number, "done": done, "outcome": outcome, "track": track, "kept": kept, **more}
        self.reply(msgpack.packb(said))


class Promises:
    """All methods may be called from any thread. clock: seconds that only grow."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.may: Callable[[], bool] = lambda: True
        """Whether this process' steps are the centre's."""
        self._clock = clock
        self._lock = threading.Lock()
        self._open: dict[int, _Promise] = {}
        self._waiting: set[int] = set()

    @property
    def full(self) -> bool:
        """Whether no more orders are taken until a step is made."""
        return len(self._waiting) >= MOST_WAITING

    def make(self, order: Order, outcome: str, reply: Reply) -> None:
        """`order` goes to the centre, which is thought to do with it what `outcome` says."""
        with self._lock:
            self._open[order.number] = _Promise(order, outcome, reply, self._clock() + PATIENCE)
            self._waiting.add(order.number)

    def wait(self) -> float:
        """Seconds until `overdue` may have some; infinite where none waits."""
        with self._lock:
            first = next(iter(self._open.values()), None)
        return float("inf") if first is None else max(0.0, first.until - self._clock())

    def settle(self, events: Iterable[Mapping[str, Any]], kept: bool) -> None:
        """A step has obeyed, or refused, the orders of these events of its log; kept: its checkpoint is on disk."""
        for event in events:
            promise = self._pop(event.get("number"))
            if promise is not None and not self.may():
                promise.reply(ValueError("another process holds the centre's name now: give the order again"))
            elif promise is not None:
                promise.answer(bool(event.get("done")), str(event.get("outcome", "")), kept)

    def lose(self, orders: Iterable[Order]) -> None:
        """No step obeys these."""
        for order in orders:
            promise = self._pop(order.number)
            if promise is not None:
                promise.answer(False, "lost with a step that failed: give it again", False)

    def overdue(self) -> list[Order]:
        """Those that have waited for too long, which are to be written down and `hold`."""
        now = self._clock()
        with self._lock:
            return [one.order for one in self._open.values() if one.until <= now]

    def hold(self, orders: Iterable[Order], kept: bool) -> None:
        """These are answered before their step; kept: they are written down."""
        for order in orders:
            with self._lock:
                promise = self._open.pop(order.number, None)
            if promise is not None:
                promise.answer(True, promise.outcome, kept, pending=True)

    def close(self) -> None:
        """The service stops: what no step has obeyed is not promised."""
        with self._lock:
            promises, self._open = list(self._open.values()), {}
        for promise in promises:
            promise.reply(ValueError("the service stops: give the order again when it is back"))

    def _pop(self, number: Any) -> _Promise | None:
        with self._lock:
            self._waiting.discard(number)
            return self._open.pop(number, None)
