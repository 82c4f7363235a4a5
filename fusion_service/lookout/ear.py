"""`Ear`: what one hears of a realm's centres, sources and recorders, and of who publishes beside them.

Statuses and pictures are heard as anybody hears them, tokens by liveliness, recorders are asked. What is published
elsewhere is overheard: a hub sends it to us as well, so where that is much it is done for a second now and then. The
publishers, the service among them, do not notice.
"""

from __future__ import annotations

import json
import time
from contextlib import suppress
from typing import Any

from fusion_service.bus import Bus, BusError
from fusion_service.errors import UsageError
from fusion_service.hints.elsewhere import beside, realm_of
from schemas import GlobalTracks, MessageError, Status, Wholes, decode, global_key, local_key, record_key

__all__ = ["Ear"]

MOST_KEYS = 500
MOST_CENTRES = 64
MOST_RECORDERS = 32
MOST_RUNS = 4
MUCH = 2**21, 1000
"""Bytes, or messages, that are overheard between two looks, about a second, without a pause:"""
PAUSE = 10.0
ANSWER = 0.5
"""Seconds that recorders have for their answer."""
STALE = 10.0
"""Seconds after which a key that nothing came on any more is not told of; tokens are told of while they stand."""


class Ear:
    """Of a realm. statuses, pictures: the newest by centre; came: when its newest status came, s, by `time.monotonic`;
    alive: tokens of centres and recorders by key; recorders: what those say, None where one does not answer;
    everywhere: whether all realms are heard."""

    def __init__(self, realm: str) -> None:
        self.realm = realm
        self.statuses: dict[str, Status] = {}
        self.came: dict[str, float] = {}
        self.pictures: dict[str, GlobalTracks] = {}
        self.alive: dict[str, bool] = {}
        self.recorders: dict[str, list[dict[str, Any]] | None] = {}
        self.everywhere = False
        self._wholes = Wholes()
        self._runs: dict[str, dict[int, tuple[float, float]]] = {}
        self._tokens: dict[str, bool] = {}
        self._keys: dict[str, float] = {}
        self._heard = [0, 0]
        self._overhearing: Any = None
        self._resume = 0.0

    def hear(self, bus: Bus, centre: str = "*") -> None:
        """Begin. Raises `UsageError` for what is no name, `BusError` if not even the centre may be heard."""
        try:
            names = [global_key(centre, what, self.realm) for what in ("status", "tracks")]
            token, recorders = global_key("*", "alive", self.realm), record_key("*", "alive", self.realm)
        except ValueError as error:
            raise UsageError(str(error)) from None
        for name in names:
            bus.subscribe(name, self.take)
        for key in (token, recorders):
            with suppress(BusError):
                bus.watch(key, self._note)
        try:
            self._overhear(bus)
            for scope in ("local", "global"):
                bus.watch(f"**/v1/{scope}/*/alive", self._note_elsewhere)
            self.everywhere = True
        except BusError:
            with suppress(BusError):
                bus.watch(local_key("*", "alive", self.realm), self._note_elsewhere)

    def ask(self, bus: Bus) -> None:
        """Ask the recorders what they keep, at most for `ANSWER`; while the hub is away they stay as they were."""
        if not bus.connected:
            return
        answers: dict[str, list[dict[str, Any]]] = {}
        with suppress(BusError):
            for key, data in bus.ask(record_key("*", "state", self.realm), timeout=ANSWER)[:MOST_RECORDERS]:
                try:
                    said = json.loads(data)
                except (ValueError, RecursionError):
                    continue
                if isinstance(said, dict):
                    answers.setdefault(key.split("/")[-2], []).append(said)
        there = [key.split("/")[-2] for key, up in list(self.alive.items()) if up and "/v1/record/" in key]
        self.recorders = {name: answers.get(name) for name in sorted({*there, *answers})[:MOST_RECORDERS]}

    def tend(self, bus: Bus) -> None:
        """About once a second: where much is overheard, pause."""
        now = time.monotonic()
        (size, count), self._heard = self._heard, [0, 0]
        if self._overhearing is not None and (size > MUCH[0] or count > MUCH[1]):
            self._overhearing.close()
            self._overhearing, self._resume = None, now + PAUSE
        elif self._overhearing is None and self.everywhere and now >= self._resume:
            with suppress(BusError):
                self._overhear(bus)

    def take(self, key: str, data: bytes) -> None:
        """A message of a centre, on a thread of the bus."""
        try:
            message = decode(data)
        except MessageError:
            return
        if message.source not in self.statuses and len(self.statuses) >= MOST_CENTRES:
            return
        now = time.monotonic()
        if isinstance(message, Status):
            self.statuses[message.source], self.came[message.source] = message, now
            runs = self._runs.setdefault(message.source, {})
            runs[message.epoch] = (runs.get(message.epoch, (now, now))[0], now)
            while len(runs) > MOST_RUNS:
                del runs[next(iter(runs))]
        elif isinstance(message, GlobalTracks) and (whole := self._wholes.of(message)) is not None:
            self.pictures[message.source] = whole

    def twice(self) -> list[str]:
        """Centres of which two processes publish at once."""
        now = time.monotonic()
        found = []
        for name, runs in sorted(self._runs.copy().items()):
            spans = [(first, last) for first, last in list(runs.values()) if now - last < STALE]
            begun = max((first for first, _ in spans), default=0.0)
            if (count := sum(last > begun for _, last in spans)) > 1:
                found.append(
                    f"{count} processes publish as centre {name}: end one of them, or let it stand by (run --standby)"
                )
        return found

    def beside(self) -> list[str]:
        """What is published where no centre of the realm listens."""
        now = time.monotonic()
        keys = {key for key, at in list(self._keys.items()) if now - at < STALE}
        standing = {key for key, up in list(self._tokens.items()) if up}
        served = {realm_of(key) for key in standing if "/v1/global/" in key} - {""}
        return beside(keys | {key for key in standing if "/v1/local/" in key}, self.realm, served)

    def centre_is_there(self, name: str) -> bool | None:
        """Whether the token of a centre stands; None where that is not known."""
        return self.alive.get(global_key(name, "alive", self.realm))

    def centres_there(self) -> list[str]:
        """The centres whose tokens stand."""
        return [key.split("/")[-2] for key, up in list(self.alive.items()) if up and "/v1/global/" in key]

    def _note(self, key: str, alive: bool) -> None:
        if key in self.alive or len(self.alive) < MOST_KEYS:
            self.alive[key] = alive

    def _note_elsewhere(self, key: str, alive: bool) -> None:
        if not alive:
            self._tokens.pop(key, None)
        elif len(self._tokens) < MOST_KEYS:
            self._tokens[key] = True

    def _overhear(self, bus: Bus) -> None:
        self._overhearing = bus.overhear("**", self._overheard)

    def _overheard(self, key: str, size: int) -> None:
        self._heard[0] += size
        self._heard[1] += 1
        if realm_of(key) == self.realm:
            return
        if key in self._keys or len(self._keys) < MOST_KEYS:
            self._keys[key] = time.monotonic()
        elif len(self._keys) >= MOST_KEYS:
            self._keys = {one: at for one, at in list(self._keys.items()) if time.monotonic() - at < STALE}
