"""The frame of the picture: as configured, or as the sources agree, then kept."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.centre.frames import Vote, agreed, convertible, outvoted
from fusion_service.geodesy import enu_to_geodetic, geodetic_to_enu
from tests.centre.worlds import FRAME, SPACE, centre, give, info, step, tracks, truth

OTHER = schemas.Enu(59.2, -55.3)
DOCK, YARD = schemas.Local("dock"), schemas.Local("yard")
SPOT = np.array([[1000.0, 2000.0, 0.0, 0.0]])


def speak(made: FusionCentre, second: int, **frames: schemas.Frame) -> Any:
    for name, frame in frames.items():
        give(made, tracks(name, second, SPOT, frame=frame))
    return step(made, second)


def told(result: Any) -> list[str]:
    return [event["source"] for event in result.log.events if event["kind"] == "frame"]


def test_where_all_that_were_heard_agree_it_is_taken_at_once_and_any_origin_on_the_earth_agrees() -> None:
    made = centre(("a", "b", "c"))
    result = speak(made, 1, a=OTHER, b=FRAME, c=FRAME)
    assert told(result) == ["b"]  # more sources speak in it
    assert result.tracks.frame == FRAME
    assert result.status.refused == {}
    assert result.tracks.contributor_counts.sum() == 3
    lat, lon, _ = enu_to_geodetic(1000.0, 2000.0, 0.0, OTHER)
    there = np.array(geodetic_to_enu(lat, lon, 0.0, FRAME)[:2])
    assert np.linalg.norm(result.tracks.means[:, :2] - there, axis=1).min() < 1.0


def test_where_they_differ_the_majority_is_taken_after_the_stated_time_and_the_other_told() -> None:
    made = centre(("a", "b", "c"), frame_wait=4.0)
    for second in range(1, 5):
        result = speak(made, second, a=DOCK, b=FRAME, c=FRAME)
        assert told(result) == []
        assert len(result.tracks.ids) == 0
        assert result.status.sources["b"]["unused"] == {"frame": second}
        assert "wait for the frame" in result.status.sources["b"]["note"]
    result = speak(made, 5, a=DOCK, b=FRAME, c=FRAME)
    assert told(result) == ["b"]
    assert result.tracks.frame == FRAME
    assert result.tracks.contributor_counts.tolist() == [2]
    assert result.status.refused == {"frame": 1}
    note = result.status.sources["a"]["note"]
    assert "'dock'" in note
    assert "frame under [centre]" in note


def test_they_may_come_to_agree_before() -> None:
    made = centre(("a", "b"), frame_wait=100.0)
    assert told(speak(made, 1, a=DOCK, b=FRAME)) == []
    assert told(speak(made, 2, a=FRAME, b=FRAME)) == ["a"]


def test_the_first_to_speak_does_not_decide_for_ever() -> None:
    made = centre(("a", "b", "c"), frame_wait=5.0)
    assert told(speak(made, 1, a=DOCK)) == ["a"]
    old = speak(made, 2, a=DOCK).tracks.ids.tolist()
    assert len(old) == 1
    for second in range(3, 8):
        result = speak(made, second, a=DOCK, b=FRAME, c=FRAME)
        assert result.tracks.frame == DOCK
        assert result.tracks.ids.tolist() == old
    result = speak(made, 8, a=DOCK, b=FRAME, c=FRAME)
    assert told(result) == ["b"]
    assert result.tracks.frame == FRAME
    assert (old[0], "frame", None) in result.tracks.ended
    assert old[0] not in result.tracks.ids.tolist()
    assert result.tracks.contributor_counts.tolist() == [2]
    # one against one changes nothing, nor does one of three that differs
    for second in range(9, 30):
        assert told(speak(made, second, a=DOCK, b=FRAME, c=FRAME if second < 15 else YARD)) == []


def test_a_short_dissent_changes_nothing() -> None:
    made = centre(("a", "b", "c"), frame_wait=5.0)
    speak(made, 1, a=FRAME)
    for second in range(2, 40):
        wrong = DOCK if second % 4 else FRAME
        assert told(speak(made, second, a=FRAME, b=wrong, c=wrong)) == []


def test_a_configured_frame_stands_whoever_speaks() -> None:
    made = centre(("a", "b"), frame={"kind": "enu", "lat": FRAME.lat, "lon": FRAME.lon}, frame_wait=1.0)
    for second in range(1, 10):
        result = speak(made, second, a=DOCK, b=DOCK)
        assert told(result) == []
        assert result.tracks.frame == FRAME
    assert result.status.refused == {"frame": 18}


def test_ecef_is_never_the_frame_of_a_flat_picture() -> None:
    made = centre(("a",))
    space = ("x", "y", "z", "vx", "vy", "vz")
    place = np.array([*np.ravel(truth(1)[:, :2]), 0.0, 0.0, 0.0, 0.0])
    message = dataclasses.replace(
        tracks("a", 1, truth(1)),
        space=space,
        frame=schemas.Ecef(),
        means=place[None],
        covariances=np.eye(6)[None] * 100,
    )
    give(made, message)
    result = step(made, 1)
    assert told(result) == []
    assert result.status.refused == {"frame": 1}
    assert "ECEF cannot be the frame of a picture in x y vx vy" in result.status.sources["a"]["note"]
    # but what is in it can be brought into another
    again = dataclasses.replace(message, time=message.time + 10**9, seq=2)
    give(made, again, tracks("b", 2, truth(1)), info("b"))
    result = step(made, 2)
    assert told(result) == ["b"]
    assert result.tracks.frame == FRAME
    assert sum(entry.source == "a" for entry in result.log.refused) == 0


def test_the_frame_and_the_time_of_asking_are_in_the_checkpoint() -> None:
    made = centre(("a", "b"), frame_wait=5.0)
    for second in (1, 2, 3):
        speak(made, second, a=DOCK, b=FRAME)
    made = FusionCentre(made.config, made.checkpoint())
    assert told(speak(made, 5, a=DOCK, b=FRAME)) == []
    assert told(speak(made, 6, a=DOCK, b=FRAME)) == ["a"]
    made = FusionCentre(made.config, made.checkpoint())
    assert speak(made, 7, a=DOCK).tracks.frame == DOCK


@pytest.mark.parametrize(
    ("frames", "wanted", "support"),
    [
        ([DOCK, YARD, YARD], YARD, 2),
        ([DOCK, YARD], DOCK, 1),
        ([FRAME, DOCK, OTHER, DOCK, YARD], DOCK, 2),
        ([FRAME, DOCK, OTHER, OTHER, DOCK], OTHER, 3),
        ([], None, 0),
    ],
)
def test_agreed(frames: list[schemas.Frame], wanted: schemas.Frame | None, support: int) -> None:
    votes = {f"s{k}": Vote(frame, SPACE, 0) for k, frame in enumerate(frames)}
    assert agreed(votes, SPACE) == (wanted, support)


def test_outvoted_needs_more_than_half_that_agree() -> None:
    def votes(*frames: schemas.Frame) -> dict[str, Vote]:
        return {f"s{k}": Vote(frame, SPACE, 0) for k, frame in enumerate(frames)}

    assert outvoted(votes(FRAME, DOCK), SPACE, FRAME) is None
    assert outvoted(votes(FRAME, DOCK, YARD), SPACE, FRAME) is None
    assert outvoted(votes(FRAME, DOCK, DOCK), SPACE, FRAME) == DOCK
    assert outvoted(votes(OTHER, FRAME, DOCK), SPACE, FRAME) is None
    assert convertible(Vote(OTHER, SPACE, 0), FRAME)
    assert convertible(Vote(OTHER, SPACE, 0), schemas.Ecef())  # with a height that takes in all that flies
    assert not convertible(Vote(OTHER, ("x", "y", "vx"), 0), schemas.Ecef())
