"""How far ahead the sources let the clock of their messages go, and who of them has a say in it.

A source votes for the newest time it said, and the longest of its usual gaps on top: until then nobody expects another
word of it. The clock follows the lower median of the votes and half of `lateness`, so that no minority takes it ahead,
and nobody's data become too late for one that is fast. The earlier of the two in the middle, since a step too far
cannot be taken back, while data that are early wait.

Votes have those who are named in the config, or, where certificates say who is who, all. Else anybody can make up any
number of names, and more is asked: a vote is earned by `EARNED` scans that agree with the clock, and rests while what
its source says is ahead of what the others allow; and the clock goes ahead of none of these who goes on by more than
the lead. Who is behind by more than the lead has no vote, nor has who is silent: who has not gone on for three times
its usual pace, in the time of reception.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

from fusion_service.config import CentreConfig

__all__ = ["EARNED", "Voter", "Voting", "bound", "first_pace", "is_silent", "named"]

EARNED = 3
SILENT = 3
"""A source is silent after so many times its usual pace."""
KEEPS = 0.9
"""What a usual gap keeps of itself from one message to the next, where that comes sooner."""


class Voting(NamedTuple):
    """The rule. lead, lateness, period: ns; earned: whether votes must be earned."""

    lead: int
    lateness: int
    period: int
    earned: bool


@dataclass(slots=True)
class Voter:
    """A source as one that votes, times in ns. claimed: the newest time it said in this run, -1 for never; gap: the
    longest usual one between two of them; pace: the same in time of reception; heard: when it last went on, by that;
    agreed: scans that agreed with the clock; token: whether its token is there, None if it never had one."""

    claimed: int = -1
    gap: int = 0
    pace: int = 0
    heard: int = 0
    agreed: int = 0
    token: bool | None = None
    centre: bool = False

    def says(self, time: int, now: int, reached: int, rule: Voting) -> None:
        """A message that holds at `time` came at `now`; reached: how far the clock may go until here, -1: anywhere."""
        if self.claimed < 0:
            self.gap, self.pace, self.heard = rule.period, first_pace(rule), now
        elif time > self.claimed:
            self.gap = max(min(time - self.claimed, 10 * rule.lead), round(KEEPS * self.gap))
            self.pace = max(now - self.heard, round(KEEPS * self.pace))
            self.heard = now
        elif time < self.claimed - rule.lateness:
            self.heard = now - SILENT * self.pace - 1  # it fell back
        self.claimed = max(time, self.claimed)
        if reached < 0 or self.agrees(reached):
            self.agreed += 1
        elif self.claimed > reached + rule.lead:
            self.agreed = 0

    def agrees(self, reached: int) -> bool:
        """Whether it is not ahead of a clock that may go until `reached`."""
        return self.claimed <= reached

    def restart(self) -> None:
        """A new run: nothing is known of it."""
        self.claimed, self.agreed = -1, 0


def named(config: CentreConfig) -> frozenset[str] | None:
    """The sources that alone have a vote by the config; None: all have."""
    names = frozenset(name for name, one in config.sources.items() if not one.ignore)
    return names if config.clock_votes == "configured" or (config.clock_votes == "auto" and names) else None


def first_pace(rule: Voting) -> int:
    """What is taken for the pace of who was heard once, or not yet: it is silent after `lateness`, or a period, and
    half of that, so that its second word may come a little after those of others."""
    return max(rule.period, rule.lateness) // 2


def is_silent(one: Voter, now: int) -> bool:
    """Whether a source that was heard once, or has its token, has not gone on for long."""
    return now - one.heard > SILENT * one.pace


def bound(sources: Collection[Voter], now: int, reached: int, rule: Voting) -> int | None:
    """The latest time, ns, to which these sources let the clock go, which might go until `reached` so far (-1 before
    the first); None: none of them has a say."""
    awake = [one for one in sources if one.claimed >= 0 and one.token is not False and not is_silent(one, now)]
    awake = [one for one in awake if not one.centre] or awake
    voters = [one for one in awake if one.claimed + one.gap >= reached - rule.lead] or awake
    earlier = None
    if rule.earned and reached >= 0:
        earned = [one for one in voters if one.agreed >= EARNED]
        voters = [one for one in earned if one.agrees(reached)] or earned or voters
        earlier = min((one.claimed + one.gap for one in earned), default=None)
    if not voters:
        return None
    votes = sorted(one.claimed + one.gap for one in voters)
    middle = votes[(len(votes) - 1) // 2] + rule.lateness // 2
    return middle if earlier is None else min(middle, earlier + rule.lead)
