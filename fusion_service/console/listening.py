"""The bus side of the console: joins the hub, hears what centres publish, and asks them what operators order.

It hears `global/**` and, where it may, what sources say of themselves; tracks of sources it leaves to the centres.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from typing import Any

import msgpack

from fusion_service.bus import Bus, BusError, Inbox, open_bus
from fusion_service.bus.security import Security
from fusion_service.console.state import State
from fusion_service.errors import OrderError
from schemas import GlobalTracks, SensorInfo, Status, StepLog, decode, global_key, local_key, order_key
from schemas.keys import parse_key

__all__ = ["Listener"]

log = logging.getLogger(__name__)

WAITING = 512
"""Messages, or 64 KiB of them, that wait to be read; the oldest of the busiest centre are dropped."""
LOOK = 0.5
ANSWER = 10.0
"""Seconds that a centre has for its answer, which comes when a step has obeyed."""
TOGETHER = 4
"""Orders that wait for their answers at a time."""


class Listener:
    """Feeds a `State` from the bus until it is told to stop."""

    def __init__(
        self, state: State, *, connect: list[str], realm: str, centre: str | None, security: Security | None
    ) -> None:
        self._state, self._connect, self._realm = state, connect, realm
        self._only, self._security = centre, security
        self._inbox: Inbox[tuple[str, bytes]] = Inbox(WAITING)
        self._bus: Bus | None = None
        self._orders = threading.BoundedSemaphore(TOGETHER)

    def run(self, stop: threading.Event) -> None:
        """Listen until `stop`. Raises `BusError`, `BusStopped`."""
        with open_bus(self._connect, wait=True, stop=stop, security=self._security) as bus:
            who = self._only or "*"
            for what in ("tracks", "log", "status"):
                bus.subscribe(global_key(who, what, self._realm), self._heard)
            bus.watch(global_key(who, "alive", self._realm), self._token)
            try:
                bus.subscribe(local_key("*", "info", self._realm), self._heard)
            except BusError as error:
                log.info("places and coverage of the sources are not shown: %s", error)
            self._bus = bus
            try:
                while not stop.is_set():
                    self._state.hub(bus.connected)
                    for _, (key, data) in self._inbox.take(LOOK):
                        self._read(key, data)
            finally:
                self._bus = None

    def _heard(self, key: str, data: bytes) -> None:
        self._inbox.put(key, (key, data), len(data))

    def _token(self, key: str, there: bool) -> None:
        self._state.alive(parse_key(key).name, there)

    def _read(self, key: str, data: bytes) -> None:
        """Decode a message and hand it on; what cannot be read, or comes on another's key, is left."""
        try:
            message, parsed = decode(data), parse_key(key)
        except ValueError as error:
            log.debug("%s: %s", key, error)
            return
        wanted = (SensorInfo,) if parsed.scope == "local" else (GlobalTracks, StepLog, Status)
        if message.source == parsed.name and isinstance(message, wanted):
            try:
                self._state.take(message)
            except Exception:  # whatever a centre says, the console goes on
                log.exception("%s: a message could not be shown", key)

    def order(self, centre: str, request: Mapping[str, Any]) -> dict[str, Any]:
        """Ask a centre, and its answer. Waits: not for a thread that must not. Raises `OrderError` in one line."""
        bus = self._bus
        if bus is None or not bus.connected:
            raise OrderError("the hub is away: nothing was ordered")
        if not self._orders.acquire(blocking=False):
            raise OrderError("other orders wait for their answers: give it again in a moment")
        try:
            key = global_key(centre, "orders", self._realm)
            if self._security is not None:
                key = order_key(centre, self._security.name, self._realm)
            answers = bus.ask(key, msgpack.packb(dict(request)), ANSWER)
            answer = msgpack.unpackb(answers[0][1]) if answers else None
        except (BusError, ValueError) as error:
            raise OrderError(str(error)) from None
        finally:
            self._orders.release()
        if not isinstance(answer, dict):
            raise OrderError(f"no centre named {centre} answers: is `fusion-service run` there, under this name?")
        return answer
