"""When a source and each of its tracks is stale: by the interval of each, measured, and by lateness.

The measured interval is compared with a plain loop over the reports, one by one.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion_service.centre import FusionCentre, StepResult
from fusion_service.centre.intervals import NOTHING_REMEMBERED, Pace, Remembered, follow, intervals, remember
from tests.centre.worlds import SECOND, START, centre, info, step, tracks

PACE = Pace(5 * SECOND, SECOND, 600 * SECOND)


def report(made: FusionCentre, source: str, second: float, ids: list[int], **more: Any) -> None:
    """Tracks that stand still 1 km apart, as they come 0.1 s later."""
    means = np.array([[1000.0 * one, 0.0, 0.0, 0.0] for one in ids]).reshape(-1, 4)
    late = more.pop("late", 0.1)
    message = tracks(source, second, means, ids, seq=round(second * 10), **more)
    made.handle(message, START + round((second + late) * SECOND))


def fed(result: StepResult) -> set[int]:
    """The local ids that feed the picture."""
    return set(result.tracks.contributor_id.tolist())


reports = st.lists(st.tuples(st.integers(1, 4), st.integers(0, 900)), max_size=40)


@settings(max_examples=200, deadline=None)
@given(reports, st.dictionaries(st.integers(1, 4), st.tuples(st.integers(0, 300), st.integers(1, 600)), max_size=4))
def test_intervals_are_those_of_reports_taken_one_by_one(
    batch: list[tuple[int, int]], before: dict[int, tuple[int, int]]
) -> None:
    ids = np.array([one for one, _ in batch], dtype=np.uint64)
    times = np.array([at * SECOND for _, at in batch], dtype=np.int64)
    known = Remembered(
        np.array(sorted(before), dtype=np.uint64),
        np.array([before[one][0] * SECOND for one in sorted(before)], dtype=np.int64),
        np.array([before[one][1] * SECOND for one in sorted(before)], dtype=np.int64),
        np.zeros(len(before), dtype=np.uint64),
    )
    out = intervals(ids, times, known, PACE)
    for one in set(ids.tolist()):
        last, interval = before.get(one, (-1, -1))
        last, interval = last * SECOND, interval * SECOND if interval > 0 else PACE.first
        gaps = []
        for at in sorted(times[ids == one].tolist()):
            if last >= 0 and at > last:
                gaps.append(at - last)
            last = max(last, at)
        if len(times[ids == one]) > 8:
            continue  # only the last eight of one batch count
        for gap in gaps:
            interval = follow(interval, gap, PACE)
        assert set(out[ids == one].tolist()) == {interval}


def test_an_interval_rises_at_once_and_falls_by_halves_within_its_bounds() -> None:
    assert follow(2 * SECOND, 180 * SECOND, PACE) == 180 * SECOND
    assert follow(180 * SECOND, 2 * SECOND, PACE) == 91 * SECOND
    assert follow(SECOND, SECOND // 10, PACE) == SECOND
    assert follow(SECOND, 10_000 * SECOND, PACE) == 600 * SECOND


def test_what_is_remembered_is_bounded_in_time_and_number() -> None:
    gone = Remembered(
        np.arange(1, 101, dtype=np.uint64), np.arange(100), np.full(100, 7), np.zeros(100, dtype=np.uint64)
    )
    there = np.array([100], dtype=np.uint64)
    kept = remember(NOTHING_REMEMBERED, gone, there, oldest=10, most=50)
    assert kept.id.tolist() == list(range(50, 100))
    assert kept.time.tolist() == list(range(49, 99))
    nothing = remember(kept, gone.take(np.zeros(100, dtype=np.bool_)), there, oldest=10**9, most=50)
    assert nothing.id.tolist() == []


@pytest.mark.parametrize("period", [1.0, 10.0, 180.0])
def test_a_ship_at_anchor_and_a_ferry_by_one_receiver(period: float) -> None:
    """After its second report the anchored ship is there all the time; the lost ferry is gone within 30 s."""
    made = centre((), lateness=5.0)
    made.handle(info("ais", period=period), START)
    there, gone = [], None
    for t in range(1, 601):
        if t % 180 == 1:
            report(made, "ais", t, [1], complete=False)
        if t % 2 == 0 and t <= 300:
            report(made, "ais", t, [2], complete=False)
        ids = fed(step(made, t))
        if t >= 181:
            there.append(1 in ids)
        if t > 300 and gone is None and 2 not in ids:
            gone = t - 300
    assert all(there)
    assert len(there) == 420
    assert gone is not None
    assert gone <= 30


def test_a_fast_source_on_a_slow_link_has_its_tracks() -> None:
    made = centre((), lateness=5.0, rule="ci")
    made.handle(info("fast", period=0.1), START)
    results = []
    for k in range(1, 200):
        report(made, "fast", k / 10, [1], late=0.0)
        if k % 10 == 0 and k > 9:
            results.append(step(made, k / 10 + 0.9))
    assert all(fed(result) == {1} for result in results)
    assert len({one for result in results for one in result.tracks.ids.tolist()}) == 1
    assert results[-1].tracks.status.tolist() == [1]
    assert results[-1].status.sources["fast"]["unused"] == {}
    assert results[-1].status.sources["fast"]["note"] == ""


def test_a_source_of_which_nothing_is_said_has_its_period_measured() -> None:
    made = FusionCentre({"lateness": 5.0})
    missing = 0
    for t in range(1, 201):
        if t % 10 == 1:
            report(made, "radar", t, [1])
        result = step(made, t)
        missing += t > 2 and fed(result) != {1}
    assert missing == 0
    assert len(set(result.tracks.ids.tolist())) == 1
    assert result.tracks.ids.tolist() == [1]
    # and it is stale after three of its intervals, and lateness
    assert not step(made, 191 + 35).status.sources["radar"]["stale"]
    assert step(made, 191 + 35.1).status.sources["radar"]["stale"]


def test_what_is_stale_on_arrival_is_told_and_counted() -> None:
    made = centre((), lateness=2.0)
    made.handle(info("slow", period=0.1), START)
    report(made, "slow", 1, [1, 2])
    result = step(made, 3.5)
    assert fed(result) == set()
    assert result.status.sources["slow"]["unused"] == {"stale": 2}
    note = result.status.sources["slow"]["note"]
    assert "2.5 s old" in note
    assert "stale after 2.3 s" in note
    report(made, "slow", 4, [1, 2])
    assert step(made, 4.5).status.sources["slow"]["note"] == ""


def test_tracks_that_wait_for_info_or_for_a_later_step_are_told() -> None:
    made = FusionCentre({"max_future": 60.0, "rule": "ci"})
    report(made, "unknown", 1, [1, 2])
    made.handle(info("ahead"), START)
    report(made, "ahead", 5, [1], late=-4.0)
    sources = step(made, 1).status.sources
    assert sources["unknown"]["unused"] == {"waiting": 2}
    assert "sensor_info" in sources["unknown"]["note"]
    sources = step(made, 2).status.sources
    assert "3.0 s after the step" in sources["ahead"]["note"]
    assert sources["unknown"]["note"] == ""
    report(made, "ahead", 6, [1], late=-4.0)
    assert step(made, 6).status.sources["ahead"]["note"] == ""


@pytest.mark.parametrize("stale", [0.5, 20.0])
def test_stale_of_the_config_stands_above_what_is_measured(stale: float) -> None:
    made = FusionCentre({"lateness": 5.0, "sources": {"r1": {"stale": stale, "override": True}}})
    for t in range(1, 6):
        report(made, "r1", t, [1])
    assert fed(step(made, 5 + stale)) == {1}
    result = step(made, 5 + stale + 0.1)
    assert fed(result) == set()
    assert result.status.sources["r1"]["stale"]


def test_an_id_that_comes_back_after_it_is_forgotten_begins_anew() -> None:
    made = centre((), lateness=0.0, remember=60.0)
    made.handle(info("r1"), START)
    for t in (1, 41, 141, 145):
        report(made, "r1", t, [1], complete=False)
        step(made, t)
        if t == 41:
            assert fed(step(made, 130)) == {1}  # 40 s measured: stale after 120 s
            made.checkpoint()
    # 100 s, the longest gap that is measured, is above remember: capped there
    assert fed(step(made, 145 + 150)) == set()


@pytest.mark.parametrize(
    "cut", [pytest.param(150, marks=pytest.mark.slow), 185, pytest.param(300, marks=pytest.mark.slow)]
)
def test_intervals_and_what_is_remembered_are_in_the_checkpoint(cut: int) -> None:
    made = centre((), lateness=5.0)
    made.handle(info("ais"), START)
    other = None
    for t in range(1, 400):
        for one in (made, other) if other is not None else (made,):
            if t % 180 == 1:
                report(one, "ais", t, [1], complete=False)
            report(one, "ais", t, [3], complete=False)
            result = step(one, t)
        if t == cut:
            other = FusionCentre(made.config, made.checkpoint())
    assert other is not None
    assert other.checkpoint() == made.checkpoint()
    assert fed(result) == {1, 3}


def test_many_ids_that_come_and_go_are_remembered_within_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion_service.centre.align.MAX_TOTAL", 50_000)
    made = centre((), lateness=0.0, stale_periods=1.0)
    made.handle(info("r1"), START)
    rng = np.random.default_rng(2)
    for t in range(1, 12):
        ids = np.arange(t * 10_000, (t + 1) * 10_000)
        means = np.concatenate([rng.uniform(-1e7, 1e7, (10_000, 2)), np.zeros((10_000, 2))], axis=1)
        message = dataclasses.replace(tracks("r1", t, means, ids.tolist()), complete=False)
        made.handle(message, START + round((t + 0.1) * SECOND))
        step(made, t + 2.5 if t == 11 else t + 0.5)
    known = made._intake.sources["r1"].remembered
    assert len(known.id) == 50_000
    assert known.id.min() == 60_000 + 10_000
