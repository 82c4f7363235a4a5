"""When to step: the message clock is run against a plain statement of its rule."""

from __future__ import annotations

import tracemalloc
from time import process_time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion_service.centre import MessageClock, WallClock
from fusion_service.config import CentreConfig
from tests.centre.worlds import SECOND, START, tracks


def clock(**config: float) -> MessageClock:
    return MessageClock(CentreConfig(**{"period": 1.0, "lateness": 3.0, **config}))  # type: ignore[arg-type]


def drain(of: MessageClock) -> list[float]:
    out = []
    while (time := of.due()) is not None:
        out.append((time - START) / SECOND)
    return out


def see(of: MessageClock, source: str, at: float, epoch: int = 1) -> bool:
    return of.observe(source, epoch, START + round(at * SECOND))


def test_steps_when_every_live_source_has_reached_them() -> None:
    one = clock()
    one.presence("a", True)
    one.presence("b", True)
    assert see(one, "a", 0.5)
    assert drain(one) == []
    assert see(one, "b", 2.2)
    assert drain(one) == []
    assert see(one, "a", 2.0)
    assert drain(one) == [1.0, 2.0]


def test_does_not_wait_longer_than_lateness_for_a_silent_source() -> None:
    one = clock()
    one.presence("silent", True)
    see(one, "a", 0.0)
    assert drain(one) == []
    see(one, "a", 3.5)
    assert drain(one) == [0.0]


def test_a_lost_source_is_not_waited_for() -> None:
    one = clock()
    for name in ("a", "b"):
        one.presence(name, True)
        see(one, name, 1.0)
    assert drain(one) == [1.0]
    see(one, "a", 2.0)
    assert drain(one) == []
    one.presence("b", False)
    assert drain(one) == [2.0]


def test_a_restarted_source_is_waited_for_from_where_it_is_now() -> None:
    one = clock()
    for name in ("a", "b"):
        one.presence(name, True)
        see(one, name, 5.0)
    assert drain(one) == [5.0]
    see(one, "b", 3.0, epoch=2)
    see(one, "a", 6.0)
    assert drain(one) == []
    see(one, "b", 6.0, epoch=2)
    assert drain(one) == [6.0]


def test_one_that_runs_far_ahead_is_not_followed_until_another_is_there() -> None:
    one = clock()
    for name in ("a", "b"):
        one.presence(name, True)
        see(one, name, 1.0)
    assert drain(one) == [1.0]
    assert not see(one, "a", 1e6)
    assert see(one, "b", 2.0)
    assert see(one, "b", 1e6)
    assert see(one, "a", 1e6)
    assert drain(one)[-1] == 1e6


def test_a_long_silence_is_not_stepped_through() -> None:
    one = clock()
    see(one, "a", 1.0)
    assert drain(one) == [1.0]
    see(one, "a", 1e6 + 0.5)
    assert len(drain(one)) < 10


def start(**at: float) -> MessageClock:
    """A clock on which these sources have their tokens and have each said a time."""
    one = clock()
    for name, seconds in at.items():
        one.presence(name, True)
        see(one, name, seconds)
        drain(one)
    return one


WRONG = 1e6


