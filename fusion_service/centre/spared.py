"""Whose silence says nothing: sources of which data were dropped before they came to the centre."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion_service.config import CentreConfig

__all__ = ["Spared"]


class Spared:
    """What was dropped may hold until `delay` after the step that is told of it; so long, and two periods more, the
    source counts as one that has reported. newest: of which the newest step was told."""

    def __init__(self, config: CentreConfig) -> None:
        self._span = round((config.delay + 2 * config.period) * 1e9)
        self._until: dict[str, int] = {}
        self.newest: set[str] = set()

    def note(self, dropped: set[str], time: int) -> None:
        """The step at `time`, ns, is told that data of these sources were dropped."""
        self.newest = dropped
        left = {name: until for name, until in self._until.items() if until >= time}
        self._until = left | dict.fromkeys(dropped, time + self._span)

    def of(self, names: tuple[str, ...]) -> NDArray[np.bool_]:
        """Whether each of these sources is spared."""
        return np.array([name in self._until for name in names], dtype=np.bool_)
