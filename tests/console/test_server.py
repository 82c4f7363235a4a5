"""The web server without a browser: doors, token, orders, streams."""

from __future__ import annotations

import hashlib
import json
import re
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any, Self, cast

import pytest
import uvicorn
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from fusion_service.console import server as server_module
from fusion_service.console.doors import Doors, is_loopback, tiles_origin
from fusion_service.console.listening import Listener
from fusion_service.console.ordering import order_request, orders_offered
from fusion_service.console.server import REFUSED, TOO_MUCH, Console, application
from fusion_service.console.state import Seen, State
from fusion_service.errors import OrderError
from tests.console.scenes import FIRST, ask, picture, unpacked
from tests.helpers.processes import eventually

TOKEN = "a-token-of-this-test"


class Centre:
    """Stands for the bus: answers orders as it is told to."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, Mapping[str, Any]]] = []
        self.away = False

    def order(self, centre: str, request: Mapping[str, Any]) -> dict[str, Any]:
        if self.away:
            raise OrderError("the hub is away: nothing was ordered")
        self.asked.append((centre, request))
        return {"number": len(self.asked), "done": True, "outcome": "so be it", "track": 2**63, "kept": True}


class Served:
    """A console's server on a thread of this process."""

    def __init__(self, stack: ExitStack, locked: bool, orders: bool) -> None:
        self.state, self.centre = State(), Centre()
        self.state.take(picture(3))
        doors = Doors(TOKEN, locked, frozenset({"console.example.org"}), "https://tiles.example.org")
        hello = {"orders": orders_offered() if orders else None}
        self.console = Console(self.state, cast(Listener, self.centre), doors, hello, orders=orders)
        config = uvicorn.Config(
            application(self.console), host="127.0.0.1", port=0, lifespan="off", log_config=None, ws_max_size=4096,
            timeout_graceful_shutdown=1,
        )  # fmt: skip
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run)
        thread.start()
        stack.callback(thread.join)
        stack.callback(setattr, server, "should_exit", True)
        eventually(lambda: server.started)
        self.port = server.servers[0].sockets[0].getsockname()[1]

    @property
    def own(self) -> dict[str, str]:
        return {"Origin": f"http://127.0.0.1:{self.port}"}

    @contextmanager
    def stream(self, token: str | None = "", **headers: str) -> Iterator[ClientConnection]:
        with connect(f"ws://127.0.0.1:{self.port}/stream", additional_headers=headers, open_timeout=20) as stream:
            if token is not None:
                stream.send(json.dumps({"token": token}))
            yield stream

    def order(self, order: Any, centre: str = "centre", **headers: str) -> tuple[int, dict[str, Any]]:
        given = {"Authorization": f"Bearer {TOKEN}", "Content_Type": "application/json", **self.own, **headers}
        code, _, body = ask(
            self.port, "/order", "POST", json.dumps({"centre": centre, "order": order}).encode(), **given
        )
        return code, json.loads(body)


@pytest.fixture(scope="module")
def servers() -> Iterator[tuple[Served, Served]]:
    """One that anybody on this computer may look at, with orders; one that takes the token, without."""
    with ExitStack() as stack:
        yield Served(stack, locked=False, orders=True), Served(stack, locked=True, orders=False)


@pytest.fixture
def free(servers: tuple[Served, Served]) -> Served:
    return servers[0]


@pytest.fixture
def locked(servers: tuple[Served, Served]) -> Served:
    return servers[1]


