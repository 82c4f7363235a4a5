"""Signals in real processes: at any time, and while a call into C holds the interpreter."""

from __future__ import annotations

import os
import signal
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from fusion_service.compiled.road import VARIABLE
from tests.helpers.processes import Program, slowness
from tests.helpers.scene import COMMAND

SLOW_IMPORT = """
import sys
class Slow:
    def find_spec(self, name, path=None, target=None):
        if name == "fusion_service.bus.session":
            print("importing", flush=True)
            sys.stdin.readline()
sys.meta_path.insert(0, Slow())
from fusion_service.cli import main
raise SystemExit(main(sys.argv[1:]))
"""

STUCK = """
import ctypes, sys
from fusion_service import process
process.GRACE = float(sys.argv[1])
with process.stop_on_signals() as stop:
    print("up", flush=True)
    stop.wait()
    print("stopping", flush=True)
    while True:
        ctypes.PyDLL(None).sleep(60)  # holds the interpreter
"""

AFTER = """
import signal, time
from fusion_service import process
process.GRACE = 0.1
with process.stop_on_signals() as stop:
    signal.raise_signal(signal.SIGINT)
    assert stop.is_set()
time.sleep(1.0)  # longer than any last resort
assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_modules_are_loaded_ends_it_quietly(number: signal.Signals) -> None:
    with Program(SLOW_IMPORT, "run", "--connect", "tcp/127.0.0.1:1", fresh=True) as program:
        assert program.line() == "importing"
        program.signal(number)
        code, errors = program.end()  # closes its stdin: the import goes on
        assert (code, errors) == (0, "")


def test_a_signal_while_the_compiler_loads_ends_it_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that takes a minute to load: where its kernels are wanted at once, and where it works beside the rest."""
    (tmp_path / "numba.py").write_text("import os, time\nos.write(1, b'loading\\n')\ntime.sleep(60)\n")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    with ExitStack() as stack:
        programs = []
        for choice in ("on", "auto"):
            monkeypatch.setenv(VARIABLE, choice)
            programs.append(stack.enter_context(Program(COMMAND, "run", "--connect", "tcp/127.0.0.1:1", fresh=True)))
        for program in programs:
            assert program.line(20.0) == "loading"
            program.signal(signal.SIGTERM)
        for program in programs:
            code, errors = program.end()
            assert code == 0, errors
            assert "not stopped" not in errors


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_second_signal_ends_it_at_once_whatever_it_does(number: signal.Signals) -> None:
    with Program(STUCK, "60") as program:
        assert program.line() == "up"
        program.signal(number)
        assert program.line() == "stopping"
        program.signal(number)
        assert program.end()[0] == -number


def test_who_does_not_stop_in_time_is_ended_whatever_it_does() -> None:
    with Program(STUCK, "0.2") as program:
        assert program.line() == "up"
        program.signal(signal.SIGTERM)
        assert program.line() == "stopping"
        begin = time.monotonic()
        assert program.end()[0] == -signal.SIGALRM
        assert time.monotonic() - begin < 5.0 * slowness(), "else after a minute"


def test_nothing_is_left_of_it_afterwards() -> None:
    with Program(AFTER) as program:
        assert program.end() == (0, "")
