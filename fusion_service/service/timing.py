"""`StepTimes`: when the service steps, by the clock that the config asks for, and what is skipped when it is behind."""

from __future__ import annotations

from fusion_service.centre import ArrivalClock, MessageClock, WallClock
from fusion_service.config import CentreConfig
from schemas import GlobalTracks, LocalIntensity, LocalTracks

__all__ = ["StepTimes"]

SMOOTHING = 4.0
"""The cost of a step is a mean over about so many."""


class StepTimes:
    """Steps by the wall clock, by the messages' own time, or on arrival.

    skipped: steps that were not made since the start because the service was behind, or slept: those of the wall clock
    whose time has passed; by the messages' time, where steps take longer than the time they stand for, all that are due
    but the newest. told: how many of them were told to the centre. authenticated: sources show certificates.
    """

    def __init__(self, config: CentreConfig, authenticated: bool = False) -> None:
        self._period = config.period
        self._by_messages = config.clock == "message"
        self._arrival = ArrivalClock(config, authenticated) if config.trigger == "arrival" else None
        self._messages = MessageClock(config, authenticated) if self._by_messages and self._arrival is None else None
        self._wall = WallClock(config)
        self._cost = 0.0
        self._passed = 0
        self._told = 0

    @property
    def patience(self) -> float:
        """Seconds that what came may wait for its turn before the service is behind. By the messages' own time it is
        not behind as long as steps take less than they stand for, however fast a mission is played."""
        return float("inf") if self._by_messages else self._period

    @property
    def skipped(self) -> int:
        """Steps that were not made."""
        return self._passed + (self._wall.skipped if self._arrival is None else 0)

    def untold(self) -> int:
        """How many were skipped since this was last asked."""
        new, self._told = self.skipped - self._told, self.skipped
        return new

    def made(self, seconds: float) -> None:
        """A step was made, in so many seconds."""
        self._cost += (seconds - self._cost) / SMOOTHING

    def fault(self, message: LocalTracks | LocalIntensity | GlobalTracks, received: int) -> str:
        """Observe a message that came at `received`, ns, and say why to refuse it; empty: take it."""
        clock = self._arrival or self._messages
        return clock.fault(message, received) if clock is not None else ""

    def presence(self, source: str, alive: bool) -> None:
        """The token of `source` came or went."""
        clock = self._arrival or self._messages
        if clock is not None:
            clock.presence(source, alive)

    def due(self, now: int, last: int) -> int | None:
        """Time of the step to make at `now`, ns, or None; last: that of the newest step. Nothing that came until `now`
        must still wait: a step says of what it has not seen that it was not there."""
        if self._arrival is not None:
            return self._arrival.due(now, last)
        if self._messages is None:
            return self._wall.due(now)
        due = self._messages.due()
        while due is not None and self._cost > self._period and (later := self._messages.due()) is not None:
            due = later
            self._passed += 1
        return due

    def resume(self, last: int, now: int) -> None:
        """Go on at `now` after a step at `last`, ns, that another process made, without waiting for the next period."""
        self._wall.resume(last, now)

    def wait(self, now: int) -> float:
        """Seconds until a step may be due without anything new; infinite where none will be."""
        if self._arrival is not None:
            return self._arrival.wait(now)
        return self._wall.wait(now) if self._messages is None else float("inf")