class Slow:
    """A page that reads when it is told to: its socket, and nothing beside it that would."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=20)
        self._file = self._socket.makefile("rb")
        hello = f"GET /stream HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        key = "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
        self._socket.sendall(f"{hello}{key}".encode())
        while self._file.readline() != b"\r\n":
            pass
        self._socket.sendall(b"\x81\x82\0\0\0\0{}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._socket.close()

    def frame(self, word: bytes) -> bytes:
        """The beginning of the next message that has this word there."""
        while True:
            length = self._file.read(2)[1]
            length = int.from_bytes(self._file.read({126: 2, 127: 8}.get(length, 0)), "big") or length
            begin = self._file.read(length)[:1000]
            if word in begin:
                return begin


def chatter(stream: ClientConnection) -> None:
    for _ in range(100):
        stream.send(json.dumps({"track": None}))
    heard(stream, "never said")


def heard(stream: ClientConnection, kind: str) -> dict[str, Any]:
    """The next message of a kind."""
    while True:
        data = stream.recv(20)
        message: dict[str, Any] = json.loads(data) if isinstance(data, str) else unpacked(data)
        if message["type"] == kind:
            return message


def test_pages_keep_to_themselves(free: Served) -> None:
    for path in ("/", "/static/main.js", "/static/leaflet/leaflet.js", "/static/nothing.js"):
        code, headers, _ = ask(free.port, path)
        assert code == (404 if "nothing" in path else 200)
        policy = headers["content-security-policy"]
        assert "default-src 'none'; script-src 'self'; style-src 'self'" in policy
        assert "unsafe" not in policy
        assert "frame-ancestors 'none'" in policy
        assert "require-trusted-types-for 'script'" in policy
        assert "img-src 'self' data: https://tiles.example.org;" in policy
        assert headers["x-content-type-options"] == "nosniff"
    page = ask(free.port, "/")[2].decode()
    assert "<script>" not in page
    assert "style=" not in page
    assert " on" + "click=" not in page
    assert "http://" not in page
    assert "https://" not in page
    for outside in ("/static/../server.py", "/static/%2e%2e/server.py", "/static/..%2fserver.py"):
        assert ask(free.port, outside)[0] == 404
    assert ask(free.port, "/healthz")[2] == b"ok\n"


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1.evil.example", "", "localhost@evil", "a b"]
)
def test_names_of_others_open_nothing(free: Served, host: str) -> None:
    """As after DNS rebinding: a page of another name that reaches us."""
    assert ask(free.port, "/", Host=host.format(port=free.port))[0] in (400, 403)


def test_own_names_open(free: Served) -> None:
    for host in (
        "localhost:1",
        "127.0.0.1",
        "[::1]:8787",
        "192.0.2.7:80",
        "console.example.org",
        "Console.Example.org:443",
    ):
        assert ask(free.port, "/", Host=host)[0] == 200, host


@pytest.mark.parametrize("origin", ["https://evil.example", "null", "http://127.0.0.1:1", "http://localhost"])
def test_pages_of_others_are_refused(free: Served, origin: str) -> None:
    with pytest.raises(InvalidStatus), free.stream(origin=origin):
        pass
    assert free.order({"what": "list"}, Origin=origin)[0] == 403
    assert free.centre.asked == []


def test_a_stream_tells_what_there_is(free: Served) -> None:
    with free.stream(**free.own) as stream:
        assert heard(stream, "hello")["may_order"] is False, "without the token"
        assert heard(stream, "pulse")["centre"] == "centre"
        assert [one[1] for one in heard(stream, "texts")["tracks"]] == [str(FIRST + k) for k in range(3)]
        assert heard(stream, "picture")["slot"].tolist() == [0, 1, 2]
        stream.send(json.dumps({"track": str(FIRST + 1)}))
        assert heard(stream, "track")["label"] == "2"
        for words in (
            '{"track": "x"}',
            '{"centre": 3}',
            "[]",
            "{",
            '{"centre": "nobody"}',
            '{"track": "99999999999999999999"}',
        ):
            stream.send(words)
        free.state.take(picture(2, 2))
        assert heard(stream, "picture")["step"] == 2
        free.state.take(picture(3, 3))


def test_the_token_opens(locked: Served, free: Served) -> None:
    for token in ("wrong", "", TOKEN[:-1]):
        with locked.stream(token) as stream, pytest.raises(ConnectionClosed) as closed:
            stream.recv(20)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == REFUSED
    with locked.stream(TOKEN) as stream:
        assert heard(stream, "hello")["may_order"] is False, "orders are off"
        assert heard(stream, "picture")["step"] == 1
    with locked.stream(None, Authorization=f"Bearer {TOKEN}") as stream:
        heard(stream, "picture")
    with free.stream(TOKEN) as stream:
        assert heard(stream, "hello")["may_order"] is True
    with free.stream("wrong") as stream:
        assert heard(stream, "hello")["may_order"] is False


def test_who_says_no_token_in_time_is_let_go(locked: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "TOKEN_IN", 0.05)
    with locked.stream(None) as stream, pytest.raises(ConnectionClosed):
        stream.recv(20)


def test_orders_need_token_and_own_page_and_are_off_unless_enabled(free: Served, locked: Served) -> None:
    order = {"what": "delete", "track": str(FIRST), "who": "anna", "why": "clutter", "for": 600}
    assert locked.order(order) == (403, {"wrong": "orders are off: start the console with --allow-orders"})
    assert free.order(order, Authorization="Bearer wrong")[0] == 403
    code, _, _ = ask(
        free.port, "/order", "POST", b"{}", Authorization=f"Bearer {TOKEN}", Content_Type="application/json"
    )
    assert code == 403, "no page said where it comes from"
    assert free.order(order, Content_Type="text/plain")[0] == 415
    assert free.centre.asked == []
    code, answer = free.order(order)
    assert (code, answer["outcome"], answer["track"]) == (200, "so be it", 2**63)
    assert free.centre.asked == [("centre", order)]
    assert ask(free.port, "/order")[0] == 405


@pytest.mark.parametrize(
    ("order", "said"),
    [
        ({"what": "delete", "track": "1"}, "an order says who gives it"),
        ({"what": "delete", "who": "a"}, "needs: track"),
        ({"what": "explode", "who": "a"}, "there is no order"),
        ({"what": "rename", "who": "a", "track": "1", "name": "two\nlines"}, "on one line"),
        ({"what": "split", "who": "a", "local": ["r1", -1]}, "a local track"),
        ({"what": "mute", "who": "a", "source": "r1", "proven": True}, "has no 'proven'"),
        ({"what": "mute", "who": "a", "source": "r1", "for": -1}, "above 0"),
        ({"what": "delete", "who": "a", "track": [1]}, "as a text"),
        ("mute", ""),
        ([], ""),
    ],
)
def test_what_is_no_order_is_told(free: Served, order: Any, said: str) -> None:
    before = len(free.centre.asked)
    code, answer = free.order(order)
    assert code == 400
    assert said in answer["wrong"]
    assert len(free.centre.asked) == before


def test_orders_have_bounds_and_say_what_a_centre_does_not(free: Served) -> None:
    order = {"what": "mute", "source": "r1", "who": "anna"}
    assert free.order({**order, "why": "x" * 5000})[0] == 413
    assert free.order(order, centre="nobody")[0] == 400
    free.centre.away = True
    assert free.order(order) == (502, {"wrong": "the hub is away: nothing was ordered"})
    free.centre.away = False


def test_a_certificate_says_who_orders_and_ids_stay_whole() -> None:
    asked = order_request({"what": "split", "local": ["r1", str(2**63 + 1), str(2**64 - 1)], "who": "mallory"}, "anna")
    assert asked == {"what": "split", "local": ["r1", 2**63 + 1, 2**64 - 1], "who": "anna"}
    assert order_request({"what": "list"}) == {"what": "list"}


def test_who_says_too_much_is_let_go(free: Served) -> None:
    with free.stream(**free.own) as stream:
        heard(stream, "picture")
        with pytest.raises(ConnectionClosed) as closed:
            chatter(stream)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == TOO_MUCH
    with free.stream("x" * 5000) as stream, pytest.raises(ConnectionClosed):
        stream.recv(20)


def test_pages_are_counted(free: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    eventually(lambda: free.console.pages == 0)
    monkeypatch.setattr(server_module, "MOST_PAGES", 1)
    with free.stream() as stream:
        heard(stream, "picture")
        with free.stream(None) as other, pytest.raises(ConnectionClosed):
            other.recv(20)
    eventually(lambda: free.console.pages == 0)


def test_a_slow_page_gets_the_newest_and_no_queue(free: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes nothing while 40 pictures of 4 MiB come, each waiting a little for being sent: what waits for it is
    bounded, and then the newest comes."""
    monkeypatch.setattr(server_module, "PATIENCE", 100.0)
    monkeypatch.setattr(server_module, "TICK", 0.001)
    pictures, sent = free.state._centres["centre"].pictures, []
    news, plain = free.state.news, pictures._packed
    monkeypatch.setattr(pictures, "_packed", lambda *given: plain(*given) + bytes(2**22))

    def watched(seen: Seen) -> tuple[Seen, list[str | bytes]]:
        after, out = news(seen)
        sent.append(after.picture)
        return after, out

    def waited(begin: float) -> bool:
        return sent[-1] == pictures.version or time.monotonic() > begin + 0.03

    monkeypatch.setattr(free.state, "news", watched)
    with Slow(free.port) as page:
        page.frame(b"picture")
        for step in range(10, 50):
            free.state.take(picture(3, step))
            begin = time.monotonic()
            eventually(partial(waited, begin))
        assert sent[-1] < pictures.version, "the page was fast enough to take all"
        count = 0
        while b'"step":49,' not in page.frame(b'"type":"picture"'):
            count += 1
        assert count < 30


