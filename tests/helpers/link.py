"""Two hubs with a link, or a third hub, between them that can be cut: what a bus that splits looks like."""

from __future__ import annotations

import contextlib
import socket
import threading
from typing import Self

from tests.helpers.processes import Program, free_endpoint

HUB = """
import sys, threading
from fusion_service.bus import open_bus
stop = threading.Event()
threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True).start()
own, *others = sys.argv[1:]
with open_bus(others, [own], mode="router"):
    stop.wait()
"""


class Link:
    """A way to `endpoint` by `self.endpoint`, as long as it is not cut."""

    def __init__(self, endpoint: str) -> None:
        host, port = endpoint.removeprefix("tcp/").rsplit(":", 1)
        self._to = host, int(port)
        self._server = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._server.getsockname()[1]}"
        self._sockets: list[socket.socket] = []
        self._lock = threading.Lock()
        self._open = True
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                one, _ = self._server.accept()
            except OSError:
                return
            with self._lock:
                if not self._open:
                    one.close()
                    continue
                try:
                    two = socket.create_connection(self._to)
                except OSError:
                    one.close()
                    continue
                self._sockets += [one, two]
            for pair in ((one, two), (two, one)):
                threading.Thread(target=self._pump, args=pair, daemon=True).start()

    def _pump(self, one: socket.socket, two: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := one.recv(65536):
                two.sendall(data)
        for end in (one, two):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def cut(self) -> None:
        with self._lock:
            self._open = False
            for one in self._sockets:
                with contextlib.suppress(OSError):
                    one.shutdown(socket.SHUT_RDWR)
                one.close()
            self._sockets.clear()

    def mend(self) -> None:
        with self._lock:
            self._open = True

    def close(self) -> None:
        self.cut()
        self._server.close()


class Hubs:
    """Two hubs, the second linked to the first."""

    def __init__(self) -> None:
        self.endpoints = free_endpoint(), free_endpoint()

    def __enter__(self) -> Self:
        self._programs = [Program(HUB, self.endpoints[0])]
        self.link = Link(self.endpoints[0])
        self._programs.append(Program(HUB, self.endpoints[1], self.link.endpoint))
        return self

    def __exit__(self, *_: object) -> None:
        self.link.close()
        for one in self._programs:
            one.__exit__()


class Between:
    """Two hubs that know each other by a third one alone, which is killed and started again."""

    def __init__(self) -> None:
        self.endpoints = free_endpoint(), free_endpoint()
        self._own = free_endpoint()
        self._third: Program | None = None

    def __enter__(self) -> Self:
        self._programs = [Program(HUB, one) for one in self.endpoints]
        self.mend()
        return self

    def cut(self) -> None:
        """Kill the third one."""
        if self._third is not None:
            self._third.__exit__()
            self._third = None

    def mend(self) -> None:
        """Start it again."""
        if self._third is None:
            self._third = Program(HUB, self._own, *self.endpoints)

    def __exit__(self, *_: object) -> None:
        self.cut()
        for one in self._programs:
            one.__exit__()
