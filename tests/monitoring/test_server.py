"""The server beside those who ask slowly, wrongly, or too often."""

from __future__ import annotations

import contextlib
import socket
import urllib.request
from collections.abc import Iterator

import pytest

from fusion_service.monitoring import Sample, Serving, served
from fusion_service.monitoring.server import MOST
from tests.helpers.processes import eventually


def failing() -> Iterator[Sample]:
    raise ValueError("of ours")
    yield


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    serving = Serving(lambda: [Sample("fusion_ready", (), 1.0)], lambda: "it is dead", lambda: "\ud800 é")
    with served(("127.0.0.1", 0), serving) as number:
        yield number


def ask(port: int, request: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", port), 20) as one:
        one.sendall(request)
        answer = b""
        while part := one.recv(65536):
            answer += part
    return answer


def test_what_is_served(port: int) -> None:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20) as answer:
        assert "fusion_ready 1.0" in answer.read().decode()
    request = urllib.request.Request(
        f"http://127.0.0.1:{port}/metrics", headers={"Accept": "application/openmetrics-text; version=1.0.0"}
    )
    with urllib.request.urlopen(request, timeout=20) as answer:
        assert "openmetrics" in answer.headers["Content-Type"]
        assert answer.read().decode().endswith("# EOF\n")
    assert ask(port, b"GET /healthz HTTP/1.0\r\n\r\n").endswith(b"it is dead\n")
    assert b" 503 " in ask(port, b"GET /readyz HTTP/1.0\r\n\r\n").splitlines()[0]
    assert b" 404 " in ask(port, b"GET /../etc/passwd HTTP/1.0\r\n\r\n").splitlines()[0]
    assert b" 501 " in ask(port, b"POST /metrics HTTP/1.0\r\n\r\n").splitlines()[0]
    assert ask(port, b"HEAD /healthz HTTP/1.0\r\n\r\n").endswith(b"\r\n\r\n")


@pytest.mark.parametrize(
    "request_", [b"\0\xff\r\n\r\n", b"GET\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b"x" * 70000 + b"\r\n"]
)
def test_nonsense_is_answered_or_closed(port: int, request_: bytes) -> None:
    with contextlib.suppress(ConnectionError):
        ask(port, request_)
    assert b" 503 " in ask(port, b"GET /healthz HTTP/1.0\r\n\r\n")


def test_who_says_nothing_holds_up_nobody(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """More silent ones than are served at a time: others are turned away, and served when these are ended."""
    monkeypatch.setattr("fusion_service.monitoring.server.PATIENCE", 1.0)
    silent = [socket.create_connection(("127.0.0.1", port), 20) for _ in range(MOST + 5)]
    try:

        def answered() -> bool:
            try:
                return b" 503 " in ask(port, b"GET /healthz HTTP/1.0\r\n\r\n")
            except ConnectionError:
                return False

        eventually(answered)
    finally:
        for one in silent:
            one.close()


def test_a_fault_of_ours_is_an_answer(caplog: pytest.LogCaptureFixture) -> None:
    with served(("127.0.0.1", 0), Serving(failing)) as port:
        assert b" 500 " in ask(port, b"GET /metrics HTTP/1.0\r\n\r\n").splitlines()[0]
        assert b" 200 " in ask(port, b"GET /healthz HTTP/1.0\r\n\r\n").splitlines()[0]
    assert "the metrics could not be told" in caplog.text


def test_a_port_that_is_taken_is_told_in_a_line(port: int) -> None:
    with (
        pytest.raises(OSError, match=rf"metrics cannot be served on 127.0.0.1:{port}: "),
        served(("127.0.0.1", port), Serving(list)),
    ):
        pass
