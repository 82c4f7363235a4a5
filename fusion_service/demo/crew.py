"""The processes of a mission: the commands a user types, each with a log file of its own, on loopback."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from fusion_service.errors import FusionError
from fusion_service.lifeline import Lifeline

__all__ = ["Crew", "DemoError", "client_arguments", "free_endpoint", "record_arguments"]

STOP = 5.0
"""Seconds that a process has to end after SIGINT."""


class DemoError(FusionError):
    """Why a demo cannot go on, and how to mend it, in one line."""


class Crew:
    """The processes of a demo, each with a log file in `folder`. Leaving the context ends them all, as the end of this
    process does, kill -9 too."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._lifeline = Lifeline()

    def start(self, name: str, arguments: Sequence[str]) -> None:
        """`python -m ...` in a group of its own, so that Ctrl-C at the terminal reaches only the demo."""
        with open(self._folder / f"{name}.log", "wb") as output:
            self._processes[name] = subprocess.Popen(
                [sys.executable, "-m", *arguments],
                stdout=output,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                **self._lifeline.options,
            )

    def check(self, *allowed: str) -> None:
        """Raises `DemoError` if one has failed, or ended without being one of `allowed`."""
        for name, process in self._processes.items():
            code = process.poll()
            if code is not None and (code != 0 or name not in allowed):
                raise DemoError(f"{name} ended with code {code}: {self._last_line(name)}")

    def kill(self, name: str) -> None:
        """End one at once (SIGKILL), as a fault would; it may be started again."""
        self._processes[name].kill()
        self._processes[name].wait()

    def running(self, *names: str) -> bool:
        """Whether any of them still runs."""
        return any(self._processes[name].poll() is None for name in names)

    def stop(self, *names: str) -> None:
        """End them together: SIGINT, and SIGKILL for what is not gone in time."""
        chosen = [self._processes[name] for name in names or tuple(self._processes)]
        for process in chosen:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + STOP
        for process in chosen:
            try:
                process.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _last_line(self, name: str) -> str:
        lines = (self._folder / f"{name}.log").read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"

    def __enter__(self) -> Crew:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._lifeline.close()


def free_endpoint() -> str:
    """An endpoint on a port of loopback that is free at this moment."""
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{sock.getsockname()[1]}"


def client_arguments(command: Sequence[str], endpoint: str, speed: float, begin: float) -> list[str]:
    """What starts a sensor client: the mission begins at `begin`, Unix seconds, and goes `speed` times real time."""
    return ["sensor_clients", *command, "--connect", endpoint, "--speed", str(speed), "--start-at", f"{begin:.3f}"]


def record_arguments(
    out: str | Path, endpoint: str, cutoff: float, every: float | None = None, live: str | None = None
) -> list[str]:
    """What starts the recorder; cutoff: largest error that still counts as followed, m; every: s between scored times,
    None for each step; live: HOST:PORT, where viewers may look on."""
    command = ["fusion_service", "record", "--out", str(out), "--connect", endpoint, "--cutoff", str(cutoff)]
    command += ["--every", str(every)] if every else []
    return [*command, "--live", live] if live else command
