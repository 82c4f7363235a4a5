"""Sessions on the bus: the only file that knows Zenoh.

One hub (`fusion_service.bus.hub`, or a real zenohd) routes; everything else joins it as a client, waits for it
and reconnects by itself. Endpoints are pinned: nothing is discovered by multicast. Publishers keep their last
samples and number them, so that a late joiner gets the newest ones and a gap is recovered from the publisher,
or counted where it cannot be. Closing a session in every case is not a courtesy: a process that ends with an
open session and a callback hangs. Do not fork while one is open (spawn).

Callbacks run one at a time per subscription on a thread of the bus and must return at once: a slow one holds
up every other subscription of its session. `Inbox.put` is what they should call.
"""

from __future__ import annotations

import json
import logging
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import zenoh
from zenoh import ext

from fusion_service.bus.inbox import Inbox
from fusion_service.errors import FusionError, Stopped
from schemas import MAX_BYTES

__all__ = [
    "DEFAULT_ENDPOINT",
    "Bus",
    "BusError",
    "BusStopped",
    "Declaration",
    "Inbox",
    "Publisher",
    "open_bus",
]

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
HEARTBEAT = 0.5
"""Seconds after which a lost last sample is noticed."""
HANDSHAKE = 3.0
"""Seconds that a hub has for the opening of a session; as long may a process that gave up waiting take to end."""
RETRY = 0.2
FIRST, REMIND = 2.0, 30.0
"""Seconds until it is told that the hub is waited for, and between that and the next time."""
MAX_PUBLISHERS = 4096

log = logging.getLogger(__name__)


class BusError(FusionError):
    """What the user can mend about the bus, in one line."""


class BusStopped(Stopped, BusError):
    """`stop` was set while waiting for the hub."""


class _Guard:
    """Stands between the bus and our callbacks: what one raises is logged with its trace, at a bounded rate,
    and harms nothing else; once `open` is false none begins any more."""

    def __init__(self, name: str) -> None:
        self.open = True
        self._name = name
        self._failures = 0
        self._quiet_until = 0.0

    def wrap(self, callback: Callable[[Any], object]) -> Callable[[Any], None]:
        def call(argument: Any) -> None:
            if self.open:
                try:
                    callback(argument)
                except Exception:
                    self.failed()

        return call

    def failed(self) -> None:
        """Log the exception at hand."""
        self._failures += 1
        if time.monotonic() >= self._quiet_until:
            log.exception("the handler of %s failed (%d times until now)", self._name, self._failures)
            self._quiet_until = time.monotonic() + 1.0


class Declaration:
    """Something declared on a bus, taken back by `close` or with the bus. No callback begins after that."""

    def __init__(self, bus: Bus, entities: Sequence[Any], guard: _Guard | None = None) -> None:
        self._bus = bus
        self._entities = list(entities)
        self._guard = guard
        bus._declared[self] = None

    def close(self) -> None:
        """Take it back; a second call does nothing."""
        self._bus._declared.pop(self, None)
        if self._guard is not None:
            self._guard.open = False
        while self._entities:
            self._entities.pop().undeclare()


class Publisher(Declaration):
    """Publishes on one key. Made by `Bus.publisher`."""

    def put(self, data: bytes) -> None:
        """Publish `data`; never waits for a slow reader. While the hub is away nothing is sent, but the last
        `cache` samples go out when it is back. Raises `BusError` if it is closed or the data are too long."""
        if len(data) > MAX_BYTES:
            raise BusError(f"{len(data)} bytes are too many for one message: at most {MAX_BYTES}")
        try:
            self._entities[0].put(data)
        except IndexError:
            raise BusError("this publisher is closed") from None
        except zenoh.ZError as error:
            raise BusError(f"cannot publish: {_reason(error)}") from None


