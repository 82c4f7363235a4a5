"""Holding a recording, or a folder of parts, against other processes while it is written; a kill lets go of it."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

__all__ = ["hold"]


def hold(path: Path) -> int:
    """A descriptor that holds `path` until it is closed. BlockingIOError if another holds it, OSError where that cannot
    be asked."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor
