"""The steps of a recorded centre in their order, each with its log and its picture, whichever came first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from schemas import GlobalTracks, StepLog

__all__ = ["PATIENCE", "Step", "Steps"]

PATIENCE = 5.0
"""Seconds, by the clock of the recorder, for which a step waits for its other half and for those before it."""
MOST_WAITING = 1000


@dataclass(slots=True)
class Step:
    """A step of one run: received, ns, when the recorder had the first of it; log and picture, None for what is not
    in the recording."""

    epoch: int
    number: int
    received: int
    log: StepLog | None = None
    picture: GlobalTracks | None = None

    @property
    def time(self) -> int:
        """When it holds, ns."""
        one = self.log or self.picture
        assert one is not None
        return one.time


class Steps:
    """Puts logs and pictures into the order of (epoch, step); what was given out already is not given out again."""

    def __init__(self) -> None:
        self._waiting: dict[tuple[int, int], Step] = {}
        self._last = (-1, -1)

    def add(self, message: StepLog | GlobalTracks, received: int) -> None:
        """A log or picture, as it comes."""
        key = message.epoch, message.step
        if key <= self._last:
            return
        step = self._waiting.setdefault(key, Step(*key, received))
        if isinstance(message, StepLog):
            step.log = step.log or message
        else:
            step.picture = step.picture or message

    def due(self, now: int | None = None) -> Iterator[Step]:
        """The steps that are whole, or have waited until `now`, ns; None for all that are left."""
        while self._waiting:
            key = min(self._waiting)
            step = self._waiting[key]
            follows = key[0] != self._last[0] or key[1] == self._last[1] + 1
            whole = step.log is not None and step.picture is not None
            patient = now is not None and now - step.received < PATIENCE * 1e9 and len(self._waiting) < MOST_WAITING
            if patient and not (follows and whole):
                return
            self._last = key
            yield self._waiting.pop(key)
