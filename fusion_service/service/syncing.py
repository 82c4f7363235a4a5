"""What is brought to the disk on a thread of its own: a slow one took up to a second of the loop every few seconds.

The file is replaced before, whole or not at all, which a kill cannot undo; what is waited for here is the disk, for the
day on which the power is cut.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path

__all__ = ["Syncing", "sync_to_disk"]

LONGEST = 10.0
"""Seconds that are waited for a disk at the end."""


def sync_to_disk(path: Path) -> None:
    """The file, and its name in its folder, are on disk when this returns. Raises OSError."""
    for one in (path, path.parent):
        handle = os.open(one, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


class Syncing:
    """One file at a time. trouble: why the last is not on disk, in a few words; empty where it is."""

    def __init__(self, sync: Callable[[Path], None] = sync_to_disk) -> None:
        self._sync = sync
        self._thread: threading.Thread | None = None
        self.trouble = ""

    @property
    def busy(self) -> bool:
        """Whether the last one still waits for the disk."""
        return self._thread is not None and self._thread.is_alive()

    def begin(self, path: Path) -> None:
        """Bring the file at `path` to the disk, and return at once; nothing while it is `busy`."""
        if not self.busy:
            self._thread = threading.Thread(target=self._work, args=(path,), name="syncing", daemon=True)
            self._thread.start()

    def _work(self, path: Path) -> None:
        try:
            self._sync(path)
            self.trouble = ""
        except OSError as error:
            self.trouble = error.strerror or type(error).__name__

    def close(self) -> None:
        """Wait for what was begun, not for ever."""
        if self._thread is not None:
            self._thread.join(LONGEST)
