"""Text that came from elsewhere, before it reaches a terminal: what would steer that is written out instead.

A track's identity or a centre's reason may hold any character. Control characters of C0 and C1 move the cursor, hide
lines or set the title of the window; the overrides of direction of Unicode make a name read as another. They are shown
as `\\x1b`, `\\u202e`. New lines and tabs stay.
"""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any, TextIO

__all__ = ["STEERING", "Escaped", "escaped", "into_nothing"]

STEERING = {*range(0x20), *range(0x7F, 0xA0), *range(0x2028, 0x202F), *range(0x2066, 0x206A)} - {0x09, 0x0A}
TABLE = {code: f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" for code in STEERING}


def escaped(text: str) -> str:
    """The text as it may be shown."""
    return text.translate(TABLE)


def into_nothing(stream: TextIO) -> None:
    """From now on what is written to this stream goes nowhere: who read it has gone."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


class Escaped:
    """A text stream to which only what may be shown is written; all else is that stream's own.

    left: whether who read it has gone (a pipe into `head`). What is written then goes nowhere, so that the work of a
    command is done to its end; one that prints without an end looks here."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.left = False

    def write(self, text: str) -> int:
        """Write the text as it may be shown; returns its length."""
        try:
            self._stream.write(escaped(text))
        except BrokenPipeError:
            self._leave()
        return len(text)

    def flush(self) -> None:
        """Write what waits."""
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._leave()

    def _leave(self) -> None:
        self.left = True
        into_nothing(self._stream)

    def writelines(self, lines: list[str]) -> None:
        """Write each."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
