"""The console's pages and its stream, as a Starlette application.

    GET  /                the page, and its files below /static
    GET  /healthz         that it is there
    WS   /stream          what there is to see (see `stream`), one connection a page
    POST /order           an order: {"centre": name, "order": map}, with the token, from the console's own page

A stream says what the page has not seen yet, the newest picture and no queue: while a slow browser has not taken one,
the next are left out. Its connection ends where it takes nothing for `PATIENCE` seconds.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from fusion_service.console.doors import Doors, Guard
from fusion_service.console.listening import Listener
from fusion_service.console.ordering import order_request
from fusion_service.console.packing import text
from fusion_service.console.state import Seen, State
from fusion_service.errors import OrderError

__all__ = ["Console", "application"]

log = logging.getLogger(__name__)

STATIC = Path(__file__).parent / "static"
MOST_PAGES = 16
TICK = 0.15
"""Seconds between two looks for news."""
PULSE = 1.0
PATIENCE = 20.0
TOKEN_IN = 10.0
"""Seconds in which a page says the token, where it takes one."""
MOST_WORDS = 4096
"""Bytes of an order, and of what a page says on its stream."""
RATE = 20.0
"""Messages of a page a second, and as many at once."""
REFUSED, TOO_MANY, TOO_MUCH = 4401, 4429, 4408
"""Codes with which a stream is closed: no or a wrong token; too many pages; too much is said."""


@dataclass
class Console:
    """What the application serves. hello: what a page is told first; orders: whether it may order; who: the name of
    the operator's certificate, ""; pages: how many are open."""

    state: State
    listener: Listener
    doors: Doors
    hello: Mapping[str, Any]
    orders: bool = False
    who: str = ""
    pages: int = field(default=0, init=False)

    async def page(self, request: Request) -> Response:
        """The page."""
        return FileResponse(STATIC / "index.html")

    async def health(self, request: Request) -> Response:
        """That the console is there."""
        return PlainTextResponse("ok\n")

    async def order(self, request: Request) -> Response:
        """Give an order, and say what the centre answers."""
        said = request.headers.get("authorization", "").removeprefix("Bearer ")
        if not self.doors.opens(said) or "origin" not in request.headers:
            return _wrong(403, "an order needs the token, from the console's own page: open the address it printed")
        if not self.orders:
            return _wrong(403, "orders are off: start the console with --allow-orders")
        if request.headers.get("content-type", "").partition(";")[0] != "application/json":
            return _wrong(415, "an order is JSON")
        body = b""
        async for part in request.stream():
            body += part
            if len(body) > MOST_WORDS:
                return _wrong(413, "an order is shorter")
        try:
            raw = json.loads(body)
            centre = raw["centre"]
            asked = order_request(raw["order"], self.who)
            if centre not in self.state.names():
                raise ValueError("there is no such centre")
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            return _wrong(400, str(error)[:300] or "an order is a map")
        try:
            answer = await run_in_threadpool(self.listener.order, centre, asked)
        except OrderError as error:
            self._audit(request, centre, asked, str(error))
            return _wrong(502, str(error)[:300])
        if asked["what"] != "list":
            self._audit(request, centre, asked, str(answer.get("outcome")))
        return Response(text(answer), media_type="application/json")

    def _audit(self, request: Request, centre: str, asked: Mapping[str, Any], outcome: str) -> None:
        """The console's own line for an order; the centre's log has one too, where it came so far."""
        where = request.client.host if request.client else "?"
        log.warning("order of %s from %s to %s: %s: %s", asked.get("who", "?"), where, centre, text(asked), outcome)

    async def stream(self, socket: WebSocket) -> None:
        """Serve a page as long as it is open."""
        await socket.accept()
        if self.pages >= MOST_PAGES:
            await socket.close(TOO_MANY, f"{MOST_PAGES} pages are open already")
            return
        self.pages += 1
        try:
            known, first = await self._opened(socket)
            if known is None:
                await socket.close(REFUSED, "the token is missing or wrong")
                return
            await _Stream(socket, self, known, first).run()
        except (WebSocketDisconnect, TimeoutError, OSError, RuntimeError):
            pass
        finally:
            self.pages -= 1
            with suppress(Exception):
                await socket.close()

    async def _opened(self, socket: WebSocket) -> tuple[bool | None, dict[str, Any]]:
        """Whether the page has the token, by its header or first words, None: it is not let in; and these words."""
        if self.doors.opens(socket.headers.get("authorization", "").removeprefix("Bearer ")):
            return True, {}
        try:
            first = _words(await asyncio.wait_for(socket.receive_text(), TOKEN_IN))
        except (TimeoutError, KeyError):
            first = {}
        token = first.get("token")
        known = isinstance(token, str) and self.doors.opens(token)
        return (known if known or not self.doors.locked else None), first


