"""What a part of the suite reports: what was tried, and what got through."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

__all__ = ["Report"]

KEPT = 20
"""Escapes told in full."""


class Report:
    """One part's. folder: where the bytes of escapes are kept; None keeps none."""

    folder: Path | None = None

    def __init__(self, name: str) -> None:
        self.name = name
        self.tried = 0
        self.escapes = 0
        self.told: list[str] = []
        self.lines: list[str] = []

    def say(self, line: str) -> None:
        """A figure."""
        self.lines.append(line)

    def escaped(self, what: str, data: bytes = b"") -> None:
        """Something got through. The same again is counted."""
        self.escapes += 1
        if len(self.told) < KEPT and what not in self.told:
            self.told.append(what)
            if data and self.folder is not None:
                path = self.folder / f"{self.name}-{hashlib.sha256(data).hexdigest()[:12]}.bin"
                path.write_bytes(data)
                self.told[-1] += f"\n  kept in {path}"

    def __str__(self) -> str:
        load = " ".join(f"{one:.1f}" for one in os.getloadavg())
        head = f"{self.name}: {self.tried:,} tried, {self.escapes:,} escapes (load {load})"
        return "\n  ".join([head, *self.lines, *(f"ESCAPE {one}" for one in self.told)])