@pytest.mark.parametrize("count", [2, 4])
def test_with_three_or_five_the_majority_is_followed(count: int) -> None:
    # a client that starts at time 0 locks nobody out, and is not waited for
    one = start(lost=0.0)
    names = [f"radar{k}" for k in range(count)]
    for name in names:
        one.presence(name, True)
        see(one, name, WRONG)
    for second in (1, 2, 3):
        assert all(see(one, name, WRONG + second) for name in names)
        assert see(one, "lost", float(second))
        assert drain(one)[-1] == WRONG + second
    # and one, or two of five, far ahead move the clock for nobody
    one = start(**dict.fromkeys(names, 0.0))
    for k in range(count // 2):
        one.presence(f"ahead{k}", True)
    for second in range(1, 200):
        assert not any(see(one, f"ahead{k}", WRONG + second) for k in range(count // 2))
        assert all(see(one, name, float(second)) for name in names)
        assert drain(one) == [second]


def test_of_two_the_earlier_is_followed_while_it_moves_and_the_later_once_it_does_not() -> None:
    one = start(early=0.0)
    one.presence("late", True)
    for second in range(1, 200):
        assert not see(one, "late", WRONG + second)
        assert see(one, "early", float(second))
        assert drain(one) == [second]
    followed = [second for second in range(200, 400) if see(one, "late", WRONG + second)]
    assert followed == list(range(followed[0], 400))
    assert 200 + 60 < followed[0] < 200 + 100
    assert drain(one)[-1] == WRONG + 399
    # what the other says now is of the past, and holds up nothing
    assert see(one, "early", 500.0)
    assert see(one, "late", WRONG + 400)
    assert drain(one) == [WRONG + 400]


def test_two_wild_jumps_while_the_others_pause_are_not_followed() -> None:
    one = start(a=0.0, b=0.0)
    assert not see(one, "a", WRONG)
    assert not see(one, "a", 2 * WRONG)
    assert not see(one, "a", 3 * WRONG)
    assert see(one, "b", 1.0)


def test_one_that_was_followed_and_crashed_far_behind_holds_up_nobody() -> None:
    one = start(a=0.0, b=0.0)
    one.presence("c", True)
    see(one, "c", 0.0)
    for second in range(1, 200):
        see(one, "a", float(second))
        see(one, "b", float(second))
        steps = drain(one)
    assert steps == [199.0]


def test_many_names_and_messages_cost_little() -> None:
    one = clock()
    one.presence("radar", True)
    tracemalloc.start()
    begin = process_time()
    for k in range(5_000):
        see(one, f"name{k}", k * 4e-4)
        one.due()
    assert see(one, "radar", 2.0)
    for k in range(20_000):
        see(one, "radar", 2.0 + k * 5e-5)
    assert process_time() - begin < 6
    assert tracemalloc.get_traced_memory()[0] < 2_000_000
    tracemalloc.stop()
    assert drain(one) == [0.0, 1.0]


class Paces:
    """Who is silent, as operating.md says: a source that has not gone on for three times its usual pace, by the time of
    reception. Without such a time that goes on with the newest message, by a period at most from one to the next. The
    pace is the longest of its usual gaps, of which it forgets a tenth with each message that comes sooner; of who was
    heard once, or has only its token, half of `lateness`. Who falls back by more than `lateness` is silent too."""

    def __init__(self, names: str, period: float, lateness: float) -> None:
        self.period, self.lateness = period, lateness
        self.now, self.newest_of_all = 0.0, -1.0
        self.newest: dict[str, float] = {}
        self.heard = dict.fromkeys(names, 0.0)
        self.pace = dict.fromkeys(names, lateness / 2)
        self.back: set[str] = set()

    def says(self, name: str, time: float) -> None:
        if self.newest_of_all >= 0:
            self.now += min(max(time - self.newest_of_all, 0.0), self.period)
        self.newest_of_all = max(self.newest_of_all, time)
        before = self.newest.get(name)
        if before is not None and time < before - self.lateness:
            self.back.add(name)
        if before is None or time > before:
            if before is not None:
                self.pace[name] = max(self.now - self.heard[name], 0.9 * self.pace[name])
            self.heard[name] = self.now
            self.back.discard(name)
        self.newest[name] = max(time, self.newest.get(name, 0.0))

    def silent(self, name: str) -> bool:
        return name in self.back or self.now - self.heard[name] > 3.0 * self.pace[name] - 1e-6


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 40)), min_size=1, max_size=40))
def test_steps_are_on_the_grid_grow_and_never_pass_the_front_nor_stay_behind_all(
    messages: list[tuple[str, int]],
) -> None:
    one = clock()
    for name in "abc":
        one.presence(name, True)
    steps: list[float] = []
    paces = Paces("abc", 1.0, 3.0)
    newest = paces.newest
    for name, halves in messages:
        see(one, name, halves / 2)
        paces.says(name, halves / 2)
        new = drain(one)
        front = max(newest.values())
        for time in new:
            # who is silent, or will be too late, is not waited for
            said = [newest.get(other, -1) for other in "abc" if not paces.silent(other)]
            assert all(one >= time or 0 <= one < time - 3.0 - 1.0 for one in said) or front > time + 3.0
        steps += new
        assert steps == sorted(set(steps))
        if steps:
            following = steps[-1] + 1.0
            assert following > min(newest.get(other, -1) for other in "abc")
            assert min(newest.values()) <= following + 3.0
    assert all(time == int(time) for time in steps)


