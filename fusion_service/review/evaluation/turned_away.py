"""What a centre's step logs say that it did not take: local tracks outside their gate, messages it refused."""

from __future__ import annotations

from bisect import bisect_left, bisect_right

import numpy as np

from schemas import StepLog
from schemas.messages import BROKEN, GATE_FAILED

__all__ = ["TurnedAway"]

MOST = 500_000
"""Rows that are remembered of each kind."""

LocalTrack = tuple[str, int, int]
"""Source, epoch and id."""


class TurnedAway:
    """Filled by `log`, step by step; then asked."""

    def __init__(self) -> None:
        self._outside: dict[int, set[LocalTrack]] = {}
        self._rows = 0
        self._refused: dict[str, list[tuple[int, str]]] = {}
        self._sorted: set[str] = set()

    def log(self, message: StepLog) -> None:
        """Enter a step log."""
        made = message.decisions
        rows = np.flatnonzero((made.kind == GATE_FAILED) | (made.kind == BROKEN)).tolist()
        if rows and self._rows < MOST:
            self._rows += len(rows)
            there = self._outside.setdefault(message.time, set())
            for row in rows:
                if (source := int(made.source[row])) < len(message.sources):
                    there.add((message.sources[source], int(made.epoch[row]), int(made.id[row])))
        for entry in (*message.refused, *message.dropped):
            if entry.count == 0 and self._rows < MOST:
                self._rows += 1
                self._refused.setdefault(entry.source, []).append((message.time, entry.reason))
                self._sorted.discard(entry.source)

    def outside(self, time: int) -> set[LocalTrack]:
        """The local tracks that were outside their gate, or cut, in the step at `time`, ns."""
        return self._outside.get(time, set())

    def refused(self, source: str, begin: int, end: int) -> str | None:
        """Why a message of `source` was refused or dropped in a step from `begin` to `end`, ns, the last one of them;
        None where none was."""
        known = self._refused.get(source)
        if not known:
            return None
        if source not in self._sorted:
            known.sort()
            self._sorted.add(source)
        low, high = bisect_left(known, (begin, "")), bisect_right(known, (end, "\U0010ffff"))
        return known[high - 1][1] if high > low else None
