"""The hub: a Zenoh router in a process of its own, which everything else joins. A real zenohd serves as well.

With a security file it lets in only who shows a certificate of its authority, and lets each hear and say what its role
is allowed (`fusion_service.bus.roles`). It says who comes and goes, and tells each party what it may do.
"""

from __future__ import annotations

import json
import logging
import re
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from fusion_service.bus.refusal import own_certificate
from fusion_service.bus.roles import ANYONE, HELLO, allowed, hello_key
from fusion_service.bus.security import HUB, Security, SecurityError, secured
from fusion_service.bus.session import DEFAULT_ENDPOINT, Bus, open_bus, tell_refusals

__all__ = ["open_hub", "run_hub"]

LINES = 20
"""Log lines a second about who comes and goes, at most."""
_HERE = re.compile(r"\w+/(localhost|127\.|\[::1\])")
"""Endpoints that only this computer reaches."""
log = logging.getLogger(__name__)


def run_hub(
    listen: Sequence[str] = (DEFAULT_ENDPOINT,),
    stop: threading.Event | None = None,
    security: Security | None = None,
) -> None:
    """Route between all who connect to `listen` until `stop` is set. Raises `BusError` if an endpoint
    is in use or bad, `SecurityError`."""
    stop = stop or threading.Event()
    with open_hub(listen, security):
        stop.wait()


@contextmanager
def open_hub(listen: Sequence[str], security: Security | None = None) -> Iterator[Bus]:
    """A hub as a context manager; yields its own session. Raises as `run_hub`."""
    if security is not None and security.role != HUB:
        raise SecurityError(f'{security.path}: it is the file of a {security.role}: a hub needs one with role = "hub"')
    if security is not None:
        own_certificate(security)
        listen = secured(listen)
        tell_refusals()
    with open_bus(listen=listen, mode="router", security=security) as bus:
        if security is None:
            level = logging.INFO if all(_HERE.match(one) for one in listen) else logging.WARNING
            log.log(
                level, "the hub lets anybody in, as anybody: `fusion-service keys` makes certificates for --security"
            )
        else:
            door = _Door(security)
            bus.answer_each(f"{HELLO}/party/*", door.hello)
            bus.answer(ANYONE, lambda _: b"{}")
            bus.on_link(door.link)
            count = len(security.parties)
            log.info("only %d parties of %s are let in, each in its role", count, security.path)
        log.info("the hub listens on %s", ", ".join(listen))
        yield bus


class _Door:
    """Tells parties what they may do, and the log who comes and goes."""

    def __init__(self, security: Security) -> None:
        self._parties = security.parties
        self._realm = security.realm
        self._told = 0
        self._since = 0.0

    def hello(self, key: str, _: bytes | None) -> bytes:
        """What the party of this key may do; access control lets nobody else ask on it."""
        common = key.removeprefix(hello_key(""))
        if common not in self._parties:
            raise ValueError(f"{common} is not known here")
        return json.dumps(allowed(self._parties[common], self._realm)).encode()

    def link(self, common: str, where: str, there: bool) -> None:
        """A link has come or gone."""
        now = time.monotonic()
        if now - self._since >= 1.0:
            if self._told > LINES:
                log.warning("%d more have come or gone within a second", self._told - LINES)
            self._told, self._since = 0, now
        self._told += 1
        if self._told > LINES:
            return
        party = self._parties.get(common)
        if party is None and there:
            words = "%s from %s may say and hear nothing: its certificate is ours, but it is not under [security] roles"
            log.warning(words, common[:64] or "?", where)
        else:
            log.info("%s %s %s", party or common[:64] or "?", "comes from" if there else "has gone from", where)