class Bus:
    """An open session, made by `open_bus`. Every method may be called from any thread."""

    def __init__(self, session: Any) -> None:
        self._session = session
        self._declared: dict[Declaration, None] = {}

    @property
    def connected(self) -> bool:
        """Whether a hub or peer is there at this moment."""
        info = self._session.info
        return bool(info.routers_zid() or info.peers_zid())

    def publisher(self, key: str, cache: int = 1) -> Publisher:
        """A publisher on `key` that keeps its last `cache` samples for late joiners and for who missed some."""
        with _readable(key):
            entity = ext.declare_advanced_publisher(
                self._session,
                key,
                cache=ext.CacheConfig(cache),
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=HEARTBEAT, sporadic_heartbeat=None),
                publisher_detection=True,
            )
        return Publisher(self, [entity])

    def subscribe(
        self,
        key_expression: str,
        callback: Callable[[str, bytes], None],
        *,
        history: int = 1,
        on_miss: Callable[[str, int], None] | None = None,
    ) -> Declaration:
        """Call `callback(key, data)` for every sample, in order per publisher, gaps filled where the publisher
        still has the samples; `on_miss(key, count)` says what is lost for good (the key expression instead
        of the key for a publisher of which nothing came yet), on a thread of its own.

        history: how many of the last samples of each publisher, there now or appearing later (also after an
        outage of the hub), come first; 0 none. With more than 1, a publisher that is frozen while we join
        holds up the others until each has sent as many, at most 10 s.
        """
        keys: dict[str, str] = {}

        def receive(sample: Any) -> None:
            if sample.kind != zenoh.SampleKind.PUT:
                return
            key = str(sample.key_expr)
            if on_miss and sample.source_info is not None:
                keys[str(sample.source_info.source_id)] = key
                if len(keys) > MAX_PUBLISHERS:
                    del keys[next(iter(keys))]
            callback(key, bytes(sample.payload))

        def missed(miss: Any) -> None:
            if on_miss:
                on_miss(keys.get(str(miss.source), key_expression), miss.nb)

        guard = _Guard(key_expression)
        past = ext.HistoryConfig(detect_late_publishers=True, max_samples=int(history)) if history else None
        with _readable(key_expression):
            subscriber = ext.declare_advanced_subscriber(
                self._session,
                key_expression,
                guard.wrap(receive),
                history=past,
                recovery=ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
            )
        entities: list[Any] = [subscriber]
        if on_miss:
            entities.append(subscriber.sample_miss_listener(guard.wrap(missed)))
        return Declaration(self, entities, guard)

    def announce(self, key: str) -> Declaration:
        """A liveliness token: `watch` elsewhere sees it appear, and go when it is closed or the process dies."""
        with _readable(key):
            return Declaration(self, [self._session.liveliness().declare_token(key)])

    def watch(self, key_expression: str, callback: Callable[[str, bool], None]) -> Declaration:
        """Call `callback(key, alive)` for every token there is now and whenever one comes or goes. The loss of
        the hub is the loss of all."""

        def change(sample: Any) -> None:
            callback(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        guard = _Guard(key_expression)
        with _readable(key_expression):
            entity = self._session.liveliness().declare_subscriber(key_expression, guard.wrap(change), history=True)
        return Declaration(self, [entity], guard)

    def present(self, key_expression: str, timeout: float = 1.0) -> tuple[list[str], bool]:
        """The tokens there are now, and whether the hub was there to say so. Waits for it up to `timeout` seconds: not
        for use in a callback, nor on a session that watches such keys, which asks nobody but answers from what it has
        heard."""
        there = self.connected
        with _readable(key_expression):
            replies = list(self._session.liveliness().get(key_expression, timeout=timeout))
        keys = {str(reply.ok.key_expr): None for reply in replies if reply.ok}
        return list(keys), there and self.connected and all(reply.ok for reply in replies)

    def answer(self, key: str, handler: Callable[[bytes | None], bytes]) -> Declaration:
        """Answer every `ask` on `key` with `handler(payload)`. If it raises, who asked is told."""
        guard = _Guard(key)

        def reply(query: Any) -> None:
            with query:
                try:
                    answer = handler(None if query.payload is None else bytes(query.payload))
                except Exception as error:
                    query.reply_err(str(error) or type(error).__name__)
                    raise
                query.reply(key, answer)

        with _readable(key):
            return Declaration(self, [self._session.declare_queryable(key, guard.wrap(reply))], guard)

    def ask(self, key: str, payload: bytes | None = None, timeout: float = 1.0) -> list[tuple[str, bytes]]:
        """Ask everyone who answers on `key` (an expression may reach several): (key, data) of each answer,
        none if nobody is there. Raises `BusError` if all that came are errors or `timeout` seconds have passed.
        Waits: not for use in a callback."""
        with _readable(key):
            replies = list(
                self._session.get(
                    key,
                    payload=payload,
                    timeout=timeout,
                    target=zenoh.QueryTarget.ALL,
                    consolidation=zenoh.ConsolidationMode.NONE,
                )
            )
        answers = [(str(reply.ok.key_expr), bytes(reply.ok.payload)) for reply in replies if reply.ok]
        errors = [bytes(reply.err.payload).decode(errors="replace") for reply in replies if reply.err]
        if errors and not answers:
            raise BusError(f"{key} answers: {errors[0]}")
        for error in errors:
            log.warning("%s answers: %s", key, error)
        return answers

    def _close(self) -> None:
        try:
            for declaration in reversed(list(self._declared)):
                try:
                    declaration.close()
                except zenoh.ZError as error:
                    log.warning("cannot take back a declaration: %s", _reason(error))
        finally:
            self._session.close()


@contextmanager
def open_bus(
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    mode: Literal["client", "router", "peer"] = "client",
    *,
    wait: bool | float = True,
    stop: threading.Event | None = None,
) -> Iterator[Bus]:
    """A session as a context manager; everything declared on it is taken back and it is closed on every path.

    connect, listen: endpoints as "tcp/host:port"; a client connects and a router listens at
    `DEFAULT_ENDPOINT` unless told otherwise. A client waits for its hub: for ever (`wait=True`), so many
    seconds, or for one try (False, 0); signals and `stop` interrupt it at once. It reconnects by itself later on.
    A router or peer connects in the background. Raises `BusError` in one line if an endpoint is bad, in use or not
    to be reached in time, `BusStopped` if `stop` was set.
    """
    if mode == "client":
        connect = connect or (DEFAULT_ENDPOINT,)
    elif mode == "router":
        listen = listen or (DEFAULT_ENDPOINT,)
    config = _config(connect, listen, mode)
    if mode == "client":
        session = _join(config, ", ".join(connect), wait, stop)
    else:
        try:
            session = zenoh.open(config)
        except zenoh.ZError as error:
            if "in use" in str(error):
                raise BusError(f"{', '.join(listen)} is in use: is a hub running there already?") from None
            raise BusError(f"cannot listen on {', '.join(listen)}: {_reason(error)}") from None
    bus = Bus(session)
    try:
        yield bus
    finally:
        bus._close()


def _config(connect: Sequence[str], listen: Sequence[str], mode: str) -> zenoh.Config:
    settings: dict[str, Any] = {
        "mode": mode,
        "connect/endpoints": list(connect),
        "listen/endpoints": list(listen),
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "transport/unicast/open_timeout": round(1000 * HANDSHAKE),
        "timestamping/enabled": True,  # publishers that keep samples need it
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": 2 * MAX_BYTES,  # what is longer is dropped before it takes memory
    }
    if mode == "client":
        settings["connect/timeout_ms"] = 0  # one attempt per zenoh.open
    config = zenoh.Config()
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError:
            raise BusError(f"bad endpoint in {value}: write tcp/host:port, as in {DEFAULT_ENDPOINT}") from None
    return config


def _join(config: zenoh.Config, endpoints: str, wait: bool | float, stop: threading.Event | None) -> Any:
    """A client's session. `zenoh.open` lets no signal through while it waits for an answer, up to `HANDSHAKE`:
    it runs on a thread of its own, left to itself if nobody waits any more. Not a daemon thread: one that
    comes back from Zenoh while the interpreter goes down aborts the process."""
    lock = threading.Lock()
    changed = threading.Event()
    abandoned = threading.Event()
    sessions: list[Any] = []

    def attempt() -> None:
        while not abandoned.is_set():
            try:
                session: Any = zenoh.open(config)
            except zenoh.ZError:  # says no more than that it could not
                if not wait:
                    break
                abandoned.wait(RETRY)
                continue
            with lock:
                if not abandoned.is_set():
                    sessions.append(session)
                    break
            session.close()
        changed.set()

    begin = time.monotonic()
    deadline = None if wait is True or not wait else begin + wait
    remind = begin + FIRST
    threading.Thread(target=attempt, name="bus-join").start()
    try:
        while not changed.wait(0.05):
            now = time.monotonic()
            if stop is not None and stop.is_set():
                raise BusStopped(f"stopped while waiting for the hub at {endpoints}")
            if deadline is not None and now >= deadline:
                break
            if now >= remind:
                log.warning("waiting for the hub at %s (`fusion-service hub` starts one)", endpoints)
                remind = now + REMIND
        with lock:
            if sessions:
                return sessions.pop()
        raise BusError(f"no hub answers at {endpoints}: start one with `fusion-service hub`")
    finally:
        with lock:
            abandoned.set()
        for session in sessions:
            session.close()


@contextmanager
def _readable(key: str) -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise BusError(f"{key}: {_reason(error)}") from None


def _reason(error: Exception) -> str:
    """A Zenoh error without the places in its source, on one line."""
    return " ".join(re.sub(r"\s*at \S+\.rs:\d+\.?", "", str(error)).split())
