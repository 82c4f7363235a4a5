"""Who moves the clock of the messages: liars ahead and behind, made-up names, sources that fall silent.

Each mission is played in the order of reception, at ten times its own speed, into the clock alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping

import pytest

from fusion_service.centre import MessageClock
from fusion_service.config import CentreConfig, SourceConfig
from tests.centre.worlds import SECOND, START

LATENESS = 5.0
LEAD = MessageClock.LEAD + LATENESS + 10
HONEST = ("a", "b")
Claim = Callable[[float], float | None]


def right(at: float) -> float:
    return at


def off(seconds: float, since: float = 0.0) -> Claim:
    return lambda at: at + seconds if at >= since else at


class Play:
    """A clock fed by sources {name: what it says at a time, None for nothing}, each once a second."""

    def __init__(self, named: Iterable[str] = (), authenticated: bool = False) -> None:
        sources = {name: SourceConfig() for name in named}
        self.clock = MessageClock(CentreConfig(period=1.0, lateness=LATENESS, sources=sources), authenticated)
        self.there: set[str] = set()
        self.refused: dict[str, int] = {}
        self.late: dict[str, int] = {}
        self.last = -1e5

    def run(self, claims: Mapping[str, Claim], begin: int, end: int) -> Iterator[tuple[float, float]]:
        """(time of the mission, time of the newest step) after every message."""
        for name in set(claims) - self.there:
            self.clock.presence(name, True)
            self.there.add(name)
        for second in range(begin, end):
            for place, (name, claim) in enumerate(claims.items()):
                at = second + place / 10 / len(claims)
                said = claim(at)
                if said is None:
                    continue
                received = START + 10**6 * SECOND + round(at / 10 * SECOND)
                time = START + round(said * SECOND)
                if not self.clock.observe(name, 1, time, received):
                    self.refused[name] = self.refused.get(name, 0) + 1
                elif said < self.last - LATENESS:
                    self.late[name] = self.late.get(name, 0) + 1
                while (due := self.clock.due()) is not None:
                    assert due > START + self.last * SECOND
                    self.last = (due - START) / SECOND
                yield at, self.last

    def check(self, claims: Mapping[str, Claim], begin: int, end: int, behind: float, settled: int = 10) -> None:
        """The clock is never ahead of the mission, and after `settled` seconds no further behind than that."""
        for at, last in self.run(claims, begin, end):
            assert last <= at + 1e-9
            assert last >= at - behind or at < begin + settled
        assert not set(HONEST) & (set(self.late) | set(self.refused))


def honest(*names: str) -> dict[str, Claim]:
    return dict.fromkeys(names or HONEST, right)


@pytest.mark.parametrize("named", [(), ("a", "b", "c")], ids=["open", "named"])
@pytest.mark.parametrize("wrong", [18.0, 60.0, 3600.0, -4.0, -18.0, -60.0, -100.0, -3600.0])
def test_one_of_three_moves_the_clock_for_nobody(named: tuple[str, ...], wrong: float) -> None:
    Play(named).check({**honest(), "c": off(wrong)}, 0, 200, behind=6.0 if -LATENESS < wrong < 0 else 2.0)


@pytest.mark.parametrize("wrong", [18.0, 3600.0])
def test_one_of_three_that_jumps_moves_the_clock_for_nobody(wrong: float) -> None:
    Play().check({"c": off(wrong, since=50.0), **honest()}, 0, 150, behind=2.0)


@pytest.mark.parametrize("wrong", [18.0, 3600.0])
def test_of_two_the_earlier_is_followed(wrong: float) -> None:
    Play().check({"c": off(wrong), "a": right}, 0, 150, behind=2.0)


@pytest.mark.parametrize("ahead", [6.0, 18.0, 70.0, 3600.0])
def test_four_names_of_one_intruder_do_not_take_an_open_bus_ahead(ahead: float) -> None:
    play = Play()
    play.check(honest(), 0, 20, behind=2.0)
    play.check(honest() | {f"x{k}": off(ahead) for k in range(4)}, 20, 400, behind=2.0)


@pytest.mark.parametrize("behind", [6.0, 18.0, 36.0, 50.0, 74.0, 76.0, 100.0, 3600.0])
@pytest.mark.parametrize("named", [(), HONEST])
def test_four_names_far_behind_refuse_nobody(behind: float, named: tuple[str, ...]) -> None:
    """On an open bus a majority that is behind is followed as long as it is not too far; what the others say waits."""
    play = Play(named)
    play.check(honest(), 0, 20, behind=2.0)
    claims = honest() | {f"x{k}": off(-behind) for k in range(4)}
    play.check(claims, 20, 400, behind=2.0 if named else min(behind, LEAD) + 2.0)


@pytest.mark.parametrize("pace", [1.1, 1.5, 3.0])
def test_names_that_are_honest_first_take_it_ahead_by_the_lead_at_most_and_not_for_good(pace: float) -> None:
    """On an open bus a majority that hurries by small steps is followed for as long as it is not too far ahead."""
    play = Play()
    claims = honest() | {f"x{k}": lambda at: at + max(0.0, at - 30.0) * (pace - 1) for k in range(4)}
    ahead = [last - at for at, last in play.run(claims, 0, 1200)]
    assert LATENESS < max(ahead) <= LEAD + 1.0
    assert -3.0 < ahead[-1] <= 0.0
    before = play.late.copy()
    list(play.run(claims, 1200, 1250))
    assert play.late == before


@pytest.mark.parametrize("also", [off(-50.0), off(0.0), lambda at: at + 0.5 * max(0.0, at - 30)])
@pytest.mark.parametrize("authenticated", [False, True])
def test_who_is_not_named_has_no_say(also: Claim, authenticated: bool) -> None:
    """Where others have, and certificates do not say who is who."""
    play = Play(HONEST, authenticated)
    claims = {f"x{k}": also for k in range(4)} | honest()
    if not authenticated:
        play.check(claims, 0, 200, behind=2.0)
    else:
        list(play.run(claims, 0, 200))
        assert also(199.0) == 199.0 or abs(play.last - 199.0) > 4.0


def test_where_none_of_the_named_is_there_the_others_move_the_clock() -> None:
    play = Play(("gone",))
    play.check(honest(), 0, 100, behind=2.0)
    play.check(honest() | {"gone": right}, 100, 120, behind=2.0)
    play.check(honest(), 120, 300, behind=2.0, settled=30)


def test_one_that_falls_silent_with_its_token_holds_up_nobody() -> None:
    for count in (1, 2, 3):
        play = Play()
        claims = honest() | {f"s{k}": lambda at: at if at < 60 else None for k in range(count)}
        play.check(claims, 0, 200, behind=2.0, settled=90)


def test_one_that_repeats_one_time_for_ever_is_silent() -> None:
    Play().check({"s": lambda at: min(at, 60.0), "a": right}, 0, 200, behind=2.0, settled=90)


def test_a_token_without_messages_holds_up_nobody() -> None:
    play = Play()
    for k in range(20):
        play.clock.presence(f"ghost{k}", True)
    play.check(honest(), 0, 300, behind=1.5, settled=250)


def test_a_pause_of_the_whole_mission_is_passed() -> None:
    """All jump by ten minutes, one after the other."""
    play = Play()
    claims = {name: off(600.0, since=60.0 + place) for place, name in enumerate("abc")}
    steps = dict(play.run(claims, 0, 100))
    assert max(last for at, last in steps.items() if at < 60) <= 60
    assert min(last for at, last in steps.items() if at > 70) >= 668
    assert set(play.refused) <= {"a"}


def test_a_slow_source_is_waited_for_and_does_not_slow_the_others() -> None:
    claims: dict[str, Claim] = {"a": right}
    for k in range(3):  # every ten seconds
        claims[f"slow{k}"] = lambda at, k=k: at if int(at) % 10 == 3 * k else None  # type: ignore[misc]
    Play().check(claims, 0, 400, behind=LATENESS + 1.0, settled=50)


@pytest.mark.parametrize("named", [(), ("a", "sparse")])
def test_a_sparse_source_does_not_slow_the_other(named: tuple[str, ...]) -> None:
    """A report every hundred seconds, and a few of them in a row at times."""
    claims: dict[str, Claim] = {"a": right, "sparse": lambda at: at if int(at) % 100 < 1 + int(at) // 500 % 2 else None}
    Play(named).check(claims, 0, 500, behind=LATENESS + 1.0, settled=250)
    Play(named).check(claims, 0, 1500, behind=15.0, settled=250)


def test_a_source_that_catches_up_is_waited_for_again() -> None:
    play = Play()
    claims = honest("a", "b") | {"c": lambda at: at if at < 50 or at >= 100 else None}
    list(play.run(claims, 0, 130))
    assert not play.late | play.refused
    before = play.last
    assert before == 129.0
    play.clock.observe("a", 1, START + 130 * SECOND, START + 10**6 * SECOND + 13 * SECOND)
    play.clock.observe("b", 1, START + 130 * SECOND, START + 10**6 * SECOND + 13 * SECOND)
    assert play.clock.due() is None
    play.clock.observe("c", 1, START + 130 * SECOND, START + 10**6 * SECOND + 13 * SECOND)
    assert play.clock.due() == START + 130 * SECOND
