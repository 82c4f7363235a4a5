"""Who is let in: the name by which the console is called, where a page comes from, the token, and the headers that
keep a page to itself. Plain ASGI, before all else.

A page of another origin cannot read or steer the console: the Host header must be one of the console's own names (so
that a name of somebody else's that was made to point here, DNS rebinding, opens nothing), and an Origin that is said
must be that of the Host. The Content-Security-Policy allows no script but the package's files, none inline, and no
making of markup from text; no other page may frame it.
"""

from __future__ import annotations

import hmac
import ipaddress
import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

__all__ = ["Doors", "Guard", "is_loopback", "tiles_origin"]

HOST = re.compile(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9.-]{1,253})(?::(\d{1,5}))?\Z", re.ASCII)
LOOPBACK_NAMES = ("localhost",)


def is_loopback(host: str) -> bool:
    """Whether only this computer can reach what listens at this host."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host in LOOPBACK_NAMES


def tiles_origin(url: str) -> str:
    """scheme://host of a template of tiles, for the policy. `ValueError` in one line where it is none."""
    parts = urlsplit(url)
    host = parts.hostname or ""
    if (
        parts.scheme not in ("http", "https")
        or not host
        or not {"{x}", "{y}", "{z}"} <= set(re.findall(r"\{\w\}", url))
    ):
        raise ValueError(f"{url!r} is no address of tiles: write https://HOST/{{z}}/{{x}}/{{y}}.png")
    if "{" in parts.netloc or any(mark in url for mark in " ;,'\"") or not url.isprintable():
        raise ValueError(f"{url!r}: the host of tiles is one name, and no blanks, quotes, ; or , are in the address")
    return f"{parts.scheme}://{parts.netloc}"


@dataclass(frozen=True)
class Doors:
    """token: that opens; locked: whether it takes the token to look; names: by which the console may be called beside
    localhost and bare addresses; tiles: origin of the map's, or ""."""

    token: str
    locked: bool
    names: frozenset[str] = frozenset()
    tiles: str = ""

    def host_is_ours(self, host: str) -> bool:
        """Whether a Host header names the console: a bare address cannot be anybody else's name."""
        match = HOST.match(host)
        if match is None:
            return False
        name = match[1].strip("[]").lower()
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name in LOOPBACK_NAMES or name in self.names
        return True

    def opens(self, said: str | None) -> bool:
        """Whether this is the token; takes as long for any."""
        return said is not None and hmac.compare_digest(said.encode(), self.token.encode())

    def policy(self, host: str) -> str:
        """The Content-Security-Policy of a page that was asked for by this Host."""
        rules = {
            "default-src": "'none'",
            "script-src": "'self'",
            "style-src": "'self'",
            "img-src": f"'self' data: {self.tiles}".strip(),
            "connect-src": f"'self' ws://{host} wss://{host}",
            "base-uri": "'none'",
            "form-action": "'none'",
            "frame-ancestors": "'none'",
            "require-trusted-types-for": "'script'",
            "trusted-types": "default",
        }
        return "; ".join(f"{name} {value}" for name, value in rules.items())


class Guard:
    """The ASGI application `app` behind its doors."""

    def __init__(self, app: Any, doors: Doors) -> None:
        self._app, self._doors = app, doors

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        """Let a request in, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        host, refusal = self._refusal(scope)
        if refusal and scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": refusal})
            return
        kept = [
            (b"content-security-policy", self._doors.policy(host if not refusal else "localhost").encode()),
            (b"x-content-type-options", b"nosniff"),
            (b"referrer-policy", b"no-referrer"),
            (b"cross-origin-opener-policy", b"same-origin"),
            (b"cross-origin-resource-policy", b"same-origin"),
            (b"cache-control", b"no-cache"),
        ]
        if refusal:
            body = json.dumps({"wrong": refusal}).encode()
            kept += [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
            await send({"type": "http.response.start", "status": 403, "headers": kept})
            await send({"type": "http.response.body", "body": body})
            return

        async def with_headers(message: dict[str, Any]) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", ()), *kept]}
            await send(message)

        await self._app(scope, receive, with_headers)

    def _refusal(self, scope: dict[str, Any]) -> tuple[str, str]:
        """The Host of a request, and why it is not let in; "" where it is."""
        hosts, origins = _said(scope, b"host"), _said(scope, b"origin")
        host = hosts[0] if len(hosts) == 1 else ""
        if not self._doors.host_is_ours(host):
            return host, "the console is not called by this name: see `fusion-service console --name`"
        if origins and any(origin not in (f"http://{host}", f"https://{host}") for origin in origins):
            return host, "the console answers its own page only"
        return host, ""


def _said(scope: dict[str, Any], name: bytes) -> list[str]:
    headers: Iterable[tuple[bytes, bytes]] = scope["headers"]
    return [value.decode("latin-1") for key, value in headers if key.lower() == name]
