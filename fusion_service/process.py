"""What every process of ours does the same way: values of options, signals in two stages, exit codes, and where
recorded data are looked for.

Exit codes: 0 done, or stopped by a signal; 2 bad usage or config; 1 any other failure, told in one line.
"""

from __future__ import annotations

import argparse
import difflib
import logging
import math
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TextIO, TypeVar, cast

from fusion_service.escape import Escaped, escaped, into_nothing
from fusion_service.hangup import heed
from fusion_service.lifeline import end_with_parent

__all__ = [
    "GRACE",
    "Parser",
    "argument",
    "data_folder",
    "exit_code",
    "left_behind",
    "loading",
    "positive",
    "reader_left",
    "stop_on_signals",
    "whole",
]

T = TypeVar("T")
LEFT_OVER = "unrecognized arguments: "
"""With which argparse tells of options that no command took."""

GRACE = 4.0
"""Seconds after the first signal in which a process must have ended by itself."""
_LOADING = threading.Event()


@contextmanager
def stop_on_signals(lasting: bool = False) -> Iterator[threading.Event]:
    """An event that SIGINT or SIGTERM sets. A second signal, or `GRACE` seconds, end the process at once. lasting:
    SIGHUP does not end it (see `hangup`). It is set too when who started the process has gone (see `lifeline`).

    Both is left to the kernel, so that it also happens while a long call holds the interpreter; only the first
    signal needs Python to run once.
    """
    stop, left = threading.Event(), threading.Event()

    def last_resort() -> None:
        if not left.wait(GRACE):
            sys.stderr.write(f"not stopped within {GRACE:g} s: ending now\n")
            os._exit(1)

    def on_signal(number: int, frame: FrameType | None) -> None:
        if _LOADING.is_set():
            os._exit(0)
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
        end_with_parent()
        with heed(lambda: on_signal(signal.SIGHUP, None)) if lasting else nullcontext():
            yield stop
    finally:
        left.set()
        if stop.is_set():
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def loading() -> Iterator[None]:
    """While it lasts nothing is open that must be closed: the first signal ends the process at once, with 0. For what
    takes long to load, in the main thread."""
    _LOADING.set()
    try:
        yield
    finally:
        _LOADING.clear()


def left_behind(code: int, thread: str) -> int:
    """`code`; but where a thread of that name is at work, for which nobody waits, the process ends with it at once. For
    who has closed all."""
    if any(one.name == thread for one in threading.enumerate()):
        logging.shutdown()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


def exit_code(program: str, call: Callable[[], object]) -> int:
    """Call it, and tell on stderr what a person can mend, as `program: ...`; returns what the process ends with.

    What is printed is escaped (`escape`), and goes nowhere once its reader has gone. What is no `FusionError`, no
    missing package and no trouble with a file is a fault of ours, and raised on.
    """
    from fusion_service.errors import FusionError  # with NumPy: slow to load, so not before signals are heard

    try:
        out = Escaped(sys.stdout)
        with redirect_stdout(cast(TextIO, out)):
            try:
                call()
            finally:
                out.flush()
    except FusionError as error:
        if error.exit_code:
            print(escaped(str(error) if error.places else f"{program}: {error}"), file=sys.stderr)
        return error.exit_code
    except (ImportError, OSError) as error:
        print(escaped(f"{program}: {error}"), file=sys.stderr)
        return 1
    return 0


def reader_left() -> bool:
    """Whether nobody reads what this process prints any more."""
    return getattr(sys.stdout, "left", False) is True


class Parser(argparse.ArgumentParser):
    """Asks whether the nearest word was meant where one is not among its choices or options, and tells of a command's
    options with the usage of that command."""

    _given: Sequence[str] = ()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As in argparse."""
        self._given = sys.argv[1:] if args is None else list(args)
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """End with the usage and `message`, of the command that it is about; exit code 2."""
        if message.startswith(LEFT_OVER):
            command = next((one for word in self._given if (one := self._commands().get(word))), None)
            if command is not None:
                command.error(message)
            message += self._meant(message.removeprefix(LEFT_OVER))
        if found := re.search(r"invalid choice: '([^']{1,64})' \(choose from (.*)\)", message):
            known = [one.strip(" '") for one in found[2].split(",")]
            if near := difflib.get_close_matches(found[1], known, 1):
                message = f"{message[: found.end(1) + 1]}: did you mean {near[0]!r}?{message[found.end(1) + 1 :]}"
        first = self._given[0].partition("=")[0] if self._given else ""
        if first.startswith("--") and first not in self._option_string_actions:
            names = [name for name, command in self._commands().items() if first in command._option_string_actions]
            if names := [name for name in self._given if name in names] or names:
                message = f"{first} goes behind the command, as in: {self.prog} {names[0]} {first} ..."
        super().error(message)

    def _print_message(self, message: str, file: Any = None) -> None:
        """To a reader that has gone as well: help goes into a pager."""
        super()._print_message(message, file)
        try:
            (file or sys.stderr).flush()
        except BrokenPipeError:
            into_nothing(file or sys.stderr)

    def _commands(self) -> dict[str, Parser]:
        """The parsers of its commands, by name."""
        found = [action.choices for action in self._actions if isinstance(action, argparse._SubParsersAction)]
        return {name: one for some in found for name, one in some.items()}

    def _meant(self, option: str) -> str:
        near = difflib.get_close_matches(re.split("[ =]", option)[0], self._option_string_actions, 1)
        return f" (did you mean {near[0]}?)" if option.startswith("-") and near else ""


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
