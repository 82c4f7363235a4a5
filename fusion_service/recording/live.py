"""The picture of a recording while it is made, for open Rerun viewers.

A server in this process, on a stream and a thread of its own, holds the newest part of the picture for viewers that
come later. A viewer that stops reading stops the server (once some 100 MB wait for it): then rows wait here, the
oldest are dropped and counted, and nothing comes back to the recorder. The messages themselves are not sent.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import socket
import subprocess
import tempfile
import threading
import urllib.parse
from collections import deque
from pathlib import Path
from typing import Any

from fusion_service.recording.columns import ColumnWriter, Row, import_rerun, weight
from fusion_service.recording.program import find_program, quiet

__all__ = ["DEFAULT_ADDRESS", "DEFAULT_WEB_PORT", "Live", "address"]

log = logging.getLogger(__name__)

DEFAULT_ADDRESS = ("127.0.0.1", 9876)
DEFAULT_WEB_PORT = 9090
SERVED = "256MiB"
"""Of the newest picture, held for viewers that connect late."""
HELD = 64 * 2**20
"""Bytes that wait for a server that does not take them."""
PATIENCE = 0.5
"""Seconds between looks at a server that does not take what it has."""


def address(text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, HOST or PORT. `ValueError` in one line."""
    host, _, port = text.rpartition(":") if ":" in text else ("", "", text) if text.isdigit() else (text, "", "")
    number = int(port) if port.isdigit() else DEFAULT_ADDRESS[1] if not port and ":" not in text else 0
    if not 0 < number < 65536:
        raise ValueError(f"{text!r} is not HOST:PORT, HOST or PORT")
    return host.strip("[]") or DEFAULT_ADDRESS[0], number


class Live:
    """Serves what `row`, `static` and `blueprint` are given, at `url`. `OSError` where the port is taken.

    host: an address of this machine; any but loopback lets others on the network look on. web: the port of a page
    that shows it in a browser, served by Rerun's own program on the same host.
    """

    def __init__(
        self, host: str = DEFAULT_ADDRESS[0], port: int = DEFAULT_ADDRESS[1], *, web: int | None = None
    ) -> None:
        rr = import_rerun()
        host = _resolved(host)
        _check_free(host, port)
        binary = None if web is None else find_program()
        if web is not None:
            if binary is None:
                raise OSError("rerun's command line program is not installed: the page cannot be served")
            _check_free(host, web)
        self.dropped = 0
        self.page: str | None = None
        beyond = [f"http://*:{web}"] if web is not None and not _is_loopback(host) else []
        sink = rr.GrpcServerSink(host, port, server_memory_limit=SERVED, cors_allow_origin=beyond)
        self.url = f"rerun+http://{_shown(host)}:{port}/proxy"
        self._stream = rr.RecordingStream("track-fusion-centre", send_properties=True)
        self._stream.set_sinks(sink)
        self._stream.send_recording_name("live")
        self._columns = ColumnWriter(self._stream)
        self._fresh: list[Row] = []
        self._weight = 0
        self._change = threading.Condition()
        self._waiting: deque[tuple[int, list[Row]]] = deque()
        self._held = 0
        self._statics: dict[str, dict[str, Any]] = {}
        self._blueprint: Any = None
        self._stop = False
        self._stalled = False
        self._web = None if web is None or binary is None else _Page(binary, host, web, self.url)
        if self._web is not None:
            self.page = self._web.url
        self._thread = threading.Thread(target=self._serve, name="live", daemon=True)
        self._thread.start()

    def row(self, row: Row) -> None:
        """One row, sent with the next `push`."""
        self._fresh.append(row)
        self._weight += weight(row.content)

    def static(self, path: str, batches: dict[str, Any]) -> None:
        """What holds at all times; never dropped."""
        with self._change:
            self._statics.setdefault(path, {}).update(batches)

    def blueprint(self, blueprint: Any) -> None:
        """How it opens, from the next `push` on."""
        with self._change:
            self._blueprint = blueprint

    def push(self) -> None:
        """Hand over what came since the last push; never waits."""
        rows, size, self._fresh, self._weight = self._fresh, self._weight, [], 0
        with self._change:
            self._waiting.append((size, rows))
            self._held += size
            while self._held > HELD and len(self._waiting) > 1:
                old, lost = self._waiting.popleft()
                self._held -= old
                if not self.dropped and lost:
                    log.warning("live: a viewer does not keep up; it misses the oldest rows, the recording none")
                self.dropped += len(lost)
            self._change.notify()

    def close(self) -> None:
        """End the server and the page. What a viewer has not read by then it does not get."""
        with self._change:
            if self._stop:
                return
            self._stop = True
            self._change.notify()
        if self._web is not None:
            self._web.close()
        self._thread.join(PATIENCE + 0.2)
        if self.dropped:
            log.warning("live: %d rows were not shown to viewers that did not keep up", self.dropped)
        if self._thread.is_alive() or self._stalled:  # it would wait for the viewer, here or at the end of the process
            import_rerun().unregister_shutdown()
            threading.Thread(target=lambda _: threading.Event().wait(), args=(self._stream,), daemon=True).start()
        else:
            self._stream.disconnect()

    def _serve(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._stop or self._waiting or self._blueprint is not None)
                batches, self._waiting, self._held = self._waiting, deque(), 0
                statics, self._statics = self._statics, {}
                blueprint, self._blueprint = self._blueprint, None
                stop = self._stop
            try:
                for path, said in statics.items():
                    self._stream.log(path, list(said.values()), static=True)
                for _, rows in batches:
                    for row in rows:
                        self._columns.add(*row)
                self._columns.send()
                if blueprint is not None:
                    self._stream.send_blueprint(blueprint)
            except Exception:
                log.exception("live: cannot show what came")
            if not self._through() or stop:
                return

    def _through(self) -> bool:
        """Wait until the server has taken all; False when told to stop before it has."""
        while True:
            try:
                self._stream.flush(timeout_sec=PATIENCE)
            except RuntimeError:
                self._stalled = True
                if self._stop:
                    return False
            else:
                self._stalled = False
                return True


