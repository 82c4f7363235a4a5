"""Processes that need not load: forked from one that has loaded what most programs of the tests need, a nursery.

Each is a process of its own, with its own pipes, arguments, environment and end, and a child of the test's process, as
if `python -W error -c CODE ARGUMENTS` had been started; only the loading, most of a second, is done once. Rerun is not
loaded beforehand: it may have threads, which a fork would lose.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import importlib
import io
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import IO, Any

__all__ = ["Forked", "begin", "serve"]

ROOT = Path(__file__).parents[2]
LOADED = (
    *("fusion_service.cli", "fusion_service.commands", "fusion_service.commands.run", "fusion_service.commands.hub"),
    *("fusion_service.service.daemon", "fusion_service.bus.session", "fusion_service.bus.hub"),
    *("sensor_clients.publisher", "fusion_service.recording"),
)
SUBREAPER = 36
"""PR_SET_CHILD_SUBREAPER: what is forked twice becomes a child of ours."""
START = """
import sys
from tests.helpers.nursery import serve
code, names = serve(int(sys.argv[1]))
del serve
exec(code, names)
"""

_LOCK = threading.Lock()
_NURSERY: list[socket.socket] = []


class Forked:
    """The part of `subprocess.Popen` that `Program` needs."""

    def __init__(self, pid: int, stdin: IO[bytes], stdout: IO[bytes], stderr: IO[bytes]) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self.stdin, self.stdout, self.stderr = stdin, stdout, stderr

    def _wait(self, options: int) -> int | None:
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, options)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
        return self.returncode

    def poll(self) -> int | None:
        return self._wait(os.WNOHANG)

    def wait(self, timeout: float | None = None) -> int:
        deadline = None if timeout is None else time.monotonic() + timeout
        while (code := self._wait(0 if deadline is None else os.WNOHANG)) is None:
            if deadline is not None and time.monotonic() > deadline:
                raise subprocess.TimeoutExpired("forked", timeout or 0.0)
            time.sleep(0.005)
        return code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def communicate(self, timeout: float | None = None) -> tuple[bytes, bytes]:
        """What it still writes until it ends, to stdout and stderr."""
        deadline = time.monotonic() + (float("inf") if timeout is None else timeout)
        self.stdin.close()
        found: dict[int, bytes] = {self.stdout.fileno(): b"", self.stderr.fileno(): b""}
        names = list(found)
        with selectors.DefaultSelector() as selector:
            for number in names:
                selector.register(number, selectors.EVENT_READ)
            while selector.get_map():
                left = deadline - time.monotonic()
                if left <= 0:
                    raise subprocess.TimeoutExpired("forked", timeout or 0.0)
                for key, _ in selector.select(min(left, 60.0)):
                    part = os.read(key.fd, 65536)
                    found[key.fd] += part
                    if not part:
                        selector.unregister(key.fd)
        self.wait(None if timeout is None else max(0.1, deadline - time.monotonic()))
        return found[names[0]], found[names[1]]


def begin(code: str, arguments: tuple[str, ...]) -> Forked | None:
    """A process that runs `code`; None where the system has no way to make one a child of ours."""
    if not sys.platform.startswith("linux"):
        return None
    told = {"code": code, "arguments": arguments, "folder": os.getcwd(), "environment": dict(os.environ)}
    data = json.dumps(told, ensure_ascii=True).encode()
    with _LOCK:
        nursery = _opened()
        ends = [os.pipe() for _ in range(3)]
        theirs = [ends[0][0], ends[1][1], ends[2][1]]
        prctl = ctypes.CDLL(None, use_errno=True).prctl
        try:
            assert prctl(SUBREAPER, 1, 0, 0, 0) == 0
            socket.send_fds(nursery, [len(data).to_bytes(8, "big")], theirs)
            nursery.sendall(data)
            answer = nursery.recv(8)
        finally:
            prctl(SUBREAPER, 0, 0, 0, 0)
            for number in theirs:
                os.close(number)
        assert len(answer) == 8, "the nursery has ended"
    stdin, stdout, stderr = open(ends[0][1], "wb"), open(ends[1][0], "rb"), open(ends[2][0], "rb")  # noqa: SIM115
    return Forked(int.from_bytes(answer, "big"), stdin, stdout, stderr)


def _opened() -> socket.socket:
    if not _NURSERY:
        ours, theirs = socket.socketpair()
        command = [sys.executable, "-W", "error", "-c", START, str(theirs.fileno())]
        one_thread = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(
            command, cwd=ROOT, env=one_thread, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL
        )

        def ended() -> None:
            ours.close()
            process.wait()  # it ends when nobody can ask any more

        atexit.register(ended)
        theirs.close()
        _NURSERY.append(ours)
    return _NURSERY[0]


def serve(number: int) -> tuple[Any, dict[str, Any]]:
    """In the nursery: fork whenever asked, for ever. In the new process: return what it has to run."""
    for name in LOADED:
        importlib.import_module(name)
    assert threading.active_count() == 1
    gc.collect()
    gc.freeze()
    asked = socket.socket(fileno=number)
    while True:
        head, pipes, _, _ = socket.recv_fds(asked, 8, 3)
        if len(head) < 8:
            os._exit(0)
        data = b""
        while len(data) < int.from_bytes(head, "big"):
            data += asked.recv(65536)
        read, write = os.pipe()
        between = os.fork()
        if between == 0:
            pid = os.fork()
            if pid == 0:
                asked.close()
                return _entered(json.loads(data), pipes, (read, write))
            os.write(write, pid.to_bytes(8, "big"))
            os._exit(0)
        os.waitpid(between, 0)
        pid_read = os.read(read, 8)
        for one in (read, write, *pipes):
            os.close(one)
        asked.sendall(pid_read)


def _entered(told: dict[str, Any], pipes: list[int], others: tuple[int, int]) -> tuple[Any, dict[str, Any]]:
    for number, pipe in enumerate(pipes):
        os.dup2(pipe, number)
    for one in (*pipes, *others):
        os.close(one)
    sys.stdin = io.TextIOWrapper(open(0, "rb", closefd=False), encoding="utf-8")  # noqa: SIM115
    os.environ.clear()
    os.environ.update(told["environment"])
    os.chdir(told["folder"])
    sys.argv = ["-c", *told["arguments"]]
    signal.signal(signal.SIGINT, signal.default_int_handler)  # though the tests run in the background
    names: dict[str, Any] = sys.modules["__main__"].__dict__
    return compile(told["code"], "<string>", "exec"), names
