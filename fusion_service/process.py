"""What every process of ours does the same way: values of options, signals in two stages, exit codes, and where
recorded data are looked for.

Exit codes: 0 done, or stopped by a signal; 2 bad usage or config; 1 any other failure, told in one line.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout
from pathlib import Path
from types import FrameType
from typing import NoReturn, TextIO, TypeVar, cast

from fusion_service.escape import Escaped, escaped
from fusion_service.hangup import heed

__all__ = [
    "GRACE",
    "Parser",
    "argument",
    "data_folder",
    "exit_code",
    "positive",
    "stop_on_signals",
    "whole",
]

T = TypeVar("T")

GRACE = 4.0
"""Seconds after the first signal in which a process must have ended by itself."""


@contextmanager
def stop_on_signals(lasting: bool = False) -> Iterator[threading.Event]:
    """An event that SIGINT or SIGTERM sets. A second signal, or `GRACE` seconds, end the process at once. lasting:
    SIGHUP does not end it (see `hangup`).

    Both is left to the kernel, so that it also happens while a long call holds the interpreter; only the first
    signal needs Python to run once.
    """
    stop, left = threading.Event(), threading.Event()

    def last_resort() -> None:
        if not left.wait(GRACE):
            sys.stderr.write(f"not stopped within {GRACE:g} s: ending now\n")
            os._exit(1)

    def on_signal(number: int, frame: FrameType | None) -> None:
        for one in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
            signal.signal(one, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, GRACE + 0.5)
        stop.set()
        threading.Thread(target=last_resort, daemon=True).start()

    handled = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.getsignal(number) for number in (*handled, signal.SIGALRM)}
    for number in handled:
        signal.signal(number, on_signal)
    try:
        with heed(lambda: on_signal(signal.SIGHUP, None)) if lasting else nullcontext():
            yield stop
    finally:
        left.set()
        if stop.is_set():
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)


def exit_code(program: str, call: Callable[[], object]) -> int:
    """Call it, and tell on stderr what a person can mend, as `program: ...`; returns what the process ends with.

    What is printed is escaped (`escape`). What is no `FusionError`, no missing package and no trouble with a file is a
    fault of ours, and raised on.
    """
    from fusion_service.errors import FusionError  # with NumPy: slow to load, so not before signals are heard

    try:
        with redirect_stdout(cast(TextIO, Escaped(sys.stdout))):
            call()
    except FusionError as error:
        if error.exit_code:
            print(escaped(str(error) if error.places else f"{program}: {error}"), file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:  # whoever read our output has gone; nothing is flushed into it at the end either
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ImportError, OSError) as error:
        print(escaped(f"{program}: {error}"), file=sys.stderr)
        return 1
    return 0


class Parser(argparse.ArgumentParser):
    """Asks whether the nearest word was meant where one is not among its choices."""

    def error(self, message: str) -> NoReturn:
        """End with the usage and `message`; exit code 2."""
        if found := re.search(r"invalid choice: '([^']{1,64})' \(choose from (.*)\)", message):
            import difflib

            known = [one.strip(" '") for one in found[2].split(",")]
            if near := difflib.get_close_matches(found[1], known, 1):
                message = f"{message[: found.end(1) + 1]}: did you mean {near[0]!r}?{message[found.end(1) + 1 :]}"
        super().error(message)


def argument(read: Callable[[str], T]) -> Callable[[str], T]:
    """`read` as the type of an argument of argparse: what its `ValueError` says is told of the option."""

    def typed(text: str) -> T:
        try:
            return read(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return typed


def positive(text: str) -> float:
    """A number above 0. Raises ValueError in one line."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        raise ValueError(f"{text!r} is not a number above 0")
    return value


def whole(text: str) -> int:
    """A whole number from 0. Raises ValueError in one line."""
    if not (text.isascii() and text.isdigit() and len(text) < 19):
        raise ValueError(f"{text!r} is not a whole number from 0")
    return int(text)


def data_folder(name: str, given: str | Path | None = None) -> Path | None:
    """The folder of the recorded data set `name`: `given`, or else $FUSION_DATA, may be that folder itself or one that
    holds it under its name. None where neither says anything; whether the files are there is not looked at."""
    said = given or os.environ.get("FUSION_DATA")
    if not said:
        return None
    inside = Path(said) / name
    return inside if inside.is_dir() else Path(said)
