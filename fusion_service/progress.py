"""A progress bar on a terminal; nothing elsewhere."""

from __future__ import annotations

import sys
from types import TracebackType

__all__ = ["Progress"]

WIDTH = 30


class Progress:
    """`with Progress("Fusing") as bar: bar.show(0.4, "12 tracks")`; writes to stderr if that is a terminal."""

    def __init__(self, label: str) -> None:
        self._label = label
        self._on = sys.stderr.isatty()

    def show(self, fraction: float, note: str = "") -> None:
        """Draw the bar at `fraction` from 0 to 1."""
        if self._on:
            done = round(WIDTH * min(max(fraction, 0.0), 1.0))
            bar = "█" * done + "░" * (WIDTH - done)
            sys.stderr.write(f"\r\x1b[K{self._label} {bar} {100 * min(max(fraction, 0.0), 1.0):3.0f} %  {note}")
            sys.stderr.flush()

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._on:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