def test_places_of_tiles_and_hosts() -> None:
    assert tiles_origin("https://tiles.example.org:8443/a/{z}/{x}/{y}.png") == "https://tiles.example.org:8443"
    for bad in (
        "tiles",
        "ftp://h/{z}/{x}/{y}",
        "https://h/{z}/{x}.png",
        "https://{s}.h/{z}/{x}/{y}",
        "https://h;x/{z}/{x}/{y}",
    ):
        with pytest.raises(ValueError):
            tiles_origin(bad)
    assert [is_loopback(one) for one in ("127.0.0.1", "::1", "localhost", "0.0.0.0", "192.0.2.1", "h")] == [
        True
    ] * 3 + [False] * 3


def test_the_map_library_is_the_one_that_is_named() -> None:
    folder = server_module.STATIC / "leaflet"
    told = dict(re.findall(r"^(\S+) +sha256 (\w{64})$", (folder / "VERSION.txt").read_text("utf-8"), re.M))
    found = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in ("leaflet.js", "leaflet.css")}
    assert found == told


def test_files_of_the_page_are_short_and_make_no_markup() -> None:
    for path in server_module.STATIC.glob("*.*"):
        text = path.read_text("utf-8")
        assert len(text.splitlines()) <= 400, path.name
        assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(", text), path.name
