"""Real processes for tests: a hub to kill and start again, programs that die with the test, waiting on conditions."""

from __future__ import annotations

import fcntl
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Self

from tests.helpers.nursery import Forked, begin

HUB = """
import sys, threading
from fusion_service.bus.hub import run_hub
stop = threading.Event()
threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True).start()
run_hub([sys.argv[1]], stop)
"""
SLOWEST = 6.0
ROOM = 2**20
"""Bytes that a program may write to stderr before somebody must read it."""


def free_endpoint() -> str:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"tcp/127.0.0.1:{server.getsockname()[1]}"


def slowness() -> float:
    """How many times longer everything takes on this machine now than where nothing else runs, at most `SLOWEST`: a
    process of a test gets no more than its share, and loads for seconds of processor."""
    return min(max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1)), SLOWEST)


def eventually(condition: Callable[[], object], timeout: float = 20.0, every: float = 0.005) -> float:
    """Wait until `condition()` holds; the seconds it took. Fails after `timeout`, or as many times that as the machine
    is slow. What reads a recording to know is asked less often: `every`, s."""
    begin = time.monotonic()
    while not condition():
        passed = time.monotonic() - begin
        assert passed < timeout or passed < timeout * slowness(), f"did not happen within {passed:.0f} s"
        time.sleep(every)
    return time.monotonic() - begin


class Program:
    """A Python program in a process of its own, killed at the end of the `with` block at the latest. `fresh`: it begins
    with an interpreter that has loaded nothing, as users' programs do."""

    def __init__(self, code: str, *arguments: str, fresh: bool = False) -> None:
        command = [sys.executable, "-W", "error", "-c", code, *arguments]
        pipe = subprocess.PIPE
        self._process: subprocess.Popen[bytes] | Forked = (None if fresh else begin(code, arguments)) or (
            subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe)
        )
        assert self._process.stderr is not None
        fcntl.fcntl(self._process.stderr, fcntl.F_SETPIPE_SZ, ROOM)
        self._lines = b""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            assert pipe is not None
            pipe.close()

    @property
    def pid(self) -> int:
        return self._process.pid

    def signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def freeze(self) -> None:
        """Stop it, and wait until it has stopped. SIGCONT lets it go on."""
        self.signal(signal.SIGSTOP)
        os.waitpid(self._process.pid, os.WUNTRACED)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()

    def running(self) -> bool:
        return self._process.poll() is None

    def line(self, timeout: float = 20.0) -> str:
        """The next line that it prints."""
        pipe = self._process.stdout
        assert pipe is not None
        begin = time.monotonic()
        while b"\n" not in self._lines:
            ready, _, _ = select.select([pipe], [], [], 0.1)
            if not ready:
                passed = time.monotonic() - begin
                assert passed < timeout or passed < timeout * slowness(), f"no line within {passed:.0f} s"
                continue
            part = os.read(pipe.fileno(), 65536)
            if not part:
                assert self._process.stderr is not None
                raise AssertionError(f"it ended: {self._process.stderr.read().decode()}")
            self._lines += part
        line, _, self._lines = self._lines.partition(b"\n")
        return line.decode()

    def tell(self, line: str = "") -> None:
        """Write a line that it reads from stdin."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n".encode())
        self._process.stdin.flush()

    def told(self) -> str:
        """Kill it, and what it wrote to stderr."""
        self.kill()
        assert self._process.stderr is not None
        return self._process.stderr.read().decode()

    def end(self, timeout: float = 20.0) -> tuple[int, str]:
        """Wait for it to end by itself: (exit code, what it wrote to stderr)."""
        _, errors = self._process.communicate(timeout=timeout * slowness())
        return self._process.wait(), errors.decode()


class Hub:
    """A hub on a free loopback port, in a process that can be killed and started again."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self._program: Program | None = None

    def start(self) -> Self:
        if self._program is None:
            self._program = Program(HUB, self.endpoint)
        return self

    def kill(self) -> None:
        if self._program is not None:
            self._program.__exit__()
            self._program = None
