"""The process of the console: a web server on a thread, the bus on this one, until a signal comes."""

from __future__ import annotations

import logging
import secrets
import socket
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fusion_service import __version__
from fusion_service.bus.security import Security
from fusion_service.colours import BLUE, GREEN, ORANGE, SKY, VERMILION
from fusion_service.console.doors import Doors, is_loopback, tiles_origin
from fusion_service.console.listening import Listener
from fusion_service.console.ordering import orders_offered
from fusion_service.console.state import State
from fusion_service.errors import UsageError
from fusion_service.extras import install_hint

__all__ = ["ConsoleOptions", "run_console"]

log = logging.getLogger(__name__)

CONNECTIONS = 64
"""Connections at a time."""
LEAST_TOKEN = 16
ANYWHERE = ("0.0.0.0", "::")
"""Hosts by which all addresses of this computer are meant: it is called by its name then."""


@dataclass(frozen=True)
class ConsoleOptions:
    """listen: host and port, 0 for one that is free; centre: the only one that is shown, None: all; names: by which the
    console may be called; tiles: template of the addresses of a map, and to whom it is owed; certificate, key: for
    https; token: file that holds it, None: made anew."""

    connect: Sequence[str]
    listen: tuple[str, int]
    realm: str = "fusion"
    centre: str | None = None
    security: Security | None = None
    orders: bool = False
    names: Sequence[str] = ()
    tiles: str = ""
    attribution: str = ""
    certificate: Path | None = None
    key: Path | None = None
    token: Path | None = None


def run_console(options: ConsoleOptions, stop: threading.Event, ready: Callable[[], None] = lambda: None) -> None:
    """Serve until `stop` is set; ready: called when pages are served. Raises `UsageError` for what cannot be served,
    `BusError`, `SecurityError`."""
    try:
        import uvicorn

        from fusion_service.console.server import Console, application
    except ImportError as error:
        raise UsageError(f"the console needs a web server: {install_hint('console')} ({error})") from None
    host, port = options.listen
    token = _token(options.token)
    names = frozenset([*options.names, *([socket.gethostname().lower()] if host in ANYWHERE else [])])
    doors = Doors(token, not is_loopback(host), names, _tiles(options.tiles))
    state = State()
    listener = Listener(
        state,
        connect=list(options.connect),
        realm=options.realm,
        centre=options.centre,
        security=options.security,
    )
    who = options.security.name if options.security is not None else ""
    console = Console(state, listener, doors, _hello(options, who), orders=options.orders, who=who)
    with _bound(host, port) as sock:
        config = uvicorn.Config(
            application(console),
            lifespan="off",
            log_config=None,
            log_level="warning",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            ws_max_size=4096,
            ws_per_message_deflate=False,
            limit_concurrency=CONNECTIONS,
            timeout_graceful_shutdown=1,
            ssl_certfile=options.certificate,
            ssl_keyfile=options.key,
        )
        server = uvicorn.Server(config)
        serving = threading.Thread(target=server.run, kwargs={"sockets": [sock]}, name="console-web")
        serving.start()
        try:
            print(_address(options, sock, token, doors.locked), flush=True)
            ready()
            listener.run(stop)
        finally:
            server.should_exit = True
            serving.join()


def _hello(options: ConsoleOptions, who: str) -> dict[str, Any]:
    """What a page is told first."""
    return {
        "version": __version__,
        "realm": options.realm,
        "orders": orders_offered() if options.orders else None,
        "who": who,
        "tiles": options.tiles,
        "attribution": options.attribution,
        "colours": {"blue": BLUE, "orange": ORANGE, "green": GREEN, "sky": SKY, "vermilion": VERMILION},
    }


def _bound(host: str, port: int) -> socket.socket:
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise UsageError(f"cannot listen on {host} {port}: {error.strerror or error}: give another --listen") from None


def _token(path: Path | None) -> str:
    if path is None:
        return secrets.token_urlsafe(24)
    try:
        token = path.read_text("utf-8").strip()
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: cannot be read: {error}") from None
    if len(token) < LEAST_TOKEN or not token.isascii() or not token.isprintable() or " " in token:
        raise UsageError(f"{path}: a token is a text of {LEAST_TOKEN} characters or more, without blanks")
    return token


def _tiles(url: str) -> str:
    try:
        return tiles_origin(url) if url else ""
    except ValueError as error:
        raise UsageError(str(error)) from None


def _address(options: ConsoleOptions, sock: socket.socket, token: str, locked: bool) -> str:
    """Where the console is, as it is opened; the token stands behind the #, which a browser sends to nobody."""
    host, port = sock.getsockname()[:2]
    host = socket.gethostname() if host in ANYWHERE else host
    host = f"[{host}]" if ":" in host else host
    scheme = "https" if options.certificate else "http"
    secret = f"#token={token}" if locked or options.orders else ""
    return f"console: {scheme}://{host}:{port}/{secret}"
