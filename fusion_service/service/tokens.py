"""Which sources are there, by their liveliness tokens on the bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from fusion_service.bus import Bus, BusError
from fusion_service.hints.elsewhere import beside, realm_of
from schemas import local_key, parse_key

__all__ = ["MAX_NAMES", "Tokens"]

MAX_NAMES = 4096
"""Names that are remembered of what anybody on the bus may make up."""
MOST_ELSEWHERE, MOST_TOLD = 256, 3
"""Tokens of other realms that are remembered, and that are told of."""
GRACE = 5.0
"""Seconds in which a source that is thought to be there has its token, be it that the hub has just come back."""


class Tokens:
    """`note` is called on threads of the bus, the rest by one loop. wake: called when there is something new."""

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._lock = threading.Lock()
        self._there: dict[str, bool] = {}
        self._missed: dict[str, float] = {}
        self._elsewhere: dict[str, None] = {}
        self._realm = ""
        self.told: dict[str, bool] = {}
        """Whether each source was there when `changes` last said so."""

    def watch(self, bus: Bus, realm: str) -> None:
        """Hear of the tokens of a realm, and, where a certificate does not forbid it, of those of all realms: it costs
        nothing but when one comes or goes."""
        self._realm = realm
        bus.watch(local_key("*", "alive", realm), self.note)
        with suppress(BusError):
            for scope in ("local", "global"):
                bus.watch(f"**/v1/{scope}/*/alive", self._note_elsewhere)

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

    def compare(self, sources: Mapping[str, Mapping[str, Any]]) -> None:
        """What a centre says of its sources: one that it takes to be there, by a checkpoint, and whose token was not
        seen for `GRACE`, went while nobody was there to see it."""
        now = time.monotonic()
        with self._lock:
            unseen = [name for name, said in sources.items() if said.get("alive") is True and name not in self._there]
            self._missed = {name: self._missed.get(name, now) for name in unseen[:MAX_NAMES]}
            gone = [name for name, since in self._missed.items() if now - since > GRACE]
            self._there |= dict.fromkeys(gone, False)

    def beside(self) -> list[str]:
        """Who holds a token in a realm whose name is nearly ours, where no centre is: a few of them."""
        with self._lock:
            keys = list(self._elsewhere)
        served = {realm_of(key) for key in keys if "/v1/global/" in key}
        found = beside([key for key in keys if "/v1/local/" in key], self._realm, served, sure=True)
        return found[:MOST_TOLD]

    def forget(self) -> None:
        """Let `changes` tell of all sources again."""
        self.told = {}

    def _note_elsewhere(self, key: str, alive: bool) -> None:
        if realm_of(key) == self._realm:
            return
        with self._lock:
            if not alive:
                self._elsewhere.pop(key, None)
            elif len(self._elsewhere) < MOST_ELSEWHERE:
                self._elsewhere[key] = None
