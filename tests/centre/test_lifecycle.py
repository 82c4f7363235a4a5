"""A track that sources drop which judge existence ends; one whose sources are silent, or list it no more, coasts."""

from __future__ import annotations

from collections.abc import Container
from typing import Any

import numpy as np
import pytest

from fusion_service.centre import FusionCentre
from schemas.messages import COASTING, CONFIRMED
from tests.centre.worlds import centre, give, info, step, tracks
from tests.helpers.strategies import Array

PLACES = np.array([[0.0, 0.0, 10.0, 0.0], [0.0, 4000.0, 10.0, 0.0]])


def truth(second: float) -> Array:
    return PLACES + second * np.array([[10.0, 0, 0, 0]] * 2)


def until_gone(
    made: FusionCentre,
    sources: dict[str, float],
    drops: float,
    every: float = 1.0,
    judging: Container[str] | None = None,
) -> tuple[float, Any]:
    """How long after `drops`, s, the second target is in the picture, of which each source (name -> period, s) lists
    only the first from then on; and the statuses that it had. judging: those that report existence, None: all."""
    give(made, *(info(name, period=period) for name, period in sources.items()))
    statuses: list[int] = []
    sent = dict.fromkeys(sources, 0.0)
    for count in range(1, 80):
        second = count * every
        for name, period in sources.items():
            while sent[name] + period <= second:
                sent[name] += period
                shown = 1 if sent[name] > drops else 2
                judged = np.full(shown, 0.95) if judging is None or name in judging else None
                seq = round(1000 * sent[name])
                give(made, tracks(name, sent[name], truth(sent[name])[:shown], seq=seq, existence=judged))
        picture = step(made, second).tracks
        second_one = picture.status[picture.means[:, 1] > 2000.0]
        statuses += second_one.tolist()
        if second > drops and not len(second_one):
            return second - drops, statuses
    raise AssertionError("it does not end")


@pytest.mark.parametrize("period", [1.0, 2.0, 4.0])
def test_what_its_source_drops_ends_after_the_next_report(period: float) -> None:
    """Whatever `coast` is: the scan without it comes a period later, the next one after another."""
    for coast in (5.0, 60.0):
        gone, statuses = until_gone(centre((), coast=coast), {"r1": period}, 20.0)
        assert 2 * period < gone <= 2.5 * period + 1.0, f"coast {coast}: {gone} s"
        assert CONFIRMED in statuses
        assert COASTING in statuses


@pytest.mark.parametrize("sources", [{"r1": 1.0}, {"r1": 0.5, "r2": 1.0}])
@pytest.mark.parametrize("coast", [3.0, 8.0])
def test_what_lists_of_what_is_seen_hold_no_more_coasts(sources: dict[str, float], coast: float) -> None:
    """A source that reports no existence lists what it sees, which is no word on what there is."""
    gone, statuses = until_gone(centre((), coast=coast), sources, 20.0, judging=())
    assert coast < gone <= coast + 2.5, f"{gone} s"
    assert statuses[-1] == COASTING


def test_the_word_of_the_last_to_drop_it_counts() -> None:
    """Of two, one judges existence."""
    sources = {"first": 0.5, "last": 4.0}
    assert until_gone(centre((), coast=30.0), sources, 20.0, judging=("last",))[0] <= 11.0
    assert until_gone(centre((), coast=30.0), sources, 20.0, judging=("first",))[0] > 30.0


def test_the_last_of_two_sources_to_drop_it_decides() -> None:
    gone, _ = until_gone(centre((), coast=30.0), {"fast": 0.5, "slow": 4.0}, 20.0)
    assert 8.0 < gone <= 11.0
    alone, _ = until_gone(centre((), coast=30.0), {"fast": 0.5}, 20.0)
    assert alone <= 2.0


def test_how_often_the_centre_steps_changes_little() -> None:
    often = [until_gone(centre((), coast=30.0, period=every), {"r1": 2.0}, 20.0, every)[0] for every in (0.5, 1.0)]
    assert abs(often[0] - often[1]) <= 1.0


def test_what_is_dropped_and_listed_again_in_the_next_report_keeps_its_number() -> None:
    """Under another id of the source's, as trackers do that start anew."""
    made = centre((), coast=30.0)
    give(made, info("r1", period=2.0))
    seen = set()
    for second in range(1, 41):
        if second % 2 == 0:
            ids = [1, 2] if second < 20 else [1] if second == 20 else [1, 3]
            judged = np.full(len(ids), 0.95)
            give(made, tracks("r1", second, truth(second)[: len(ids)], ids, existence=judged))
        seen |= set(step(made, second).tracks.ids.tolist())
    assert len(seen) == 2


@pytest.mark.parametrize("renamed", [False, True], ids=["same ids", "new ids"])
def test_sources_silent_for_four_seconds_of_twenty_lose_nothing(renamed: bool) -> None:
    """renamed: after each silence the source's tracks have other ids, and it lists only those."""
    made = centre((), coast=5.0)
    give(made, info("r1"), info("r2"))
    seen: set[int] = set()
    for second in range(1, 101):
        if second % 20 not in (10, 11, 12, 13):
            ids = np.array([1, 2]) + (10 * ((second + 6) // 20) if renamed else 0)
            for name in ("r1", "r2"):
                give(made, tracks(name, second, truth(second), ids))
        picture = step(made, second).tracks
        assert len(picture.ids) == 2
        seen |= set(picture.ids.tolist())
    assert len(seen) == 2


def test_a_source_that_goes_still_is_silent_even_where_its_tracks_go_stale_first() -> None:
    made = centre((), coast=10.0, stale_periods=1.0)
    give(made, info("r1", period=2.0))
    there = []
    for second in range(1, 40):
        if second % 2 == 0 and second <= 20:
            give(made, tracks("r1", second, truth(second)))
        there.append(len(step(made, second).tracks.ids))
    # fresh until 22 s, stale then: overdue at 22 s, by the last step that had it, and gone `coast` later
    assert there[30] == 2
    assert there[-1] == 0
