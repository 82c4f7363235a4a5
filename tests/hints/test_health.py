"""What is wrong with a centre, by its status."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from fusion_service.hints.health import Row, health_of
from schemas import Status

NOW = 1_790_000_000 * 10**9
STATUS = Status(
    source="centre", epoch=1, seq=0, sent=NOW, time=NOW, step=3, uptime=5.0, rates={"messages": 4.0},
    queue={"waiting": 0, "capacity": 10, "high_water": 2}, refused={}, dropped={},
    sources={"a": {"alive": True, "stale": False, "messages": 5, "tracks": 2, "rate": 1.0, "declared_period": 1.0}},
    tracks={"confirmed": 2}, step_time={"mean": 0.01, "max": 0.02, "failed": 0.0, "skipped": 0.0},
)  # fmt: skip


def wrong(**said: Any) -> list[str]:
    return health_of(replace(STATUS, sources={"a": {**STATUS.sources["a"], **said}}), None, NOW).wrong


def test_nothing_is_wrong_where_all_is_well() -> None:
    health = health_of(STATUS, None, NOW)
    assert health.wrong == []
    assert any("a " in line and "1 a second of one every 1 s, 2 tracks" in line for line in health.lines)


@pytest.mark.parametrize(
    ("said", "reads"),
    [
        ({"alive": False}, "a: it is gone"),
        ({"stale": True}, "a: it is silent"),
        ({"last_refusal": {"reason": "late", "count": 3, "time": NOW, "said": "mend it"}}, "(late, 3 times): mend it"),
        ({"doubts": ["its period"]}, "a: its period"),
        ({"state": "out", "state_why": "it is off"}, "not trusted (out): it is off"),
        ({"alarms": ["stuck: for 60 s"]}, "a: stuck"),
    ],
)
def test_a_fault_of_a_source_is_named_with_it(said: dict[str, Any], reads: str) -> None:
    (one,) = wrong(**said)
    assert reads in one


def test_what_is_old_or_harmless_is_not_wrong() -> None:
    assert wrong(last_refusal={"reason": "late", "count": 3, "time": NOW - 10**12, "said": "mend it"}) == []
    assert wrong(last_refusal={"reason": "repeat", "count": 3, "time": NOW, "said": "mend it"}) == []
    assert wrong(last_refusal="nonsense", doubts=5, alarms="x", refused=[]) == []


def test_a_source_that_was_mended_is_well_and_was_wrong() -> None:
    def row(now: int, **more: Any) -> Row:
        last = {"reason": "late", "count": 3, "time": NOW - 20 * 10**9, "said": "mend it", **more}
        source = {**STATUS.sources["a"], "last_refusal": last}
        (found,) = health_of(replace(STATUS, sources={"a": source}), None, now).rows
        return found

    for more in ({}, {"well": NOW - 15 * 10**9}, {"well": NOW - 21 * 10**9}, {"well": "x"}):
        assert row(NOW, **more).faults == ("refused (late, 3 times): mend it",)
    mended = row(NOW, well=NOW - 10**9)
    assert (mended.faults, mended.state, mended.reason) == ((), "there", "")
    assert mended.more == ("well since; refused until 20 s ago (late, 3 times): mend it",)
    assert row(NOW, well=NOW, count=1).more == ("well since; refused until 20 s ago (late, once): mend it",)
    assert row(NOW + 41 * 10**9, well=NOW).more == ()


def test_a_centre_that_is_held_up_or_behind_is_wrong() -> None:
    assert "old" in health_of(STATUS, None, NOW + 10**10).wrong[0]
    steps = {**STATUS.step_time, "overload": 4.0, "failed": 2.0}
    said = health_of(replace(STATUS, step_time=steps), None, NOW).wrong
    assert ["behind" in said[0], "2 steps have failed" in said[1]] == [True, True]
