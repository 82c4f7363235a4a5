"""A progress bar on a terminal; nothing elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType

__all__ = ["Progress"]

WIDTH = 30
SETTLED = 2.0
"""Seconds after which what is left can be told from what is done."""


class Progress:
    """`with Progress("Fusing") as bar: bar.show(0.4, "12 tracks")`; writes to stderr if that is a terminal."""

    def __init__(self, label: str) -> None:
        self._label = label
        self._on = sys.stderr.isatty()
        self._began = time.monotonic()

    def show(self, fraction: float, note: str = "") -> None:
        """Draw the bar at `fraction` from 0 to 1, with the time that is left at this pace."""
        if self._on:
            share = min(max(fraction, 0.0), 1.0)
            done = round(WIDTH * share)
            bar = "█" * done + "░" * (WIDTH - done)
            spent = time.monotonic() - self._began
            left = spent * (1 - share) / share if share > 0 and spent > SETTLED else 0.0
            rest = f"{int(left) // 60}:{int(left) % 60:02d} left  " if left >= 1 else ""
            sys.stderr.write(f"\r\x1b[K{self._label} {bar} {100 * share:3.0f} %  {rest}{note}")
            sys.stderr.flush()

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._on:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
