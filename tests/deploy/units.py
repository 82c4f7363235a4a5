"""The units of systemd in deploy/, read, and their lines as a test can run them."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

__all__ = ["FOLDER", "UNITS", "command", "settings"]

FOLDER = Path(__file__).parents[2] / "deploy" / "systemd"
UNITS = {path.stem: path for path in sorted(FOLDER.glob("*.service"))}
PROGRAM = "/opt/track-fusion-centre/bin/fusion-service"


def settings(unit: str) -> dict[str, list[str]]:
    """Every setting of a unit, in order."""
    found: dict[str, list[str]] = {}
    for line in UNITS[unit].read_text("utf-8").splitlines():
        if "=" in line and not line.startswith(("#", "[")):
            name, _, value = line.partition("=")
            found.setdefault(name, []).append(value)
    return found


def command(unit: str, **instead: str) -> list[str]:
    """What ExecStart says, by this Python, with words of it replaced. All that are to be replaced must be in it."""
    (line,) = settings(unit)["ExecStart"]
    program, *words = shlex.split(line)
    assert program == PROGRAM
    for old in instead:
        assert old in words, (old, words)
    return [sys.executable, "-m", "fusion_service", *(instead.get(word, word) for word in words)]
