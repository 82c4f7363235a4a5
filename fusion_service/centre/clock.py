"""When to step: by wall clock, or by the messages' own time (simulation, playback). No clock is read here."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

from fusion_service.centre.pictures import is_picture_of, source_of
from fusion_service.config import CentreConfig
from schemas import GlobalTracks, LocalIntensity, LocalTracks

__all__ = ["MessageClock", "WallClock", "horizon"]


RESUMED = 10_000_000_000
"""ns after a step within which another process goes on from it, not from the next period."""


def horizon(received: int, config: CentreConfig) -> int:
    """The latest time, ns, that what came at `received` may speak of: everything beyond is refused as `future`."""
    return received + round(config.max_future * 1e9)


class WallClock:
    """Steps at t = k * period, made `delay` later; steps that were slept through are skipped."""

    def __init__(self, config: CentreConfig) -> None:
        self._period = round(config.period * 1e9)
        self._delay = round(config.delay * 1e9)
        self._last = -1
        self.skipped = 0

    def due(self, now: int) -> int | None:
        """Time of the step to make now, ns, or None. Where the clock was set back by more than a period, it is
        before the last one: the centre judges by `ClockSet` whether a new era begins."""
        newest = (now - self._delay) // self._period * self._period
        if self._last < 0:
            self._last = newest
            return None
        if self._last - self._period <= newest <= self._last:
            return None
        self.skipped += max(0, (newest - self._last) // self._period - 1)
        self._last = newest
        return newest

    def resume(self, last: int, now: int) -> None:
        """Go on at `now` after a step at `last`, ns, if that was within `RESUMED`."""
        if 0 <= last <= now - self._delay <= last + RESUMED:
            self._last = last // self._period * self._period

    def wait(self, now: int) -> float:
        """Seconds until the next step is due."""
        return max(0.0, (self._last + self._period + self._delay - now) / 1e9) if self._last >= 0 else 0.0


@dataclass(slots=True)
class _Source:
    """What is known of a source, times in ns, -1 for never.

    epoch: its run. claimed: the newest time it said in this run, and newest: that of those which were followed.
    token: whether its token is there; None if it never had one. Of one too far ahead: refused, the newest time
    that was; waited, how long it has gone on by its own count while the median stood at `median`.
    centre: it is another centre.
    """

    epoch: int = -1
    claimed: int = -1
    newest: int = -1
    token: bool | None = None
    refused: int = -1
    waited: int = 0
    median: int = -1
    centre: bool = False


class MessageClock:
    """Steps at t = k * period when every live source has reached t, or the newest message is more than
    `lateness` past it.

    A source is live while its token is there, or, if it never had one, while its messages keep up. Where sources
    disagree about the time by more than the lead (`LEAD` seconds, `lateness` and ten periods), the median of what
    the live ones claim (of an even number the earlier of the two in the middle) decides: a message further ahead
    of it is not followed (`observe` says so). So of three or more that are awake the majority is followed,
    whether one is far ahead or far behind; of two nobody can tell which is wrong, and the earlier one is
    followed, since a step too far cannot be taken back. But steps go on: when the refused one has gone on for
    the lead by its own count (of which a single message makes up a tenth at most), and the median has not
    moved by one period in that time, it is followed. Who is behind the clock by more than one and a half
    leads has no vote, and the clock waits for nobody who is behind by more than one, or
    was refused last.

    What is too late for the newest step is for the centre to refuse, in the next step; but where nothing else comes
    there is none, so that it is refused at once (`observe`). Where that has gone on for the lead, time was set back
    for everybody, and steps begin again from there.

    Other centres are waited for only where no other source is live: two that exchange their pictures would each wait
    for the other.

    Spans without any message are skipped. At most `MAX_NAMES` sources are known: beyond, a tenth of them is
    forgotten, those without a token first, the longest silent among them.
    """

    LEAD = 60.0
    IDLE = 100
    FEW = 3
    MAX_NAMES = 1000

    def __init__(self, config: CentreConfig) -> None:
        self._config = config
        self._period = round(config.period * 1e9)
        self._lateness = round(config.lateness * 1e9)
        self._lead = round(self.LEAD * 1e9) + self._lateness + 10 * self._period
        self._next: int | None = None
        self._sources: dict[str, _Source] = {}
        self._front = -1
        """The newest time that was followed."""
        self._reference = -1
        """No later than the median of the live sources' claims."""
        self._times: list[int] = []
        self._waiting: set[int] = set()
        self._late = 0
        """Messages that were too late since the last that was not; their newest time, and how far it has gone on."""
        self._late_newest = -1
        self._late_waited = 0

    def fault(self, message: LocalTracks | LocalIntensity | GlobalTracks, received: int) -> str:
        """Observe a message that came at `received`, ns, and say why to refuse it: `future`, too far ahead of its
        reception or of the others; `late`, when no step will be made that tells; empty: take it."""
        if max(message.time, message.epoch) > horizon(received, self._config):
            return "future"
        late = self._is_late(message.time)
        return "" if self.observe(source_of(message), message.epoch, message.time) else "late" if late else "future"

    def observe(self, source: str, epoch: int, time: int) -> bool:
        """A message of this run of `source` holds at `time`, ns. False: refuse it, as too far ahead of the others, or
        as too late where `FEW` before it were so, and none was not."""
        one = self._source(source)
        if epoch > one.epoch:
            known = one.claimed >= 0
            one.epoch, one.claimed, one.newest, one.refused = epoch, -1, -1, -1
            if known:
                self._look_again()
        if not self._is_late(time):
            self._late = 0
        elif not self._is_set_back(time):
            self._late += 1
        one.claimed = max(time, one.claimed)
        self._reference = min(self._reference, one.claimed)
        if time > self._reference + self._lead:
            median = self._median(one)
            self._reference = median if self._is_live(one, one.claimed) else -1
            if time > median + self._lead and not self._has_waited(one, time, median):
                return False
        one.refused = -1
        one.newest = max(time, one.newest)
        self._front = max(time, self._front)
        if self._next is None or time > self._next - self._period:
            self._wait_for(time)
        return self._late <= self.FEW

    def presence(self, source: str, alive: bool) -> None:
        """The token of `source` came or went."""
        self._source(source).token = alive
        self._reference = -1

    def _is_late(self, time: int) -> bool:
        """Whether the step for what holds at `time` was made long ago."""
        return self._next is not None and time < self._next - self._period - self._lateness

    def _is_set_back(self, time: int) -> bool:
        """Whether everybody's time is set back: a late message, and nothing else for the lead by its own count. Then
        steps begin anew."""
        if not self._late:
            self._late_newest, self._late_waited = time, 0
        self._late_waited += min(max(time - self._late_newest, 0), self._lead // 10)
        self._late_newest = max(time, self._late_newest)
        if self._late_waited < self._lead:
            return False
        for one in self._sources.values():
            one.claimed = one.newest = one.refused = -1
        self._next, self._front, self._reference, self._late = None, -1, -1, 0
        self._times, self._waiting = [], set()
        return True

    def _source(self, name: str) -> _Source:
        if name not in self._sources:
            if len(self._sources) >= self.MAX_NAMES:
                unheld = [known for known, one in self._sources.items() if not one.token] or list(self._sources)
                for known in heapq.nsmallest(self.MAX_NAMES // 10, unheld, key=lambda it: self._sources[it].newest):
                    del self._sources[known]
                self._look_again()
            self._sources[name] = _Source(centre=bool(is_picture_of(name)))
        return self._sources[name]

    def _look_again(self) -> None:
        self._front = max(one.newest for one in self._sources.values())
        self._reference = -1

    def _is_live(self, one: _Source, newest: int) -> bool:
        return newest >= self._front - self._lateness - self._period if one.token is None else one.token

    def _median(self, asking: _Source) -> int:
        claims = sorted(
            one.claimed
            for one in self._sources.values()
            if one is asking
            or (one.claimed >= max(0, self._front - self._lead * 3 // 2) and self._is_live(one, one.claimed))
        )
        return claims[(len(claims) - 1) // 2]

    def _has_waited(self, one: _Source, time: int, median: int) -> bool:
        """Whether a source that is too far ahead has gone on for the lead while the median did not move."""
        if one.refused < 0 or median >= one.median + self._period:
            one.refused, one.waited, one.median = time, 0, median
        one.waited += min(max(time - one.refused, 0), self._lead // 10)
        one.refused = max(time, one.refused)
        return one.waited >= self._lead

    def _wait_for(self, time: int) -> None:
        """Note that there is a message on, or inside, this period."""
        kept = time if time % self._period == 0 else time // self._period * self._period + 1
        if kept not in self._waiting:
            self._waiting.add(kept)
            heapq.heappush(self._times, kept)

    def due(self) -> int | None:
        """Time of the step to make now, ns, or None. Call again after it has been made."""
        if self._front < 0:
            return None
        time = -(-self._times[0] // self._period) * self._period if self._next is None else self._next
        while self._times and self._times[0] <= time - self._period:
            self._waiting.remove(heapq.heappop(self._times))
        if self._times and self._times[0] > time + self.IDLE * self._period:
            time = self._times[0] // self._period * self._period
        if time > self._front or (self._front <= time + self._lateness and not self._reached(time)):
            return None
        self._next = time + self._period
        return time

    def _reached(self, time: int) -> bool:
        """Whether everybody who is waited for has said `time`."""
        centres = False
        for one in self._sources.values():
            if not self._is_live(one, one.newest):
                continue
            if one.newest >= time or one.refused >= 0 or 0 <= one.newest < self._front - self._lead:
                continue
            if not one.centre:
                return False
            centres = True
        others = (one for one in self._sources.values() if not one.centre)
        return not centres or any(self._is_live(one, one.newest) for one in others)
