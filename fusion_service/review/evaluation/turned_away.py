"""What a centre's step logs say that it did not take, or not show: local tracks outside their gate, messages it
refused, tracks it suspended."""

from __future__ import annotations

from bisect import bisect_left, bisect_right

import numpy as np

from schemas import Decisions, StepLog
from schemas.messages import BROKEN, GATE_FAILED

__all__ = ["TurnedAway"]

MOST = 500_000
"""Rows that are remembered of each kind."""

END = 2**63
LocalTrack = tuple[str, int, int]
"""Source, epoch and id."""


class TurnedAway:
    """Filled by `log`, step by step; then asked."""

    def __init__(self) -> None:
        self._outside: dict[int, set[LocalTrack]] = {}
        self._rows = 0
        self._refused: dict[str, list[tuple[int, str]]] = {}
        self._sorted: set[str] = set()
        self._suspended: dict[LocalTrack, list[list[int]]] = {}
        self._behind: dict[int, list[LocalTrack]] = {}
        self._before: tuple[Decisions, tuple[str, ...]] | None = None

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
        for event in message.events:
            if event.get("kind") in ("suspended", "resumed") and isinstance(
                tracks := event.get("tracks"), list | tuple
            ):
                for track in (one for one in tracks if isinstance(one, int) and 0 <= one < 2**64):
                    self._shown(track, message, event["kind"] == "resumed")
        self._before = made, message.sources

    def _shown(self, track: int, message: StepLog, again: bool) -> None:
        """A global track is suspended, or shown again: so are the local tracks that were linked to it last."""
        for one in self._behind.pop(track, []):
            self._suspended[one][-1][1] = message.time
        if again or self._rows >= MOST:
            return
        members: set[LocalTrack] = set()
        for made, sources in filter(None, (self._before, (message.decisions, message.sources))):
            rows = np.flatnonzero(made.track == track).tolist()
            some = [(int(made.source[row]), int(made.epoch[row]), int(made.id[row])) for row in rows]
            members |= {(sources[source], epoch, one) for source, epoch, one in some if source < len(sources)}
        self._rows += len(members)
        self._behind[track] = sorted(members)
        for member in self._behind[track]:
            self._suspended.setdefault(member, []).append([message.time, END])

    def suspended(self, local: LocalTrack, time: int) -> bool:
        """Whether the track that this one fed was suspended at `time`, ns."""
        return any(begin <= time < end for begin, end in self._suspended.get(local, ()))

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
