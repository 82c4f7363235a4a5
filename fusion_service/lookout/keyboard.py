"""Single keys from a terminal, without Enter, and the terminal as it was afterwards."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

__all__ = ["Keys", "keyboard", "split_keys"]

NAMES = {
    "\x1b[A": "up", "\x1bOA": "up", "k": "up", "\x1b[B": "down", "\x1bOB": "down", "j": "down",
    "\x1b[5~": "page up", "\x1b[6~": "page down", "\r": "enter", "\n": "enter", "\x1b[C": "enter", "\x1bOC": "enter",
    "\x1b": "back", "\x1b[D": "back", "\x1bOD": "back", "\x7f": "back", "\x08": "back", " ": "p", "Q": "q", "\x04": "q",
}  # fmt: skip
"""What is sent -> which key it is; others are their own name."""
LATER = 0.05
"""Seconds that the rest of a key's sequence may take."""


class Keys:
    """Keys from the file `descriptor`; None: there are none."""

    def __init__(self, descriptor: int | None) -> None:
        self._descriptor = descriptor
        self.closed = False
        """Whether the terminal has gone."""

    def read(self, wait: float) -> list[str]:
        """The keys that are pressed within so many seconds; returns with the first."""
        text = self._text(wait)
        if text.endswith("\x1b"):
            text += self._text(LATER)
        return list(split_keys(text))

    def _text(self, wait: float) -> str:
        if self._descriptor is None or self.closed:
            select.select([], [], [], wait)
            return ""
        if not select.select([self._descriptor], [], [], wait)[0]:
            return ""
        try:
            data = os.read(self._descriptor, 1024)
        except OSError:
            data = b""
        self.closed = not data
        return data.decode(errors="replace")


def split_keys(text: str) -> Iterator[str]:
    """The keys in what was read."""
    while text:
        longest = next((size for size in (4, 3) if text[:size] in NAMES), 1)
        yield NAMES.get(text[:longest], text[:longest])
        text = text[longest:]


@contextmanager
def keyboard() -> Iterator[Keys]:
    """Of stdin, if it is a terminal. What is typed is not shown; Ctrl-C goes on to be a signal, Ctrl-Z does nothing."""
    import termios

    try:
        descriptor = sys.stdin.fileno()
        before = termios.tcgetattr(descriptor)
    except (AttributeError, OSError, ValueError, termios.error):  # no terminal
        yield Keys(None)
        return
    changed = termios.tcgetattr(descriptor)
    changed[3] &= ~(termios.ICANON | termios.ECHO)
    changed[6][termios.VSUSP] = b"\0"
    try:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, changed)
        yield Keys(descriptor)
    finally:
        with suppress(termios.error):  # it has gone
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
