"""What of a mission can be scored, and what is told where nothing can."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from fusion_service.review.evaluation import evaluate, format_table
from fusion_service.review.evaluation.logbook import Logbook
from schemas import Local, Message
from tests.helpers.missions import FRAME, STILL, at, info, picture, still, tracks, truth


def test_what_cannot_be_scored_is_left_out_by_name() -> None:
    mission = [*still(3), info("dock"), info("flat"), tracks("dock", 1, [1], STILL, frame=Local("dock"))]
    result = evaluate(mission, c=10.0, every=1.0)
    assert result.left_out == {"dock": "the local frame 'dock' has no known relation to ENU about 60 10 0"}
    assert "not scored: dock: the local frame" in format_table(result)
    assert result.as_json("", "", "")["scored"]["left_out"] == result.left_out
    high = [truth(t, [1], [], means=np.zeros((1, 3)), space=("x", "y", "z")) for t in range(4)]
    result = evaluate([*high, *still(3)[4:], tracks("flat", 1, [1], STILL)], c=10.0, every=1.0)
    assert list(result.sources) == ["flat"]
    deep = [picture(t, [1], [], means=np.zeros((1, 3)), space=("x", "y", "z")) for t in range(4)]
    result = evaluate([*high, *deep, tracks("flat", 1, [1], STILL)], c=10.0, every=1.0)
    assert result.left_out == {"flat": "its tracks have no z (their space: x vx y vy)"}
    assert result.fused.gospa == 0.0


def test_without_a_centre() -> None:
    mission = [m for m in still(3) if m.source == "world"] + [info("a"), tracks("a", 0, [1], STILL)]
    result = evaluate(mission, c=10.0, every=1.0, frame=FRAME, space=("x", "y"))
    assert result.fused.gospa == pytest.approx(np.sqrt(50.0))
    assert result.sources["a"].gospa == 0.0
    assert "fused (no centre)" in format_table(result)
    json.dumps(result.as_json("s", "r", "f"), allow_nan=False)


@pytest.mark.parametrize(
    ("mission", "says"),
    [
        ([picture(0, [1], STILL)], "no truth"),
        ([truth(0, [1], STILL)], "frame, space and every must be given"),
        ([truth(0, [1], STILL), picture(5, [1], STILL)], "no time to score"),
        ([truth(0, [1], STILL), picture(0, [1], STILL), picture(0, [1], STILL, centre="b")], "several centres"),
        ([truth(0, [1], STILL), picture(0, [], [], means=np.zeros((0, 3)), space=("x", "y", "z"))], "truth has no z"),
    ],
)
def test_nothing_to_score(mission: list[Message], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        evaluate(mission, c=10.0, every=None)


def test_a_wrong_clock_does_not_ask_for_a_billion_times() -> None:
    far: list[Message] = [truth(0, [1], STILL), truth(1e9, [1], STILL), picture(0, [1], STILL)]
    with pytest.raises(ValueError, match=r"1000000000 times every 1 s: a clock is wrong, or every"):
        evaluate(far, c=10.0, every=1.0)


def test_truth_that_is_no_number_is_no_target() -> None:
    mission = still(3)
    broken = truth(2, [2], [], means=np.array([[0.0, 0.0, np.nan, 0.0]]))
    result = evaluate([*mission, broken], c=10.0, every=None)
    assert result.exists.tolist() == [[True, False]] * 4


def test_one_of_several_centres() -> None:
    other = [picture(t, [1], [[3.0, 0.0]], centre="other") for t in range(4)]
    assert evaluate([*still(3), *other], c=10.0, every=None, centre="other").fused.rmse_position == pytest.approx(3.0)
    with pytest.raises(ValueError, match="no tracks of a centre 'x' \\(there are: centre, other\\)"):
        evaluate([*still(3), *other], c=10.0, every=None, centre="x")
    with pytest.raises(ValueError, match="must be positive"):
        evaluate(still(3), c=10.0, every=0.0)


def test_a_mission_whose_first_picture_has_no_frame_is_scored_in_that_of_the_next() -> None:
    """A centre that knows no frame yet says an empty picture in a local frame "none"."""
    nothing = [picture(t, [], [], frame=Local("none")) for t in (0, 1)]
    later = [truth(t, [1], STILL) for t in range(6)] + [picture(t, [1], [[3.0, 0.0]]) for t in range(2, 6)]
    result = evaluate([*nothing, *later], c=10.0, every=None)
    assert len(result.times) == 6
    assert np.isnan(result.fused.errors[:2, 0]).all()
    assert result.fused.rmse_position == pytest.approx(3.0)


def test_one_wrong_clock_does_not_make_the_mission_begin_in_1970() -> None:
    wrong = [replace(tracks("b", t, [1], STILL), time=t) for t in range(3)]
    assert Logbook([*still(3), *wrong]).span == (at(0), at(3))
    assert Logbook([]).span is None
