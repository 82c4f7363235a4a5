"""What commands that read a recording say of its seals, in one line."""

from __future__ import annotations

import argparse
import logging
import threading
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusion_service.recording.finding import Finding

__all__ = ["add_authority", "find", "say", "tell"]

log = logging.getLogger(__name__)


def add_authority(parser: argparse.ArgumentParser) -> None:
    """The option --ca."""
    parser.add_argument(
        "--ca",
        metavar="FILE",
        help="certificate of the authority, or public key, PEM, by which recordings must be signed",
    )


def find(recording: str, ca: str | None, stop: threading.Event) -> Finding:
    """What is found of a recording's seals. Raises `UsageError`, `ReviewError`, `Stopped`, ImportError, OSError."""
    from fusion_service.recording.signing import read_authority
    from fusion_service.recording.verifying import verify

    return verify(Path(recording), read_authority(Path(ca)) if ca else None, stop.is_set)


def tell(recording: str, ca: str | None, stop: threading.Event) -> None:
    """Find it, and say it."""
    say(recording, find(recording, ca, stop))


def say(recording: str, found: Finding) -> None:
    """In a line; an alarm is a warning of the log, and the command goes on."""
    if found.bad:
        log.warning("%s: %s", recording, found)
    else:
        print(f"{recording}: {found}")
