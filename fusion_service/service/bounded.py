"""What may be said how often: a log that no input can flood."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Mapping

__all__ = ["BoundedLog", "uncounted"]

LOUD = 10.0
"""Seconds between two lines of the same words about what is wrong."""

MOST_TOLD = 1000
"""Words that are remembered: sources write some of them."""

log = logging.getLogger(__name__)


def uncounted(note: str) -> str:
    """A note that ends by how many, without that: the same note, however many it has come to."""
    return re.sub(r": \d+ .*", "", note)


class BoundedLog:
    """Counts when what was last said. refusals: lines about refusals per second and reason at most."""

    def __init__(self, refusals: float) -> None:
        self.limit(refusals)
        self._told: dict[str, float] = {}
        self._refused: dict[str, tuple[float, int]] = {}

    def limit(self, refusals: float) -> None:
        """As many lines from now on."""
        self._interval = 1.0 / max(refusals, 1e-3)

    def allows(self, what: str, interval: float) -> bool:
        """Whether `interval` seconds have passed since this was last allowed."""
        now = time.monotonic()
        if now - self._told.get(what, float("-inf")) < interval:
            return False
        if len(self._told) >= MOST_TOLD:
            self._told.clear()
        self._told[what] = now
        return True

    def warn(self, words: str, *values: object) -> None:
        """Log a warning, at most once in `LOUD` seconds for the same words."""
        if self.allows(words, LOUD):
            log.warning(words, *values)

    def error(self, words: str, *values: object) -> None:
        """Log an error, with its trace unless the last value is one, at most once in `LOUD` seconds for the same
        words."""
        if self.allows(words, LOUD):
            log.error(words, *values, exc_info=not isinstance(values[-1], Exception))

    def refusals(self, refused: Mapping[str, int], dropped: Mapping[str, int]) -> None:
        """One line per reason and interval, with the number since the last line. refused: by reason; dropped: by
        source; both since the start."""
        now = time.monotonic()
        for reason, total in {**refused, "dropped from a queue": sum(dropped.values())}.items():
            since, told = self._refused.get(reason, (float("-inf"), 0))
            if total > told and now - since >= self._interval:
                self._refused[reason] = (now, total)
                log.warning("refused %d more: %s (%d in all)", total - told, reason, total, extra={"reason": reason})
