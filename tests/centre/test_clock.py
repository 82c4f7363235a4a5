"""When to step: the message clock is run against a plain statement of its rule."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import SECOND, START

from fusion_service.clock import MessageClock, WallClock
from fusion_service.config import CentreConfig


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


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 40)), min_size=1, max_size=40))
def test_steps_are_on_the_grid_grow_and_never_pass_the_front(messages: list[tuple[str, int]]) -> None:
    one = clock()
    for name in "abc":
        one.presence(name, True)
    steps: list[float] = []
    newest: dict[str, float] = {}
    for name, halves in messages:
        see(one, name, halves / 2)
        newest[name] = max(newest.get(name, 0.0), halves / 2)
        new = drain(one)
        front = max(newest.values())
        for time in new:
            assert all(newest.get(other, -1) >= time for other in "abc") or front > time + 3.0
        steps += new
        assert steps == sorted(set(steps))
        if steps:
            following = steps[-1] + 1.0
            assert following > min(newest.get(other, -1) for other in "abc")
            assert front <= following + 3.0
    assert all(time == int(time) for time in steps)


def test_the_wall_clock_steps_on_its_grid_behind_now_and_skips_what_was_slept_through() -> None:
    one = WallClock(CentreConfig(period=1.0, delay=0.5))
    assert one.due(START) is None
    assert one.due(START + SECOND // 4) is None
    assert one.due(START + SECOND // 2) == START
    assert one.wait(START + SECOND // 2) == 1.0
    assert one.due(START + 10 * SECOND) == START + 9 * SECOND
    assert one.skipped == 8
