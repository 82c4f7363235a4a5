"""Which messages are on the mission's timeline, so that one wrong `time` does not stretch it to 1970.

A centre's own messages are, and say the mission's time. Of the others:

* once a centre has spoken, those from `AHEAD` before its first step to `AHEAD` after its newest, but not those of a
  source whose messages it refuses for their time;
* before, those whose time is within `FAR` of their reception: a mission that is played back may be years old, and a
  time in s, ms or us lies in 1970. The others wait for the centre, or for `settle`, which takes what most sources say.

What is not on it stays on file as it came, at its reception, and is not drawn.
"""

from __future__ import annotations

from collections.abc import Iterable

from schemas import GlobalTracks, Message, Status, StepLog

__all__ = ["MissionClock"]

AHEAD = 3600 * 10**9
FAR = 20 * 365 * 86_400 * 10**9
"""ns."""
OF_TIME = ("late", "future")
"""Reasons for which a message is refused that are about its time."""
MOST = 1024
"""Sources that are remembered."""


class MissionClock:
    """now: newest time on it, ns; start: that of the centre's first step, or of the first message there was; None
    before any."""

    def __init__(self) -> None:
        self.now: int | None = None
        self.start: int | None = None
        self._by_centre = False
        self._settled = False
        self._refused: set[str] = set()

    @property
    def decided(self) -> bool:
        """Whether it is known what is on it."""
        return self._by_centre or self._settled

    def place(self, message: Message | None, received: int) -> int | None:
        """The time of `message` on the mission's timeline, ns; None where it has none, or has none yet. That of a
        status is the service's own until its first step, which may be years from a mission played back."""
        at: int | None = getattr(message, "time", None)
        if message is None or at is None or isinstance(message, Status):
            return None
        if isinstance(message, GlobalTracks | StepLog):
            self.start = at if self.start is None or not self._by_centre else min(self.start, at)
            self._by_centre, self.now = True, at
            if isinstance(message, StepLog):
                self._note(message)
            return at
        if self.decided:
            return self._inside(message.source, at)
        if abs(at - received) > FAR:
            return None
        self._take(at)
        return at

    def judge(self, message: Message) -> int | None:
        """The same of a message that came before it could be told."""
        at: int | None = getattr(message, "time", None)
        if at is None or isinstance(message, Status | GlobalTracks | StepLog):
            return at
        return self._inside(message.source, at) if self.decided else None

    def settle(self, messages: Iterable[Message]) -> None:
        """Without a centre: the time of `messages` that most of their sources are near, of equally many the later."""
        if self.decided:
            return
        newest: dict[str, int] = {}
        first: dict[str, int] = {}
        for message in messages:
            at = getattr(message, "time", None)
            if at is not None and not isinstance(message, Status):
                newest[message.source] = max(at, newest.get(message.source, at))
                first[message.source] = min(at, first.get(message.source, at))
        if not newest:
            return
        votes = [(sum(abs(one - other) <= AHEAD for other in newest.values()), one) for one in newest.values()]
        chosen = max(votes)[1]
        if self.start is None or self.now is None or abs(self.start - chosen) > FAR:
            self.start = min([chosen, *(one for one in first.values() if abs(one - chosen) <= AHEAD)])
            self.now = chosen
        self._settled = True

    def _inside(self, source: str, at: int) -> int | None:
        assert self.now is not None
        assert self.start is not None
        if self._by_centre:
            there = source not in self._refused and self.start - AHEAD <= at <= self.now + AHEAD
            return at if there else None
        if abs(at - self.start) > FAR:
            return None
        self._take(at)
        return at

    def _take(self, at: int) -> None:
        self.now = at if self.now is None else max(self.now, at)
        self.start = at if self.start is None else self.start

    def _note(self, log: StepLog) -> None:
        self._refused -= {entry.source for entry in log.taken}
        for entry in log.refused:
            if entry.count == 0 and entry.reason in OF_TIME and len(self._refused) < MOST:
                self._refused.add(entry.source)
        self._refused -= {entry.source for entry in log.taken}
