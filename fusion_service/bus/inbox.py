"""The bounded queue between the bus, which must never wait, and the one who works on what it brings."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

__all__ = ["Inbox"]

T = TypeVar("T")


class Inbox(Generic[T]):
    """The one bounded queue between the bus and who works on what came. All methods are thread safe.

    It holds at most `capacity` slots; an item of `size` bytes takes 1 + size // slot_bytes of them, so that
    memory is bounded whatever is sent. When they do not suffice, the oldest item of the busiest source is
    dropped and counted: the one that holds most slots, among equals the one that has held them longest. So a
    flood costs the one who makes it. At most
    `max_sources` names are told apart, waiting or counted; all beyond share one account, `OTHERS`.
    Every operation costs the same however much waits (amortised).
    """

    OTHERS = "*"

    def __init__(self, capacity: int, *, slot_bytes: int = 2**16, max_sources: int = 1024) -> None:
        if min(capacity, slot_bytes, max_sources) < 1:
            raise ValueError("an inbox needs at least one slot, one byte per slot and one source")
        self.capacity = capacity
        self._slot_bytes = slot_bytes
        self._max_sources = max_sources
        self._ready = threading.Condition()
        self._next = 0
        self._woken = False
        self._high_water = 0
        self._dropped: dict[str, int] = {}
        self._clear()

    def _clear(self) -> None:
        self._items: dict[int, tuple[str, T]] = {}
        self._used = 0
        self._queues: dict[str, deque[tuple[int, int]]] = {}  # account -> (number, slots) of its items
        self._load: dict[str, int] = {}  # account -> slots
        self._levels: dict[int, dict[str, None]] = {}  # slots -> the accounts that hold as many
        self._top = 0  # no level above it has accounts

    def put(self, source: str, item: T, size: int = 0) -> None:
        """Add an item of `source`. Never waits for room: drops when full."""
        slots = 1 + size // self._slot_bytes
        with self._ready:
            known = source in self._queues or len(self._queues) < self._max_sources
            account = source if known else self.OTHERS
            self._items[self._next] = source, item
            self._queues.setdefault(account, deque()).append((self._next, slots))
            self._next += 1
            self._charge(account, slots)
            while self._used > self.capacity:
                self._drop()
            self._high_water = max(self._high_water, self._used)
            self._ready.notify()

    def _charge(self, account: str, slots: int) -> None:
        old = self._load.get(account, 0)
        new = old + slots
        self._used += slots
        if old:
            level = self._levels[old]
            del level[account]
            if not level:
                del self._levels[old]
        if new:
            self._load[account] = new
            self._levels.setdefault(new, {})[account] = None
            self._top = max(self._top, new)
        else:
            del self._load[account], self._queues[account]

    def _drop(self) -> None:
        while self._top not in self._levels:
            self._top -= 1
        account = next(iter(self._levels[self._top]))
        number, slots = self._queues[account].popleft()
        del self._items[number]
        counter = account if account in self._dropped or len(self._dropped) < self._max_sources else self.OTHERS
        self._dropped[counter] = self._dropped.get(counter, 0) + 1
        self._charge(account, -slots)

    def take(self, timeout: float | None = None) -> list[tuple[str, T]]:
        """Everything that waits, as (source, item) in the order of arrival. Waits for the first item up to
        `timeout` seconds (None: for ever), or until `wake`; empty if there is none."""
        with self._ready:
            self._ready.wait_for(lambda: self._items or self._woken, timeout)
            self._woken = False
            items = list(self._items.values())
            if items:
                self._clear()
            return items

    def wake(self) -> None:
        """Let the `take` under way, or the next one, return at once. May be called from a signal handler."""
        with self._ready:
            self._woken = True
            self._ready.notify_all()

    def __len__(self) -> int:
        return len(self._items)

    @property
    def dropped(self) -> dict[str, int]:
        """Items dropped since the start, by source."""
        with self._ready:
            return dict(self._dropped)

    @property
    def high_water(self) -> int:
        """The most slots that were ever in use."""
        return self._high_water