def test_the_wall_clock_steps_on_its_grid_behind_now_and_skips_what_was_slept_through() -> None:
    one = WallClock(CentreConfig(period=1.0, delay=0.5))
    assert one.due(START) is None
    assert one.due(START + SECOND // 4) is None
    assert one.due(START + SECOND // 2) == START
    assert one.wait(START + SECOND // 2) == 1.0
    assert one.due(START + 10 * SECOND) == START + 9 * SECOND
    assert one.skipped == 8


def fed(of: MessageClock, *messages: tuple[str, float]) -> list[bool]:
    taken = []
    for name, at in messages:
        taken.append(see(of, name, at))
        drain(of)
    return taken


def test_a_lone_source_that_falls_back_is_refused_while_it_happens() -> None:
    one = start(feed=0.0)
    assert all(fed(one, *(("feed", float(k)) for k in range(1, 60))))
    back = fed(one, *(("feed", k - 86400.0) for k in range(60, 120)))
    assert back == [True] * one.FEW + [False] * (60 - one.FEW)
    # right again: it is followed at once
    assert fed(one, ("feed", 120.0)) == [True]
    assert drain(one) == []
    see(one, "feed", 121.0)
    assert drain(one) == [121.0]


def test_where_everybody_falls_back_for_the_lead_steps_begin_again_from_there() -> None:
    one = start(a=0.0, b=0.0)
    fed(one, *((name, float(k)) for k in range(1, 60) for name in "ab"))
    lead = 60 + 3 + 10
    steps = []
    for k in range(60, 60 + lead + 20):
        for name in "ab":
            see(one, name, k - 86400.0)
        steps += drain(one)
    assert steps == [float(k) - 86400 for k in range(60 + lead, 60 + lead + 20)]
    assert all(fed(one, ("a", 200 - 86400.0), ("b", 200 - 86400.0)))


def test_one_of_two_that_falls_back_changes_nothing() -> None:
    one = start(a=0.0, b=0.0)
    for k in range(1, 130):
        assert see(one, "a", float(k))
        assert see(one, "b", k - 86400.0 if k >= 60 else float(k))
        assert all(step >= k - 4 for step in drain(one))


def test_the_reason_is_late_or_future() -> None:
    one = start(feed=100.0)
    one.presence("other", True)
    messages = [tracks("feed", second, np.zeros((0, 4)), seq=0) for second in (1.0, 2.0, 3.0, 4.0, 101.0)]
    faults = [one.fault(message, START + 10**6 * SECOND) for message in messages]
    assert faults == ["", "", "", "late", ""]
    assert one.fault(messages[-1], START) == "future"
    assert one.fault(tracks("other", WRONG, np.zeros((0, 4)), seq=0), START + 10**7 * SECOND) == "future"


def test_another_centre_is_waited_for_only_where_nobody_else_is() -> None:
    """Two centres that exchange their pictures would wait for each other; one above others has nobody else."""
    one = clock()
    for name in ("radar", "global/B"):
        one.presence(name, True)
    assert see(one, "global/B", 1.0)
    assert see(one, "radar", 2.0)
    assert drain(one) == [1.0, 2.0]
    top = clock()
    for name in ("global/A", "global/B"):
        top.presence(name, True)
    assert see(top, "global/A", 2.0)
    assert drain(top) == []
    assert see(top, "global/B", 2.0)
    assert drain(top) == [2.0]
