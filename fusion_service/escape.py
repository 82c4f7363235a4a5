"""Text that came from elsewhere, before it reaches a terminal: what would steer that is written out instead.

A track's identity or a centre's reason may hold any character. Control characters of C0 and C1 move the cursor, hide
lines or set the title of the window; the overrides of direction of Unicode make a name read as another. They are shown
as `\\x1b`, `\\u202e`. New lines and tabs stay.
"""

from __future__ import annotations

from typing import Any, TextIO

__all__ = ["Escaped", "escaped"]

STEERING = {*range(0x20), *range(0x7F, 0xA0), *range(0x2028, 0x202F), *range(0x2066, 0x206A)} - {0x09, 0x0A}
TABLE = {code: f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" for code in STEERING}


def escaped(text: str) -> str:
    """The text as it may be shown."""
    return text.translate(TABLE)


class Escaped:
    """A text stream to which only what may be shown is written; all else is that stream's own."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write the text as it may be shown; returns its length."""
        self._stream.write(escaped(text))
        return len(text)

    def writelines(self, lines: list[str]) -> None:
        """Write each."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
