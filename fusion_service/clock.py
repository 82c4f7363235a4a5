"""When to step: by wall clock, or by the messages' own time (simulation, playback). No clock is read here."""

from __future__ import annotations

import heapq

from fusion_service.config import CentreConfig

__all__ = ["MessageClock", "WallClock"]


class WallClock:
    """Steps at t = k * period, made `delay` later; steps that were slept through are skipped."""

    def __init__(self, config: CentreConfig) -> None:
        self._period = round(config.period * 1e9)
        self._delay = round(config.delay * 1e9)
        self._last = -1
        self.skipped = 0

    def due(self, now: int) -> int | None:
        """Time of the step to make now, ns, or None."""
        newest = (now - self._delay) // self._period * self._period
        if self._last < 0:
            self._last = newest
            return None
        if newest <= self._last:
            return None
        self.skipped += (newest - self._last) // self._period - 1
        self._last = newest
        return newest

    def wait(self, now: int) -> float:
        """Seconds until the next step is due."""
        return max(0.0, (self._last + self._period + self._delay - now) / 1e9) if self._last >= 0 else 0.0


class MessageClock:
    """Steps at t = k * period when every live source has reached t, or the newest message is more than
    `lateness` past it.

    A source is live while its token is there, or, if it never had one, while its messages keep up. One that
    runs far ahead of all others (by more than `LEAD` seconds, `lateness` and ten periods) is not followed:
    `observe` says so, until another source has come along. Spans without any message are skipped.
    """

    LEAD = 60.0
    IDLE = 100

    def __init__(self, config: CentreConfig) -> None:
        self._period = round(config.period * 1e9)
        self._lateness = round(config.lateness * 1e9)
        self._lead = round(self.LEAD * 1e9) + self._lateness + 10 * self._period
        self._next: int | None = None
        self._claimed: dict[str, int] = {}
        self._newest: dict[str, int] = {}
        self._epoch: dict[str, int] = {}
        self._token: dict[str, bool] = {}
        self._times: list[int] = []

    def observe(self, source: str, epoch: int, time: int) -> bool:
        """A message of this run of `source` holds at `time`, ns. False: too far ahead of all others, refuse it."""
        if epoch > self._epoch.get(source, -1):
            self._epoch[source] = epoch
            self._claimed.pop(source, None)
            self._newest.pop(source, None)
        others = [claimed for name, claimed in self._claimed.items() if name != source and self._is_live(name)]
        self._claimed[source] = max(time, self._claimed.get(source, time))
        if others and time > max(others) + self._lead:
            return False
        self._newest[source] = max(time, self._newest.get(source, time))
        if self._next is None or time > self._next - self._period:
            heapq.heappush(self._times, time)
        return True

    def presence(self, source: str, alive: bool) -> None:
        """The token of `source` came or went."""
        self._token[source] = alive

    def _is_live(self, source: str) -> bool:
        token = self._token.get(source)
        if token is not None:
            return token
        front = max(self._newest.values(), default=0)
        return self._newest.get(source, -1) >= front - self._lateness - self._period

    def due(self) -> int | None:
        """Time of the step to make now, ns, or None. Call again after it has been made."""
        if not self._newest:
            return None
        front = max(self._newest.values())
        time = -(-self._times[0] // self._period) * self._period if self._next is None else self._next
        while self._times and self._times[0] <= time - self._period:
            heapq.heappop(self._times)
        if self._times and self._times[0] > time + self.IDLE * self._period:
            time = self._times[0] // self._period * self._period
        live = [name for name in {*self._token, *self._newest} if self._is_live(name)]
        reached = time <= front and all(self._newest.get(name, -1) >= time for name in live)
        if not reached and front <= time + self._lateness:
            return None
        self._next = time + self._period
        return time
