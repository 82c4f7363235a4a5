"""What status and step log say of tracklets, in words; whatever a status may hold."""

from __future__ import annotations

import math
from typing import Any

import pytest

from fusion_service.centre.watch import UNTRUE, WATCHED
from fusion_service.ways import REASONS, fused_by, innovations, no_tracklets, reason_words, tracklet_health
from tests.helpers.missions import picture


def said(ratio: float, share: float = 1.0, why: str = "") -> dict[str, Any]:
    bounds = {"innovation_low": 0.85, "innovation_high": 1.15}
    return {"tracklets": share, "no_tracklets": why, "innovation": ratio, **bounds}


def test_every_reason_of_the_watch_has_words() -> None:
    assert {*WATCHED, *UNTRUE, "space"} - {""} == set(REASONS)


@pytest.mark.parametrize(
    ("ratio", "words"), [(1.0, ""), (0.86, ""), (1.2, "too large"), (3.0, "too large"), (0.5, "too small")]
)
def test_innovations_beyond_their_bounds_say_what_that_means(ratio: float, words: str) -> None:
    text = innovations(said(ratio))
    assert text.startswith(f"innovations {ratio:.2f}, right within 0.85 to 1.15")
    assert (words in text) if words else "too" not in text


def test_inflated_increments_and_reasons_are_told() -> None:
    assert tracklet_health(said(1.25)).startswith("100 % of its new versions taken as tracklets; each counts 80 %; ")
    assert "counts" not in tracklet_health(said(1.1))
    text = tracklet_health(said(2.5, share=0.25, why="innovations"))
    assert text.startswith(f"no tracklets: {reason_words('innovations')}; innovations 2.50")
    assert tracklet_health({"alive": True}) == ""


def test_an_event_is_a_sentence() -> None:
    assert no_tracklets({"why": "", "ratio": 1.0}) == "its tracks are taken as tracklets"
    assert "2.41" in no_tracklets({"why": "innovations", "ratio": 2.41})
    assert no_tracklets({"why": "feedback", "ratio": math.nan}) == "no tracklets: its tracker is fed with fused tracks"


@pytest.mark.parametrize("value", [None, "x", math.nan, math.inf, True, [1.0], b"1", {}])
def test_a_status_of_anybody_breaks_nothing(value: Any) -> None:
    names = ("tracklets", "no_tracklets", "innovation", "innovation_low", "innovation_high")
    whole = dict.fromkeys(names, value)
    assert isinstance(tracklet_health(whole), str)
    assert isinstance(no_tracklets({"why": value, "ratio": value}), str)
    assert len(no_tracklets({"why": "a" * 10**6})) < 200


def test_a_picture_without_ways_is_fused_by_its_rule() -> None:
    one = picture(1.0, [4, 5, 6], [(0, 0), (1, 0), (2, 0)])
    names, which = fused_by(one)
    assert [names[k] for k in which] == [one.rule] * 3
