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

import functools
import logging
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, Literal

import zenoh
from zenoh import ext

from fusion_service.bus.endpoint import DEFAULT_ENDPOINT
from fusion_service.bus.errors import BusError, BusStopped
from fusion_service.bus.inbox import Inbox
from fusion_service.bus.joining import join, reason, session_config
from fusion_service.bus.security import Security, secured
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
    "tell_refusals",
]

HEARTBEAT = 0.5
"""Seconds after which a lost last sample is noticed."""
MAX_PUBLISHERS = 4096

log = logging.getLogger(__name__)


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
            raise BusError(f"cannot publish: {reason(error)}") from None


class Bus:
    """An open session, made by `open_bus`. Every method may be called from any thread."""

    def __init__(self, session: Any, rights: Mapping[str, Sequence[str]] | None = None) -> None:
        self._session = session
        self._rights = rights
        self._declared: dict[Declaration, None] = {}

    @property
    def connected(self) -> bool:
        """Whether a hub or peer is there at this moment."""
        info = self._session.info
        return bool(info.routers_zid() or info.peers_zid())

    @property
    def readable(self) -> tuple[str, ...]:
        """Key expressions that this party may subscribe to: all, where the hub sets no bounds."""
        return ("**",) if self._rights is None else tuple(self._rights.get("subscribe", ()))

    def _may(self, act: str, key: str) -> AbstractContextManager[None]:
        """Raises `BusError` for what the hub would drop without a word; then as `_readable`."""
        given = None if self._rights is None else self._rights.get(act, ())
        with _readable(key):
            if given is not None and not any(zenoh.KeyExpr(one).includes(zenoh.KeyExpr(key)) for one in given):
                who = ", ".join(self._rights.get("who", ())) if self._rights else ""
                raise BusError(f"{key}: {who} may not {act} there, only on: {', '.join(given) or 'nothing'}")
        return _readable(key)

    def publisher(self, key: str, cache: int = 1) -> Publisher:
        """A publisher on `key` that keeps its last `cache` samples for late joiners and for who missed some."""
        with self._may("publish", key):
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
        with self._may("subscribe", key_expression):
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

    def overhear(self, key_expression: str, callback: Callable[[str, int], None]) -> Declaration:
        """Call `callback(key, bytes)` for every sample from now on: nobody is asked for what came before or was lost,
        and publishers do not notice."""

        def receive(sample: Any) -> None:
            callback(str(sample.key_expr), len(sample.payload))

        guard = _Guard(key_expression)
        with self._may("subscribe", key_expression):
            entity = self._session.declare_subscriber(key_expression, guard.wrap(receive))
        return Declaration(self, [entity], guard)

    def announce(self, key: str) -> Declaration:
        """A liveliness token: `watch` elsewhere sees it appear, and go when it is closed or the process dies."""
        with self._may("publish", key):
            return Declaration(self, [self._session.liveliness().declare_token(key)])

    def watch(self, key_expression: str, callback: Callable[[str, bool], None]) -> Declaration:
        """Call `callback(key, alive)` for every token there is now and whenever one comes or goes. The loss of
        the hub is the loss of all."""

        def change(sample: Any) -> None:
            callback(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        guard = _Guard(key_expression)
        with self._may("subscribe", key_expression):
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
        return self.answer_each(key, lambda _, payload: handler(payload))

    def answer_each(self, key_expression: str, handler: Callable[[str, bytes | None], bytes]) -> Declaration:
        """The same for many keys, with `handler(key, payload)`, the key as it was asked on. Who asked cannot be told
        from a question, but a hub with a security file lets each party ask on keys of its own only."""
        guard = _Guard(key_expression)

        def reply(query: Any) -> None:
            asked = str(query.key_expr)
            with query:
                try:
                    answer = handler(asked, None if query.payload is None else bytes(query.payload))
                except Exception as error:
                    query.reply_err(str(error) or type(error).__name__)
                    raise
                query.reply(asked if "*" in key_expression else key_expression, answer)

        with self._may("publish", key_expression):
            return Declaration(self, [self._session.declare_queryable(key_expression, guard.wrap(reply))], guard)

    def answer_later(
        self,
        key_expression: str,
        handler: Callable[[str, bytes | None, Callable[[bytes | Exception], None]], None],
    ) -> Declaration:
        """The same where an answer may take its time: `handler(key, payload, reply)` returns at once, and from any
        thread `reply` is called with the answer, or with what is wrong, once."""
        guard = _Guard(key_expression)

        def take(query: Any) -> None:
            asked = str(query.key_expr)
            key = asked if "*" in key_expression else key_expression

            def reply(answer: bytes | Exception) -> None:
                try:
                    with query:
                        if isinstance(answer, Exception):
                            query.reply_err(str(answer) or type(answer).__name__)
                        else:
                            query.reply(key, answer)
                except zenoh.ZError as error:  # who asked is gone, or the session
                    log.warning("%s: cannot answer: %s", key, reason(error))

            try:
                handler(asked, None if query.payload is None else bytes(query.payload), reply)
            except Exception as error:
                reply(error)
                raise

        with self._may("publish", key_expression):
            return Declaration(self, [self._session.declare_queryable(key_expression, guard.wrap(take))], guard)

    def ask(self, key: str, payload: bytes | None = None, timeout: float = 1.0) -> list[tuple[str, bytes]]:
        """Ask everyone who answers on `key` (an expression may reach several): (key, data) of each answer,
        none if nobody is there. Raises `BusError` if all that came are errors or `timeout` seconds have passed.
        Waits: not for use in a callback."""
        with self._may("ask", key):
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

    def on_link(self, callback: Callable[[str, str, bool], None]) -> Declaration:
        """Call `callback(common name of its certificate or "", where from, whether it is there)` for every link that
        there is, comes or goes."""

        def change(event: Any) -> None:
            link = event.link
            callback(link.auth_identifier or "", link.dst, event.kind == zenoh.SampleKind.PUT)

        guard = _Guard("links")
        return Declaration(
            self, [self._session.info.declare_link_events_listener(guard.wrap(change), history=True)], guard
        )

    def _close(self) -> None:
        try:
            for declaration in reversed(list(self._declared)):
                try:
                    declaration.close()
                except zenoh.ZError as error:
                    log.warning("cannot take back a declaration: %s", reason(error))
        finally:
            self._session.close()


@functools.cache
def tell_refusals() -> None:
    """Let Zenoh say on stdout which links it refuses, and why (at most ten lines a second: it waits between them)."""
    os.environ.setdefault("NO_COLOR", "1")
    zenoh.init_log_from_env_or("zenoh_link_tls=warn")


@contextmanager
def open_bus(
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    mode: Literal["client", "router", "peer"] = "client",
    *,
    wait: bool | float = True,
    stop: threading.Event | None = None,
    security: Security | None = None,
) -> Iterator[Bus]:
    """A session as a context manager; everything declared on it is taken back and it is closed on every path.

    connect, listen: endpoints as "tcp/host:port"; a client connects and a router listens at
    `DEFAULT_ENDPOINT` unless told otherwise. A client waits for its hub: for ever (`wait=True`), so many
    seconds, or for one try (False, 0); signals and `stop` interrupt it at once. It reconnects by itself later on.
    A router or peer connects in the background. security: both ends show certificates, by TLS; tcp/ is read as tls/
    then. Raises `BusError` in one line if an endpoint is bad, in use or not to be reached in time, and why a hub
    refuses us, `BusStopped` if `stop` was set, `SecurityError` for certificates that nobody would take.
    """
    if mode == "client":
        connect = connect or (DEFAULT_ENDPOINT,)
    elif mode == "router":
        listen = listen or (DEFAULT_ENDPOINT,)
    if security is not None:
        connect, listen = secured(connect), secured(listen)
    rights = None
    if mode == "client":
        session, rights = join(connect, wait, stop, security)
    else:
        config = session_config(connect, listen, mode, security)
        try:
            session = zenoh.open(config)
        except zenoh.ZError as error:
            if "in use" in str(error):
                raise BusError(f"{', '.join(listen)} is in use: is a hub running there already?") from None
            raise BusError(f"cannot listen on {', '.join(listen)}: {reason(error)}") from None
    bus = Bus(session, rights)
    try:
        yield bus
    finally:
        bus._close()


@contextmanager
def _readable(key: str) -> Iterator[None]:
    try:
        yield
    except zenoh.ZError as error:
        raise BusError(f"{key}: {reason(error)}") from None
