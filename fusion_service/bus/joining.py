"""How a session is opened: what Zenoh is told, and a client's patience with its hub.

A client that a hub refuses waits on, as for a hub that is not there, and says why: the hub may be mended. With a
security file it asks the hub, once in, what it may do there (`fusion_service.bus.roles`): who is not listed is told so,
and what nobody would hear is refused before it is sent.
"""

from __future__ import annotations

import json
import logging
import re
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

import zenoh

from fusion_service.bus.endpoint import DEFAULT_ENDPOINT
from fusion_service.bus.errors import BusError, BusStopped
from fusion_service.bus.refusal import own_certificate, refused
from fusion_service.bus.roles import ANYONE, hello_key
from fusion_service.bus.security import ACCEPT_PENDING, ACCEPT_TIMEOUT, Security, link_settings
from fusion_service.errors import FusionError
from schemas import MAX_BYTES

__all__ = ["HANDSHAKE", "join", "reason", "session_config"]

HANDSHAKE = 3.0
"""Seconds that a hub has for the opening of a session; as long may a process that gave up waiting take to end."""
RETRY = 0.2
FIRST, REMIND = 2.0, 30.0
"""Seconds until it is told that the hub is waited for, and between that and the next time."""
LOOK = 5.0
"""Seconds between two looks at why a hub refuses us."""
HELLOS = 5
HELLO_PATIENCE = 1.0
"""Seconds that a hub has to say what we may do."""

log = logging.getLogger(__name__)


def session_config(connect: Sequence[str], listen: Sequence[str], mode: str, security: Security | None) -> zenoh.Config:
    """What Zenoh is told. Raises `BusError` for a bad endpoint."""
    settings: dict[str, Any] = {
        "mode": mode,
        "connect/endpoints": list(connect),
        "listen/endpoints": list(listen),
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "transport/unicast/open_timeout": round(1000 * HANDSHAKE),
        "transport/unicast/accept_pending": ACCEPT_PENDING,
        "transport/unicast/accept_timeout": ACCEPT_TIMEOUT,
        "timestamping/enabled": True,  # publishers that keep samples need it
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": 2 * MAX_BYTES,  # what is longer is dropped before it takes memory
        **(link_settings(security) if security is not None else {}),
    }
    if mode == "client":
        settings["connect/timeout_ms"] = 0  # one attempt per zenoh.open
    config = zenoh.Config()
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            if not key.endswith("endpoints"):
                raise BusError(f"Zenoh does not take {key}: {reason(error)}") from None
            raise BusError(f"bad endpoint in {value}: write tcp/host:port, as in {DEFAULT_ENDPOINT}") from None
    return config


def join(
    connect: Sequence[str],
    wait: bool | float,
    stop: threading.Event | None,
    security: Security | None,
) -> tuple[Any, Mapping[str, Sequence[str]] | None]:
    """A client's session, and what its hub says that it may do, None where it says nothing. `zenoh.open` lets no signal
    through while it waits for an answer, up to `HANDSHAKE`: it runs on a thread of its own, left to itself if nobody
    waits any more. Not a daemon thread: one that comes back from Zenoh while the interpreter goes down aborts the
    process."""
    attempts = _Attempts(connect, bool(wait), security)
    begin = time.monotonic()
    deadline = None if wait is True or not wait else begin + wait
    remind = begin + FIRST
    endpoints = ", ".join(connect)
    threading.Thread(target=attempts.run, name="bus-join").start()
    try:
        while not attempts.ended.wait(0.05):
            now = time.monotonic()
            if stop is not None and stop.is_set():
                raise BusStopped(f"stopped while waiting for the hub at {endpoints}")
            if deadline is not None and now >= deadline:
                break
            if now >= remind:
                why = attempts.why or f"waiting for the hub at {endpoints} (`fusion-service hub` starts one)"
                log.warning("%s", why)
                remind = now + REMIND
        if (made := attempts.take()) is not None:
            return made
        raise BusError(attempts.why or f"no hub answers at {endpoints}: start one with `fusion-service hub`")
    finally:
        attempts.abandon()


