"""`Promises`: who ordered hears what became of it when a step has obeyed it, and the checkpoint of that is on disk.

Where no step comes within `PATIENCE` (the clock of the messages stands, the period is long) the order is written down
by itself, and answered as one that waits for its step.

Where another process stands by, the answer waits until that one says that it has the order too, `FOLLOWED` seconds at
most: after that it says `followed: false`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import msgpack

from fusion_service.centre import Order
from fusion_service.order import order_event

__all__ = ["FOLLOWED", "MOST_WAITING", "PATIENCE", "Promises", "Reply"]

PATIENCE = 1.5
"""Seconds that an answer waits for a step."""
FOLLOWED = 1.0
"""Seconds that an answer waits for who stands by."""
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


@dataclass(frozen=True, slots=True, eq=False)
class _Settled:
    """A promise that is kept here, with what is to be said, and until when the others are waited for."""

    promise: _Promise
    said: dict[str, Any]
    until: float


class Promises:
    """All methods may be called from any thread. clock: seconds that only grow."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.may: Callable[[], bool] = lambda: True
        """Whether this process' steps are the centre's."""
        self.followed: Callable[[], int | None] = lambda: None
        """The greatest number of an order that those who stand by have; None where nobody does."""
        self._clock = clock
        self._lock = threading.Lock()
        self._open: dict[int, _Promise] = {}
        self._waiting: set[int] = set()
        self._held: dict[int, Order] = {}
        self._settled: list[_Settled] = []

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
            settled = [one.until for one in self._settled[:1]]
        return max(0.0, min([float("inf") if first is None else first.until, *settled]) - self._clock())

    def settle(self, events: Iterable[Mapping[str, Any]], kept: bool) -> None:
        """A step has obeyed, or refused, the orders of these events of its log; kept: its checkpoint is on disk. They
        are answered by `release`."""
        for event in events:
            number = event.get("number")
            if (promise := self._pop(number)) is not None:
                said = {"done": bool(event.get("done")), "outcome": str(event.get("outcome", "")), "kept": kept}
                self._settle(promise, said)

    def _settle(self, promise: _Promise, said: dict[str, Any]) -> None:
        with self._lock:
            self._settled.append(_Settled(promise, said, self._clock() + FOLLOWED))

    def release(self) -> None:
        """Answer what is settled, where those who stand by have it too; once its step has been published."""
        if not self._settled:
            return
        followed, now = self.followed(), self._clock()
        with self._lock:
            late = [one for one in self._settled if followed is not None and one.promise.order.number > followed]
            due = [one for one in self._settled if one not in late or one.until <= now]
            self._settled = [one for one in late if one.until > now]
        for one in due:
            self._say(one, one not in late)

    def _say(self, one: _Settled, followed: bool) -> None:
        if self.may():
            one.promise.answer(**(one.said if followed else one.said | {"followed": False}))
        else:
            one.promise.reply(ValueError("another process holds the centre's name now: give the order again"))

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
        """These are answered, by `release`, before their step; kept: they are written down."""
        for order in orders:
            with self._lock:
                promise = self._open.pop(order.number, None)
            if promise is not None:
                self.wait_for(order)
                self._settle(promise, {"done": True, "outcome": promise.outcome, "kept": kept, "pending": True})

    def wait_for(self, order: Order) -> None:
        """It was answered, here or by whom this process goes on from, and waits for its step."""
        self._held[order.number] = order

    def held(self) -> list[dict[str, Any]]:
        """The orders that wait for their step though they were answered, as events. May be called from any thread."""
        return [order_event(order) for order in list(self._held.values())]

    def close(self) -> None:
        """The service stops: what no step has obeyed is not promised."""
        with self._lock:
            settled, self._settled = self._settled, []
            promises, self._open = list(self._open.values()), {}
        for one in settled:
            self._say(one, self.followed() is None)
        for promise in promises:
            promise.reply(ValueError("the service stops: give the order again when it is back"))

    def _pop(self, number: Any) -> _Promise | None:
        with self._lock:
            self._waiting.discard(number)
            self._held.pop(number, None)
            return self._open.pop(number, None)
