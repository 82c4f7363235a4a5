"""Supervision and registration together, in a whole centre: what one does is not to make the other wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.offset_sources import Offset, World
from fusion_service.centre import StepResult
from fusion_service.centre.supervision.bias import RANGE
from fusion_service.centre.supervision.gauge import gauge_weights, halved
from fusion_service.centre.supervision.honesty import Honesty
from fusion_service.metrics import gospa, nees
from schemas.messages import CONFIRMED

GOOD = Offset(sigma=(10.0, 2.0), tracker=True)
RULED: dict[str, Any] = {"memory": "restart", "rule": "ci"}


def flown(bad: Offset, names: str, seconds: int, **config: Any) -> tuple[World, list[StepResult]]:
    world = World(dict.fromkeys(names, GOOD) | {"b": bad}, 10, speed=60.0, seed=3, **{**RULED, **config})
    return world, [world.step() for _ in range(seconds)]


def shown(result: StepResult) -> int:
    return int((result.tracks.status == CONFIRMED).sum())


def states(results: list[StepResult], name: str) -> list[str]:
    return [one.status.sources[name]["state"] for one in results]


def scores(world: World, result: StepResult) -> float:
    """ANEES of places."""
    there = world.truth(world.second)[:, :2]
    track = gospa(there, result.tracks.means[:, :2], 1000.0).assignment
    assert (track >= 0).all()
    error = result.tracks.means[track, :2] - there
    return float(nees(error, result.tracks.covariances[track][:, :2, :2]).mean() / 2)


def test_where_an_error_is_told_only_nothing_is_shown_twice() -> None:
    bad = Offset(x=200.0, sigma=(10.0, 2.0), tracker=True)
    _, off = flown(bad, "abc", 25, supervision="off", registration="off")
    assert shown(off[-1]) == 20
    world, results = flown(bad, "abc", 25)
    assert shown(results[-1]) == 10
    assert states(results, "b")[-5:] == ["inflated"] * 5
    assert set(states(results, "a")) | set(states(results, "c")) == {"trusted"}
    assert scores(world, results[-1]) < 1.5


@pytest.mark.parametrize("how", ["estimate", "correct"])
@pytest.mark.parametrize("which", ["a", "b"])
def test_a_turned_source_is_found_whatever_its_name(how: str, which: str) -> None:
    """A turn about the place of one source is none about that of another, with which it is compared too."""
    places = {"a": (-8e3, 0.0), "b": (8e3, 0.0), "c": (0.0, 8e3)}
    sources = {name: replace(GOOD, place=place) for name, place in places.items()}
    sources[which] = replace(sources[which], heading=np.radians(1.0))
    world = World(sources, 12, speed=60.0, seed=3, spread=10e3, registration=how, **RULED)
    results = [world.step() for _ in range(25)]
    assert shown(results[-1]) == 12
    assert results[-1].status.sources[which]["bias"]["heading"]["value"] == pytest.approx(np.radians(1.0), rel=0.2)


def test_what_no_correction_mends_is_covered_in_part() -> None:
    """Ranges that are too long, of a source that does not say that it measures ranges."""
    places = {"a": (-8e3, 0.0), "b": (8e3, 0.0), "c": (0.0, 8e3)}
    sources = {name: replace(GOOD, place=place) for name, place in places.items()}
    sources["b"] = replace(sources["b"], range=120.0)
    results = {}
    hows: tuple[dict[str, Any], ...] = ({"registration": "correct"}, {"registration": "off", "supervision": "off"})
    for how in hows:
        world = World(sources, 12, speed=60.0, seed=3, spread=10e3, **how, **RULED)
        results[how["registration"]] = [world.step() for _ in range(40)]
    assert shown(results["correct"][-1]) <= 0.75 * shown(results["off"][-1])
    assert {states(results["correct"], name)[-1] for name in "ac"} == {"trusted"}


def test_a_source_that_is_corrected_is_judged_anew() -> None:
    bad = Offset(x=40.0, sigma=(10.0, 2.0), tracker=True)
    _, results = flown(bad, "abc", 40, registration="correct")
    begun = next(i for i, one in enumerate(results) if one.status.sources["b"]["bias_applied"])
    assert begun < 12
    assert set(states(results, "b")[20:]) == {"trusted"}
    ids = [frozenset(one.tracks.ids[one.tracks.status == CONFIRMED].tolist()) for one in results[begun:]]
    assert ids[-1] <= ids[0], "no id begins with the correction"


@pytest.mark.parametrize("how", ["estimate", "correct"])
def test_of_two_neither_is_believed_where_places_differ(how: str) -> None:
    bad = Offset(x=30.0, sigma=(10.0, 2.0), tracker=True)
    world, results = flown(bad, "ab", 30, registration=how, memory="tracklet", rule="auto")
    before, off = flown(bad, "ab", 30, registration="off", supervision="off", memory="tracklet", rule="auto")
    square, without = scores(world, results[-1]), scores(before, off[-1])
    print(f"{how}: ANEES {square:.2f}, {without:.2f} with nothing looked after")
    if how == "correct":
        assert square < 1.5 < without
    else:
        assert square < without
        assert (states(results, "a")[-1], states(results, "b")[-1]) == ("inflated", "inflated")
        assert "told and not taken off" in results[-1].status.sources["a"]["state_why"]
    assert shown(results[-1]) == 10


def test_two_of_five_that_agree_are_covered_and_the_others_left_alone() -> None:
    bad = Offset(x=200.0, sigma=(10.0, 2.0), tracker=True)
    world = World(dict.fromkeys("acde", GOOD) | {"b": bad, "d": bad}, 10, speed=60.0, seed=3, **RULED)
    results = [world.step() for _ in range(30)]
    assert shown(results[-1]) == 10
    assert {states(results, name)[-1] for name in "bd"} == {"inflated"}
    assert {one for name in "ace" for one in states(results, name)} == {"trusted"}
    assert scores(world, results[-1]) < 1.5


def test_half_of_a_difference_may_be_none_of_it() -> None:
    alone, three = np.array([0, 0, 2]), np.zeros(3, dtype=np.intp)
    nobody = np.zeros(3, dtype=np.bool_)
    assert halved(alone, nobody, 0)
    assert not halved(alone, nobody, 2)
    assert not halved(three, nobody, 0)
    assert not halved(alone, np.array([False, True, False]), 0)


def test_what_is_far_and_hardly_known_does_not_pull_the_mean() -> None:
    sigma = np.ones((3, 7))
    mean, variance = np.zeros((3, 7)), np.full((3, 7), 1e-4)
    mean[1], variance[1] = 1.0, 0.1
    weight = np.delete(gauge_weights(sigma, np.zeros(3, dtype=np.intp), mean, variance), RANGE, axis=1)
    assert weight[1].max() < 0.002
    assert weight[[0, 2]].min() > 0.9


def test_what_is_forgotten_of_a_source_leaves_the_others() -> None:
    world, _ = flown(GOOD, "abc", 5)
    honesty: Honesty = world.centre._supervisor._honesty
    assert set(honesty.opinions(1e-6, {})) == {"a", "b", "c"}
    honesty.forget({"b": 1e-3, "nobody": 1.0})
    assert set(honesty.opinions(1e-6, {})) == {"a", "b", "c"}, "too little to matter"
    honesty.forget({"b": np.inf})
    told = honesty.opinions(1e-6, {})
    assert set(told) == {"a", "c"}
    assert told["a"].beside == ("c",)


def test_a_source_that_was_mended_is_trusted_soon() -> None:
    bad = Offset(x=60.0, sigma=(10.0, 2.0), tracker=True)
    world, results = flown(bad, "abc", 40)
    assert states(results, "b")[-1] == "inflated"
    world.sources["b"] = GOOD
    world.tracks["b"] = (world.tracks["b"][0] - [60.0, 0.0, 0.0, 0.0], world.tracks["b"][1])
    after = [world.step() for _ in range(60)]
    assert states(after, "b")[-1] == "trusted"
    assert set(states(after, "a")) == {"trusted"}


def test_what_jumps_as_a_whole_has_other_errors_than_before() -> None:
    world, results = flown(GOOD, "abc", 60, registration="correct")
    assert not results[-1].status.sources["b"]["bias_applied"]
    world.sources["b"] = Offset(x=200.0, sigma=(10.0, 2.0), tracker=True)
    world.tracks["b"] = (world.tracks["b"][0] + [200.0, 0.0, 0.0, 0.0], world.tracks["b"][1])
    after = [world.step() for _ in range(25)]
    assert after[-1].status.sources["b"]["bias"]["x"]["value"] == pytest.approx(200.0, abs=10.0)
    assert shown(after[-1]) == 10