class _Stream:
    """One page's: what it has seen, and what it wants to."""

    def __init__(self, socket: WebSocket, console: Console, known: bool, first: Mapping[str, Any]) -> None:
        self._socket, self._console, self._known = socket, console, known
        self._seen = Seen()
        self._wish = ""
        self._take(first)

    async def run(self) -> None:
        may = self._console.orders and self._known
        await self._send(text({**self._console.hello, "type": "hello", "may_order": may}))
        reading = asyncio.create_task(self._read())
        try:
            await self._write(reading)
        finally:
            reading.cancel()
            with suppress(asyncio.CancelledError, Exception):
                await reading

    async def _write(self, reading: asyncio.Task[None]) -> None:
        state, said, shown = self._console.state, -PULSE, ""
        while not reading.done():
            if not self._seen.centre:
                self._choose(state.names())
            now, before = time.monotonic(), self._seen
            if now - said >= PULSE or before.centre != shown:
                said, shown = now, before.centre
                await self._send(text(state.pulse(shown)))
            after, news = state.news(before)
            for one in news:
                await self._send(one)
            if self._seen == before:
                self._seen = after
            elif self._seen.centre == before.centre:  # the page asked for another track meanwhile
                self._seen = after._replace(track=self._seen.track, explained=(-1, -1))
            await asyncio.wait({reading}, timeout=TICK)

    def _choose(self, names: list[str]) -> None:
        if name := self._wish if self._wish in names else next(iter(names), ""):
            self._seen = Seen(name, track=self._seen.track)

    async def _send(self, what: str | bytes) -> None:
        sending = self._socket.send_text(what) if isinstance(what, str) else self._socket.send_bytes(what)
        await asyncio.wait_for(sending, PATIENCE)

    async def _read(self) -> None:
        """What the page says: which centre, and which track."""
        allowance, before = RATE, time.monotonic()
        while True:
            words = await self._socket.receive_text()
            now = time.monotonic()
            allowance, before = min(allowance + RATE * (now - before), RATE) - 1.0, now
            if allowance < 0:
                await self._socket.close(TOO_MUCH, "too much is said")
                return
            self._take(_words(words))

    def _take(self, words: Mapping[str, Any]) -> None:
        name, track = words.get("centre"), words.get("track")
        if isinstance(name, str) and name:
            self._wish = name
            if name in self._console.state.names():
                self._seen = Seen(name)
        if "track" in words:
            number = int(track) if isinstance(track, str) and track.isdecimal() and len(track) <= 20 else None
            good = number is not None and number < 2**64
            self._seen = self._seen._replace(track=number if good else None, explained=(-1, -1))


def application(console: Console) -> Guard:
    """The ASGI application."""
    routes = [
        Route("/", console.page),
        Route("/healthz", console.health),
        Route("/order", console.order, methods=["POST"]),
        WebSocketRoute("/stream", console.stream),
        Mount("/static", StaticFiles(directory=STATIC)),
    ]
    return Guard(Starlette(routes=routes), console.doors)


def _words(said: str) -> dict[str, Any]:
    """A map that a page sends; nothing for what is none."""
    try:
        found = json.loads(said)
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _wrong(code: int, why: str) -> Response:
    return JSONResponse({"wrong": why}, code)
