"""Which sources are there, by their liveliness tokens on the bus."""

from __future__ import annotations

import threading
from collections.abc import Callable

from schemas import parse_key

__all__ = ["MAX_NAMES", "Tokens"]

MAX_NAMES = 4096
"""Names that are remembered of what anybody on the bus may make up."""


class Tokens:
    """`note` is called on threads of the bus, the rest by one loop. wake: called when there is something new."""

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._lock = threading.Lock()
        self._there: dict[str, bool] = {}
        self.told: dict[str, bool] = {}
        """Whether each source was there when `changes` last said so."""

    def note(self, key: str, alive: bool) -> None:
        """A token has come or gone. Returns at once."""
        try:
            name = parse_key(key).source
        except ValueError:
            return
        with self._lock:
            if name not in self._there and len(self._there) >= MAX_NAMES:
                dead = next((one for one, there in self._there.items() if not there), None)
                if dead is None:
                    return
                del self._there[dead]
            self._there[name] = alive
        self._wake()

    def changes(self) -> dict[str, bool]:
        """Which sources came (True) and went (False) since it was last called."""
        with self._lock:
            there = dict(self._there)
        changed = {name: alive for name, alive in there.items() if self.told.get(name) is not alive}
        self.told = there
        return changed

    def forget(self) -> None:
        """Let `changes` tell of all sources again."""
        self.told = {}