class _Attempts:
    """A client's attempts to join its hub, on a thread: until one succeeds, or nobody waits any more.

    why: what is known of why the last one failed, empty where no hub is there."""

    def __init__(self, connect: Sequence[str], again: bool, security: Security | None) -> None:
        self.ended = threading.Event()
        self.why = ""
        self._connect, self._again, self._security = connect, again, security
        self._config = session_config(connect, (), "client", security)
        self._common = own_certificate(security).common_name if security is not None else ""
        self._lock = threading.Lock()
        self._abandoned = threading.Event()
        self._made: tuple[Any, Mapping[str, Sequence[str]] | None] | None = None
        self._look = 0.0

    def run(self) -> None:
        """Try until it is done."""
        while not self._abandoned.is_set():
            made = self._attempt()
            if made is not None:
                with self._lock:
                    if not self._abandoned.is_set():
                        self._made = made
                        break
                made[0].close()
            elif not self._again:
                break
            else:
                self._abandoned.wait(FIRST if self.why else RETRY)  # whom a hub refuses fills its log with each try
        self.ended.set()

    def _attempt(self) -> tuple[Any, Mapping[str, Sequence[str]] | None] | None:
        try:
            session: Any = zenoh.open(self._config)
        except zenoh.ZError:  # says no more than that it could not
            if time.monotonic() >= self._look and not self._abandoned.is_set():
                self.why = self._ask_why()
                self._look = time.monotonic() + LOOK
            return None
        if self._security is None:
            return session, None
        try:
            return session, _rights(session, self._common)
        except BusError as error:
            self.why = f"the hub at {', '.join(self._connect)} {error}"
            session.close()
            if self._again:
                self._abandoned.wait(FIRST)
            return None

    def _ask_why(self) -> str:
        try:
            return refused(self._connect, self._security)
        except (FusionError, OSError) as error:  # the files have changed
            return str(error)

    def take(self) -> tuple[Any, Mapping[str, Sequence[str]] | None] | None:
        """What an attempt has made, to keep."""
        with self._lock:
            made, self._made = self._made, None
            return made

    def abandon(self) -> None:
        """Nobody waits any more."""
        with self._lock:
            self._abandoned.set()
        if (made := self.take()) is not None:
            made[0].close()


def _rights(session: Any, common: str) -> Mapping[str, Sequence[str]] | None:
    """What the hub says that we may do; None where it is one that says nothing. Raises `BusError` if it does not know
    us."""
    for again in (*[True] * HELLOS, False):  # a hub that has just begun to listen may not answer yet
        for key in (hello_key(common), ANYONE):
            for reply in session.get(key, timeout=HELLO_PATIENCE):
                if reply.ok and key != ANYONE:
                    return _read_rights(bytes(reply.ok.payload))
                if reply.ok and not again:
                    raise BusError(f"lets {common} say and hear nothing: it is not in its file, under [security] roles")
        time.sleep(RETRY if again else 0.0)
    log.warning("the hub does not say what %s may do: what is forbidden there gets lost without a word", common)
    return None


def _read_rights(data: bytes) -> Mapping[str, Sequence[str]]:
    """Raises `BusError` if it is none."""
    try:
        raw = json.loads(data)
        keys = {act: [str(zenoh.KeyExpr(one)) for one in raw[act]] for act in ("publish", "subscribe", "ask")}
        return keys | {"who": [str(one) for one in raw["who"]]}
    except (ValueError, TypeError, KeyError, zenoh.ZError) as error:
        raise BusError(f"answers what is not understood: is it of another version? ({error})") from None


def reason(error: Exception) -> str:
    """A Zenoh error without the places in its source, on one line."""
    return " ".join(re.sub(r"\s*at \S+\.rs:\d+\.?", "", str(error)).split())
