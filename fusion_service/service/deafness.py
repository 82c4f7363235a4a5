"""Whether the active process does not hear what this one hears, though its loop goes round.

By pictures it is not to be seen: with `trigger = "arrival"`, or by the clock of the messages, who hears nothing makes
no step; else it goes on with what it has. So it says with each sign of life how long ago something came to it.
"""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["Deafness"]

APART = 1.0
"""Seconds after the newest message there within which one here tells nothing: it may be on its way."""
FEW = 10
"""Messages that one may miss without being deaf."""


class Deafness:
    """now: seconds that only grow. Each method may be called by another thread."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._count = 0
        self._newest = float("-inf")
        self._since: float | None = None
        self._from = 0

    def sample(self) -> None:
        """Something came here from a source."""
        self._count, self._newest = self._count + 1, self._now()

    def told(self, age: object) -> None:
        """The active process said that something came there `age` seconds ago."""
        now = self._now()
        if not isinstance(age, (int, float)) or not self._newest > now - age + APART:
            self._since = None
        elif self._since is None:
            self._since, self._from = now, self._count

    def seconds(self) -> float:
        """For how long it has been deaf; 0 while that cannot be said."""
        since = self._since
        return self._now() - since if since is not None and self._count - self._from >= FEW else 0.0
