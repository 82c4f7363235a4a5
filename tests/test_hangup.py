"""SIGHUP in real processes: a reload, or the end of a terminal."""

from __future__ import annotations

import os
import pty
import signal
import sys

from tests.helpers.processes import Program, eventually

RELOADING = """
from fusion_service.hangup import on_hangup
from fusion_service.process import stop_on_signals
calls = []
def call():
    calls.append(1)
    print("reload", len(calls), flush=True)
    if len(calls) == 1:
        raise ValueError("of the first")
with stop_on_signals(lasting=True) as stop:
    print("up", flush=True)
    with on_hangup(call):
        while not stop.wait(0.1):
            pass
print("stopped", flush=True)
"""

IN_TERMINAL = """
import fcntl, os, sys, termios, signal
os.setsid()
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
if sys.argv[1] == "nohup":
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
from fusion_service.hangup import on_hangup
from fusion_service.process import stop_on_signals
out = os.fdopen(int(sys.argv[2]), "w")
with stop_on_signals(lasting=True) as stop, on_hangup(lambda: print("reload", file=out, flush=True)):
    print("up", file=out, flush=True)
    while not stop.wait(0.1):
        pass
print("stopped", file=out, flush=True)
"""


def test_each_hangup_is_a_reload_and_a_fault_in_one_ends_nothing() -> None:
    with Program(RELOADING) as program:
        assert program.line() == "up"
        for number in (1, 2, 3):
            program.signal(signal.SIGHUP)
            assert program.line() == f"reload {number}"
        program.signal(signal.SIGTERM)
        assert program.line() == "stopped"
        code, errors = program.end()
        assert code == 0
        assert "the reload failed: what was there goes on" in errors


class Terminal:
    """A program with a terminal of its own, and a pipe that outlives it."""

    def __init__(self, how: str) -> None:
        self.master, slave = pty.openpty()
        self.pipe, write = os.pipe()
        os.set_inheritable(write, True)
        self.pid = os.posix_spawn(
            sys.executable,
            [sys.executable, "-c", IN_TERMINAL, how, str(write)],
            os.environ,
            file_actions=[(os.POSIX_SPAWN_DUP2, slave, 0), (os.POSIX_SPAWN_DUP2, slave, 2)],
        )
        os.close(slave)
        os.close(write)

    def line(self) -> str:
        said = b""
        while not said.endswith(b"\n"):
            one = os.read(self.pipe, 1)
            assert one, said
            said += one
        return said.decode().strip()

    def end(self) -> int:
        """Wait for it to end by itself; its exit code."""
        eventually(self._ended)
        os.close(self.pipe)
        return os.waitstatus_to_exitcode(self._status)

    def _ended(self) -> bool:
        pid, self._status = os.waitpid(self.pid, os.WNOHANG)
        return pid != 0


def test_closing_the_terminal_ends_it_in_good_order() -> None:
    terminal = Terminal("plain")
    assert terminal.line() == "up"
    os.kill(terminal.pid, signal.SIGHUP)  # by hand, in the terminal that is there: a reload
    assert terminal.line() == "reload"
    os.close(terminal.master)
    assert terminal.line() == "stopped"
    assert terminal.end() == 0


def test_under_nohup_it_outlives_the_terminal() -> None:
    terminal = Terminal("nohup")
    assert terminal.line() == "up"
    os.close(terminal.master)
    assert terminal.line() == "reload"
    os.kill(terminal.pid, signal.SIGTERM)
    assert terminal.line() in ("stopped", "reload")
    assert terminal.end() == 0