class _Page:
    """Rerun's web viewer, in a process that ends with this one: its shell reads from a pipe that then closes."""

    SHELL = '"$@" >/dev/null 2>&1 & child=$!; read -r _; kill "$child" 2>/dev/null; wait "$child" 2>/dev/null'

    def __init__(self, binary: Path, host: str, port: int, source: str) -> None:
        self.url = f"http://{_shown(host)}:{port}/?url={urllib.parse.quote(source, safe='')}"
        self._home = tempfile.TemporaryDirectory(prefix="rerun-")
        command = [str(binary), "--serve-web", "--bind", host, "--web-viewer-port", str(port), source]
        self._process = subprocess.Popen(
            ["/bin/sh", "-c", self.SHELL, "sh", *command],
            stdin=subprocess.PIPE,
            env=quiet(Path(self._home.name)),
        )

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(2.0)
        self._home.cleanup()


def _resolved(host: str) -> str:
    try:
        return str(socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][4][0])
    except OSError as error:
        raise OSError(f"live: {host} is no address of this machine ({error})") from None


def _is_loopback(host: str) -> bool:
    return ipaddress.ip_address(host).is_loopback


def _shown(host: str) -> str:
    """As a viewer on this machine is to write it."""
    if host in ("0.0.0.0", "::"):
        return "127.0.0.1"
    return f"[{host}]" if ":" in host else host


def _check_free(host: str, port: int) -> None:
    """A server that finds its port taken ends in silence: better to ask before."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        socket.create_server((host, port), family=family).close()
    except OSError as error:
        said = error.strerror or str(error)
        raise OSError(
            f"live: cannot listen on {_shown(host)}:{port} ({said}): an open viewer listens on 9876 itself; name "
            "another port"
        ) from None
