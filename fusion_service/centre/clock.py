"""When to step: by wall clock, or by the messages' own time (simulation, playback). No clock is read here."""

from __future__ import annotations

import heapq
from dataclasses import dataclass

from fusion_service.centre.pictures import is_picture_of, source_of
from fusion_service.centre.votes import Voter, Voting, bound, first_pace, is_silent, named
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
class _Source(Voter):
    """What is known of a source beside its vote, times in ns, -1 for never.

    epoch: its run. newest: the newest time it said in this run that was followed. Of one too far ahead: refused, the
    newest time that was; waited, how long it has gone on by its own count while the median stood at `median`.
    """

    epoch: int = -1
    newest: int = -1
    refused: int = -1
    waited: int = 0
    median: int = -1


class MessageClock:
    """Steps at t = k * period when every live source has reached t, or the newest message, as far as it is followed, is
    more than `lateness` past it.

    It is followed as far as the votes of the sources allow (`votes`), whoever is further ahead; who has no vote while
    others have is not waited for, and what it says moves nothing.

    A source is live while its token is there, or, if it never had one, while its messages keep up. Where sources
    disagree about the time by more than the lead (`LEAD` seconds, `lateness` and ten periods), the median of what
    the live ones claim (of an even number the earlier of the two in the middle) decides: a message further ahead
    of it is not followed (`observe` says so). So of three or more that are awake the majority is followed,
    whether one is far ahead or far behind; of two nobody can tell which is wrong, and the earlier one is
    followed, since a step too far cannot be taken back. But steps go on: when the refused one has gone on for
    the lead by its own count (of which a single message makes up a tenth at most), and the median has not
    moved by one period in that time, it is followed. Who is behind the clock by more than half the
    lead has no say in that, and the clock waits for nobody who is behind by more than the lead, was refused last, is
    silent, or is so far behind that its next message will be too late.

    What is too late for the newest step is for the centre to refuse, in the next step; but where nothing else comes
    there is none, so that it is refused at once (`observe`). Where that has gone on for the lead, time was set back
    for everybody, and steps begin again from there.

    Other centres are waited for only where no other source is live: two that exchange their pictures would each wait
    for the other.

    Spans without any message are skipped. At most `MAX_NAMES` sources are known: beyond, a tenth of them is
    forgotten, those without a token first, the longest silent among them, those named in the config last.
    authenticated: certificates say who is who, so that all have a vote.
    """

    LEAD = 60.0
    IDLE = 100
    FEW = 3
    MAX_NAMES = 1000

    def __init__(self, config: CentreConfig, authenticated: bool = False) -> None:
        self._config = config
        self._period = round(config.period * 1e9)
        self._lateness = round(config.lateness * 1e9)
        self._lead = round(self.LEAD * 1e9) + self._lateness + 10 * self._period
        self._named = None if authenticated else named(config)
        self._voting = Voting(self._lead, self._lateness, self._period, not authenticated and self._named is None)
        self._now = 0
        """Time of reception that has passed, ns: between two messages at most the lead."""
        self._received = -1
        self._latest = -1
        """The newest time of those that came without a time of reception."""
        self._bound = -1
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
        taken = self.observe(source_of(message), message.epoch, message.time, received)
        return "" if taken else "late" if late else "future"

    def observe(self, source: str, epoch: int, time: int, received: int | None = None) -> bool:
        """A message of this run of `source` holds at `time`, ns, and came at `received` (None: as fast as its own time
        goes). False: refuse it, as too far ahead of the others, or as too late where `FEW` before it were so, and none
        was not."""
        one = self._source(source)
        if epoch > one.epoch:
            known = one.claimed >= 0
            one.restart()
            one.epoch, one.newest, one.refused = epoch, -1, -1
            if known:
                self._look_again()
        self._pass(time, received)
        if not self._has_a_say(source):
            one.says(time, self._now, self._bound, self._voting)
            return self._take_beside(one, time)
        if not self._is_late(time):
            self._late = 0
        elif not self._is_set_back(time):
            self._late += 1
        one.says(time, self._now, self._bound, self._voting)
        self._reference = min(self._reference, one.claimed)
        if time > self._reference + self._lead:
            median = self._median(one)
            self._reference = median if self._is_live(one, one.claimed) else -1
            if time > median + self._lead and not (self._goes_on(one, time) or self._has_waited(one, time, median)):
                return False
        one.refused = -1
        one.newest = max(time, one.newest)
        self._front = max(time, self._front)
        if self._next is None or time > self._next - self._period:
            self._wait_for(time)
        return self._late <= self.FEW

    def presence(self, source: str, alive: bool) -> None:
        """The token of `source` came or went."""
        one = self._source(source)
        one.token = alive
        if one.claimed < 0:
            one.heard, one.pace = self._now, first_pace(self._voting)
        self._reference = -1

    def limit(self) -> int:
        """The latest time, ns, to which the sources let the clock go; -1 before any message."""
        allowed = self._allowed()
        return self._front if allowed is None else min(self._front, allowed)

    def _allowed(self) -> int | None:
        return bound(self._voters(), self._now, self._bound, self._voting)

    def _voters(self) -> list[_Source]:
        """Those named, where one of them speaks; else all."""
        known = [self._sources[name] for name in self._named or () if name in self._sources]
        speak = any(one.claimed >= 0 and one.token is not False and not is_silent(one, self._now) for one in known)
        return known if speak else list(self._sources.values())

    def _pass(self, time: int, received: int | None) -> None:
        """Let time of reception pass until this message."""
        if received is None:
            self._now += min(max(time - self._latest, 0), self._period) if self._latest >= 0 else 0
            self._latest = max(time, self._latest)
        else:
            self._now += min(max(received - self._received, 0), self._lead) if self._received >= 0 else 0
            self._received = received

    def _has_a_say(self, source: str) -> bool:
        """Whether it has a vote, or none of those speaks who alone should."""
        return self._named is None or source in self._named or len(self._voters()) == len(self._sources)

    def _take_beside(self, one: _Source, time: int) -> bool:
        """A message of who has no say: it is taken unless it is too far ahead of the clock."""
        if time > self._front + self._lead:
            return False
        one.refused, one.newest = -1, max(time, one.newest)
        if self._next is None or time > self._next - self._period:
            self._wait_for(time)
        return True

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
            one.restart()
            one.newest = one.refused = -1
        self._next, self._front, self._reference, self._late, self._bound = None, -1, -1, 0, -1
        self._times, self._waiting = [], set()
        return True

    def _source(self, name: str) -> _Source:
        if name not in self._sources:
            if len(self._sources) >= self.MAX_NAMES:
                free = [known for known in self._sources if known not in (self._named or ())] or list(self._sources)
                unheld = [known for known in free if not self._sources[known].token] or free
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

    def _median(self, asking: _Source, awake: bool = False) -> int:
        """The earlier median of what the live sources claim that have a vote; awake: but those that are silent."""
        base = self._bound if self._bound >= 0 else self._front - self._lead
        claims = sorted(
            one.claimed
            for one in self._voters()
            if one is asking
            or (
                one.claimed >= max(0, base - self._lead // 2)
                and self._is_live(one, one.claimed)
                and not (awake and is_silent(one, self._now))
            )
        )
        return claims[(len(claims) - 1) // 2]

    def _goes_on(self, one: _Source, time: int) -> bool:
        """Whether a source that was followed goes on by small steps, while those who hold it back are silent."""
        return one.newest >= 0 and time <= min(one.newest + self._lead // 10, self._median(one, True) + self._lead)

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
        if time > self._front or (self._front <= time + self._lateness and not self._reached(time, self._front)):
            return None
        allowed = self._allowed()
        self._bound = max(self._bound, -1 if allowed is None else allowed)
        limit = self._front if allowed is None else min(self._front, allowed)
        if time > limit or (limit <= time + self._lateness and not self._reached(time, limit)):
            return None
        self._next = time + self._period
        return time

    def _reached(self, time: int, limit: int) -> bool:
        """Whether everybody who is waited for has said `time`, of a clock that may go until `limit`."""
        centres = False
        for one in self._voters():
            if one.newest >= time or one.refused >= 0 or not self._is_live(one, one.newest):
                continue
            if 0 <= one.newest < max(limit - self._lead, time - self._lateness - max(one.gap, self._period)):
                continue
            if is_silent(one, self._now):
                continue
            if not one.centre:
                return False
            centres = True
        others = (one for one in self._sources.values() if not one.centre)
        return not centres or any(self._is_live(one, one.newest) for one in others)
