"""When to step where `trigger = "arrival"`: as soon as a scan is in, at the scan's own time. No clock is read here."""

from __future__ import annotations

import heapq

from fusion_service.centre.clock import MessageClock, WallClock, horizon
from fusion_service.centre.era import margin
from fusion_service.config import CentreConfig
from schemas import GlobalTracks, LocalIntensity, LocalTracks

__all__ = ["TICK", "ArrivalClock"]

TICK = 1000
"""ns from the newest step to one for a scan that is not after it."""
MOST_WAITING = 10_000


class ArrivalClock:
    """Steps for the scans that have come, all together at the time of the newest of them, `arrival_spacing` after the
    step before at the earliest.

    A scan that is not after the newest step makes a step `TICK` after that; one that is too old for the centre to take
    makes none. By the wall clock a scan that is ahead of now waits until now has come there, and where nothing comes,
    steps are made at multiples of `period`, `delay` behind now; half a period later where a step was made in the period
    before it, and none where one has been made by then: scans that come all the time need no other steps, and none of
    them has to wait for one. By the messages' own time, `MessageClock` judges which of them are followed; where nothing
    comes there is no step.
    """

    def __init__(self, config: CentreConfig, authenticated: bool = False) -> None:
        self._config = config
        self._spacing = round(config.arrival_spacing * 1e9)
        self._lateness = round(config.lateness * 1e9)
        self._period = round(config.period * 1e9)
        self._back = round((config.delay + config.period) * 1e9)
        self._margin = margin(config)
        self._messages = MessageClock(config, authenticated) if config.clock == "message" else None
        self._grid = WallClock(config)
        self._waiting: list[int] = []
        self._free = -1
        """When the next step may be made, ns."""
        self._held, self._until = -1, -1
        """Time of a step that is made where nothing comes, and until when it waits for that, ns."""

    @property
    def skipped(self) -> int:
        """Steps without data that were slept through."""
        return self._grid.skipped

    def fault(self, message: LocalTracks | LocalIntensity | GlobalTracks, received: int) -> str:
        """Observe a message that came at `received`, ns, and say why to refuse it, as `MessageClock.fault` does."""
        fault = self._messages.fault(message, received) if self._messages is not None else ""
        if not fault and message.time <= horizon(received, self._config) and len(self._waiting) < MOST_WAITING:
            heapq.heappush(self._waiting, message.time)
        return fault

    def presence(self, source: str, alive: bool) -> None:
        """The token of `source` came or went."""
        if self._messages is not None:
            self._messages.presence(source, alive)

    def due(self, now: int, last: int) -> int | None:
        """Time of the step to make now, ns, or None; last: that of the newest step, -1 for none. It is before `last`
        where a clock was set back: the centre judges by `ClockSet` whether a new era begins."""
        if self._messages is not None:
            self._follow()
        elif (grid := self._grid.due(now)) is not None:
            if grid < last - self._back:
                self._held = -1
                return grid
            self._held, self._until = grid, now + (self._period // 2 if last > grid - self._period else 0)
        if not self._free - self._spacing <= now < self._free:
            newest = self._newest(now if self._messages is None else self._messages.limit())
            if newest is not None and (at := self._step_for(newest, last)) is not None:
                self._free = now + self._spacing
                return at
        return self._without_data(now, last)

    def _without_data(self, now: int, last: int) -> int | None:
        """The step that is made where nothing comes, if it is due."""
        held = self._held
        if held >= 0 and (held <= last or now >= self._until):
            self._held = -1
        return held if held > last and now >= self._until else None

    def wait(self, now: int) -> float:
        """Seconds until a step may be due without anything new; infinite where none will be."""
        waits = self._waiting and (self._messages is None or self._waiting[0] <= self._messages.limit())
        at = max(self._waiting[0], self._free) if waits else None
        until = float("inf") if at is None else max(0.0, (at - now) / 1e9)
        if self._held >= 0:
            until = min(until, max(0.0, (self._until - now) / 1e9))
        return until if self._messages is not None else min(until, self._grid.wait(now))

    def _follow(self) -> None:
        """Let the clock of the messages go on: it knows what is late, and whether time was set back."""
        assert self._messages is not None
        while self._messages.due() is not None:
            pass

    def _newest(self, now: int) -> int | None:
        """The newest of the scans that wait and hold until `now`, which wait no more; None for none."""
        newest = None
        while self._waiting and self._waiting[0] <= now:
            newest = heapq.heappop(self._waiting)
        return newest

    def _step_for(self, newest: int, last: int) -> int | None:
        if newest > last:
            return newest
        if newest >= last - self._lateness:
            return last + TICK
        return newest if self._messages is not None and newest < last - self._margin else None
