"""A process that ends with the one that started it, however that one ends: kill -9 too.

The parent holds one end of a pipe, its children the other, of which they know by the environment. Nothing is ever
written: where the pipe ends, the parent has gone, and the child stops as by SIGTERM. A pipe does so on every POSIX
system, for a child of a child as well, and whichever thread has started it.
"""

from __future__ import annotations

import os
import signal
import stat
import threading
from typing import Any

__all__ = ["Lifeline", "end_with_parent"]

VARIABLE = "FUSION_LIFELINE"
"""Says the number of the file descriptor."""


class Lifeline:
    """The parent's end: children that are started with `options` end when it is closed, or this process is gone."""

    def __init__(self) -> None:
        self._read, self._write = os.pipe()

    @property
    def options(self) -> dict[str, Any]:
        """For `subprocess.Popen`."""
        return {"pass_fds": (self._read,), "env": {**os.environ, VARIABLE: str(self._read)}}

    def close(self) -> None:
        """Let go."""
        for end in (self._read, self._write):
            os.close(end)


def end_with_parent() -> None:
    """Stop as by SIGTERM when the process that started this one with a `Lifeline` has gone. Does nothing without one,
    and the second time."""
    said = os.environ.pop(VARIABLE, "")
    if not (said.isascii() and said.isdigit()):
        return
    try:
        if not stat.S_ISFIFO(os.fstat(int(said)).st_mode):
            return
    except (OSError, OverflowError):
        return

    main = threading.main_thread().ident
    if main is None:
        return

    def watch(end: int) -> None:
        while os.read(end, 1):
            pass
        signal.pthread_kill(main, signal.SIGTERM)  # to another thread it would not wake one that waits

    threading.Thread(target=watch, args=(int(said),), name="lifeline", daemon=True).start()
