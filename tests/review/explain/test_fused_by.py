"""What a track was fused by, and whose tracks were no tracklets, told of a mission that the real centre flew."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fusion_service.recording.steps import Step
from fusion_service.review.explain import explanation, listing, read_mission, write_view
from fusion_service.review.explain.fused_by import SPELLS, FusedBy
from tests.helpers.flown import Flight, places, verified
from tests.helpers.missions import picture
from tests.helpers.tracklets import fly
from tests.recording.contents import texts

FED, ALONE = 6, 12


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Flight]:
    flight = fly(26, fed=FED, alone=ALONE)
    return flight.record(tmp_path_factory.mktemp("fused") / "mission.rrd"), flight


def by_step(flight: Flight) -> list[str]:
    """What the first track was fused by, step by step."""
    found = []
    for one in flight.steps:
        names = one.tracks.rules
        found.append(one.tracks.rule if names is None else names[one.tracks.track_rule[0]])  # type: ignore[index]
    return found


def test_the_story_says_from_when_to_when_a_track_was_fused_by_what(mission: tuple[Path, Flight]) -> None:
    path, flight = mission
    text = explanation(read_mission(path, track="1"))
    ways = by_step(flight)
    assert ways[0] == ways[-1] == "ci"
    assert set(ways) == {"ci", "tracklet"}
    last = max(k for k, way in enumerate(ways) if way == "tracklet")
    count = ways.count("tracklet")
    assert count == last, "without a break"
    assert re.search(rf"^1\.0-{last}\.0 +fused by tracklet, {count} steps$", text, re.M)
    assert re.search(r"^0\.0 +fused by ci, 1 step$", text, re.M)
    assert f"fused by tracklet in {count}, ci in {len(ways) - count}." in text
    assert f"fused by tracklet {100 * count / len(ways):.3g} %" in text.splitlines()[2]


def test_whose_tracks_are_no_tracklets_is_told_with_the_reason(mission: tuple[Path, Flight]) -> None:
    path, flight = mission
    (event,) = (one for step in flight.steps for one in step.log.events if one["kind"] == "tracklets")
    assert (event["source"], event["why"]) == ("r3", "feedback")
    words = "r3: no tracklets: its tracker is fed with fused tracks"
    text = explanation(read_mission(path, track="1"))
    assert re.search(rf"^{FED - 1}\.0 +{words}$", text, re.M)
    assert f"{words}." in text.splitlines()[-1]
    shown = listing(read_mission(path))
    total = Counter(
        (one.tracks.rule,) * 3 if one.tracks.rules is None else one.tracks.rules * 3 for one in flight.steps
    )
    share = 100 * total[("tracklet",) * 3] / total.total()
    assert f"fused by: tracklet {share:.3g} %, ci {100 - share:.3g} % of the steps of confirmed tracks" in shown
    assert f"{words} (since {FED - 1}.0 s)" in shown


def test_a_recording_of_one_track_says_what_it_is_fused_by(mission: tuple[Path, Flight], tmp_path: Path) -> None:
    path, _ = mission
    assert write_view(read_mission(path, track="2"), tmp_path / "one.rrd") > 0
    told = [line.partition("  ")[2] for line in texts(tmp_path / "one.rrd", "track") if "fused by" in line]
    assert told == ["centre: fused by tracklet", "centre: fused by ci"]


def test_a_replay_makes_the_ways_again(mission: tuple[Path, Flight]) -> None:
    verdict = verified(mission[0]).verdict
    assert verdict is not None
    assert (verdict.equal, verdict.first) == (26, None)


def test_a_mission_by_one_rule_says_nothing_of_ways(tmp_path: Path) -> None:
    flight = Flight({})
    places(flight, range(1, 6), lambda name, second: {1: (0.0, 0.0)})
    path = flight.record(tmp_path / "plain.rrd")
    assert "fused by" not in explanation(read_mission(path, track="1"))
    assert "fused by" not in listing(read_mission(path))


def test_many_spells_are_told_as_one_of_each_way() -> None:
    told = FusedBy()
    steps = 3 * SPELLS
    for k in range(steps):
        way = np.array([k % 2, 0], dtype=np.uint8)
        one = picture(float(k), [4, 5], [(0, 0), (9, 0)], rules=("ci", "tracklet"), track_rule=way)
        one = replace(one, contributor_counts=np.array([1, 1], dtype=np.uint16))
        told.step(Step(1, k, k, picture=one), 4)
    assert [str(one) for one in told.spells()] == [
        f"fused by {way}, {steps // 2} steps in {steps // 2} spells" for way in ("ci", "tracklet")
    ]
