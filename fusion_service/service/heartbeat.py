"""A status at least once a second, also while a step takes longer, or what came takes long to read.

The loop of the service says what it has to say by itself. Where it does not for a status period and a little, this
thread says it for it: the last status, its counters as they are now, and for how long the loop has been at it. The
service manager's watchdog is served so long as the loop is not at one thing for `STUCK`: then it is for the watchdog to
end it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

__all__ = ["STUCK", "Heartbeat"]

GRACE = 0.1
"""Seconds after its period at which a status is late."""
STUCK = 60.0
"""Seconds of one and the same thing after which the watchdog is not served any more."""


class Heartbeat:
    """Calls `late(seconds, alive)` on a thread of its own where `beat` was not called for `period` seconds. A context
    manager. seconds: for which the loop has been at one thing; alive: whether it may still be taken for alive."""

    def __init__(self, period: float, late: Callable[[float, bool], None]) -> None:
        self.period = period
        self._late = late
        self._done = threading.Event()
        self._begun = self._beaten = time.monotonic()
        self._thread = threading.Thread(target=self._watch, name="heartbeat", daemon=True)

    def __enter__(self) -> Heartbeat:
        self.turned()
        self.beat()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._thread.join()

    def turned(self) -> None:
        """The loop begins something else."""
        self._begun = time.monotonic()

    def beat(self) -> None:
        """A status has been published."""
        self._beaten = time.monotonic()

    def _watch(self) -> None:
        while not self._done.wait(max(self._beaten + self.period + GRACE - time.monotonic(), 0.01)):
            now = time.monotonic()
            if now - self._beaten >= self.period + GRACE:
                self._late(now - self._begun, now - self._begun < STUCK)
                self._beaten = now
