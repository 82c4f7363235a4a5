"""Whose silence says nothing: sources of which data were dropped before they came to the centre, and all of them while
the centre itself was not there: frozen, dead, or without time."""

from __future__ import annotations

from copy import copy

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre.events import Skipped
from fusion_service.config import CentreConfig

__all__ = ["GRACE", "Spared"]

DEAF = 2.0
"""Seconds of steps not made from which the centre was not there; less is a hiccup, unless it was made anew."""
NEVER = 2**62
HELD = 60.0
"""Seconds up to which tracks are held over such a time; what was there before a longer one is no picture of now."""
GRACE = 10_000_000_000
"""ns after that in which sources may be found again."""


class Spared:
    """What was dropped may hold until `delay` after the step that is told of it; so long, and two periods more, the
    source counts as one that has reported. newest: of which the newest step was told.

    awake: time of the step that was the first after the centre was not there, ns, -1: never. What was not heard before
    it is no silence. gap: of the step that is made, ns for which the centre was not there before it. awaited: sources
    that suspended tracks wait for.
    """

    def __init__(self, config: CentreConfig) -> None:
        self._span = round((config.delay + 2 * config.period) * 1e9)
        self._until: dict[str, int] = {}
        self.newest: set[str] = set()
        self._deaf = round(DEAF / config.period) if config.suspend else NEVER
        self._slept = 0
        self.awake = -1
        self.gap = 0
        self.awaited: frozenset[str] = frozenset()

    def sleep(self, event: object) -> None:
        """Steps before the next one are not made."""
        if isinstance(event, Skipped):
            self._slept += event.steps
            if event.absent and self._deaf < NEVER:
                self._slept = max(self._slept, self._deaf)

    def slept_as(self, other: Spared) -> None:
        """So much was told for the next step as `other` was told."""
        self._slept = other._slept

    def rested(self) -> Spared:
        """The same before anything was told for the next step."""
        same = copy(self)
        same._slept = 0
        return same

    def note(self, dropped: set[str], time: int, last: int) -> None:
        """The step at `time`, ns, after the one at `last`, is told that data of these sources were dropped."""
        deaf = self._slept >= max(self._deaf, 1) and last >= 0 and time - last <= HELD * 1e9
        self.awake, self.gap = (time, time - last) if deaf else (self.awake, 0)
        self._slept = 0
        self.newest = dropped
        left = {name: until for name, until in self._until.items() if until >= time}
        self._until = left | dict.fromkeys(dropped, time + self._span)

    def of(self, names: tuple[str, ...]) -> NDArray[np.bool_]:
        """Whether each of these sources is spared."""
        return np.array([name in self._until for name in names], dtype=np.bool_)

    def after_waking(
        self, expected: NDArray[np.int64], time: NDArray[np.int64], pause: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """When the next reports (K,) are overdue, ns, of rows last reported at `time`: of what was not heard since the
        centre is awake, not before `pause` and `GRACE` after that."""
        if self.awake < 0:
            return expected
        return np.where(time < self.awake, np.maximum(expected, self.awake + pause + GRACE), expected)
