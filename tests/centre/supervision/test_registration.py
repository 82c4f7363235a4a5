"""Errors of clocks and places, put into sources of a whole centre: what it finds, says and takes off."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import schemas
from benchmarks.offset_sources import Offset, World
from fusion_service.centre import FusionCentre, StepResult

RULED: dict[str, Any] = {"memory": "restart", "rule": "ci"}
CORRECT: dict[str, Any] = {"registration": "correct", **RULED}
A: dict[str, Any] = {"sources": {"a": {"reference": True}}}


def bias(result: StepResult, name: str) -> dict[str, Any]:
    return dict(result.status.sources[name]["bias"])


def wrong(result: StepResult, name: str, one: Offset) -> dict[str, float]:
    """By how many of its own sigmas each estimate is wrong."""
    return {
        key: (said["value"] - getattr(one, key)) / max(said["sigma"], 1e-12) for key, said in bias(result, name).items()
    }


def confirmed(result: StepResult) -> int:
    return int((result.tracks.status == schemas.messages.CONFIRMED).sum())


def test_a_clock_half_a_second_late_is_found_and_nothing_is_double_any_more() -> None:
    """25 targets at 200 m/s: sigma 10 m, so that 100 m are far outside every gate."""
    late = Offset(clock=0.5, sigma=(10.0, 2.0))
    world = World({"a": Offset(sigma=(10.0, 2.0)), "b": late, "c": Offset(sigma=(10.0, 2.0))}, **CORRECT)
    first = world.run(3)
    assert confirmed(first) >= 40, "without links they are double"
    last = world.run(27)
    found = bias(last, "b")["clock"]
    assert abs(found["value"] - 0.5) < min(0.1, 4 * found["sigma"])
    assert found["observable"]
    assert confirmed(last) == 25
    far = [np.hypot(*(last.tracks.means[:, :2] - one[:2]).T).min() for one in world.truth(world.second)]
    assert np.sqrt(np.mean(np.square(far))) < 12.0
    assert "taken off" in last.status.sources["b"]["bias_note"]
    assert "weighted mean of 3" in last.status.sources["b"]["bias_gauge"]
    assert not last.status.sources["a"]["bias_applied"]


def test_errors_of_place_are_found_within_their_sigma() -> None:
    one = Offset(place=(-15e3, 8e3), x=50.0, heading=math.radians(1.0), range=100.0, polar=True)
    for seed in range(2):
        config = {**CORRECT, "sources": {"a": {"reference": True}}}
        result = World({"a": Offset(place=(10e3, 0.0)), "b": one}, seed=seed, **config).run(25)
        off = wrong(result, "b", one)
        assert set(off) == {"clock", "x", "y", "heading", "range", "scale", "drift"}
        assert max(map(abs, off.values())) < 4.0, (seed, off)
        assert bias(result, "b")["heading"]["sigma"] < 2e-3
        assert result.status.sources["b"]["bias_applied"]
        assert confirmed(result) == 25


def test_a_sensor_that_moves_is_turned_about_where_it_is() -> None:
    """A ship at 40 m/s with a compass that is wrong: over a minute its place moves by 2.4 km, which would be 42 m."""
    ship = Offset(place=(-20e3, 8e3), heading=math.radians(1.0), way=(40.0, -10.0))
    result = World({"a": Offset(place=(10e3, 0.0)), "b": ship}, seed=3, **{**CORRECT, **A}).run(60)
    off = wrong(result, "b", ship)
    assert max(map(abs, off.values())) < 4.0, off
    found = bias(result, "b")["heading"]
    assert found["observable"]
    assert found["sigma"] < math.radians(0.05)


@pytest.mark.parametrize("how", [{}, {"lasting": 0.8}, {"tracker": True}], ids=["white", "lasting", "trackers"])
def test_estimates_are_as_uncertain_as_they_say(how: dict[str, Any]) -> None:
    """NEES over runs with other errors each: the mean over the 99.9 % interval of its chi-square, and not far below.
    Errors of a Kalman filter are not AR(1), and what it says of them holds for a target that its noise moves: below."""
    runs, total = 4, []
    for seed in range(runs):
        x = np.random.default_rng([7, seed]).normal(size=3) * [0.05, 15.0, 15.0]
        one = Offset(clock=float(x[0]), x=float(x[1]), y=float(x[2]), sigma=(30.0, 2.0), **how)
        world = World({"a": Offset(**how), "b": one}, 8, seed=seed, heading_sigma=0.0, **RULED, **A)
        world.run(20)
        mean, covariance = world.centre._supervisor.registration.estimate("b")
        e = mean[:3] - x
        total.append(float(e @ np.linalg.solve(covariance[:3, :3], e)) / 3)
    print("NEES", np.round(total, 2))
    assert 0.1 < np.mean(total) < 2.8  # 12 degrees of freedom: .18 to 2.74


def test_two_errors_at_once_of_which_the_odd_ones_are_corrected() -> None:
    b, c = Offset(clock=0.3), Offset(x=60.0, y=-20.0)
    offsets = {"a": Offset(), "b": b, "c": c, "d": Offset(), "e": Offset()}
    result = World(offsets, **CORRECT).run(25)
    for name, one in offsets.items():
        off = wrong(result, name, one)
        assert max(map(abs, off.values())) < 5.0, (name, off)
    assert [result.status.sources[name]["bias_applied"] for name in "abcde"] == [False, True, True, False, False]


def test_of_two_sources_none_is_blamed_and_the_text_says_so() -> None:
    result = World({"a": Offset(), "b": Offset(clock=0.3)}, **RULED).run(15)
    assert bias(result, "a")["clock"]["value"] == pytest.approx(-bias(result, "b")["clock"]["value"], abs=1e-3)
    assert bias(result, "b")["clock"]["value"] == pytest.approx(0.15, abs=0.03)
    assert "which of the two is wrong cannot be told" in result.status.sources["b"]["bias_gauge"]
    assert "told only" in result.status.sources["b"]["bias_note"]


def test_what_cannot_be_seen_is_said_to_be_unseen() -> None:
    world = World({"a": Offset(), "b": Offset()}, 20, seen={"a": range(10), "b": range(10, 20)}, **CORRECT)
    result = world.run(10)
    for said in bias(result, "b").values():
        assert not said["observable"]
        assert said["why"] == "no common targets"
    assert "no common targets" in result.status.sources["b"]["bias_note"]
    one_way: dict[str, Any] = {"clock_sigma": 1.0, "translation_sigma": 200.0, "heading_sigma": 0.0}
    result = World({"a": Offset(), "b": Offset(clock=0.1)}, courses=[0.3], varied=0.0, **one_way, **A, **RULED).run(20)
    clock = bias(result, "b")["clock"]
    assert not clock["observable"]
    assert "one direction" in clock["why"]
    known = float(clock["why"].split("known to ")[1].split(" m")[0])
    assert known < 30.0 < clock["sigma"] * 200.0
    result = World({"a": Offset(), "b": Offset(x=50.0)}, speed=0.05, **A, **RULED).run(10)
    assert "hardly move" in bias(result, "b")["clock"]["why"]
    assert bias(result, "b")["x"]["observable"]


def test_estimating_changes_nothing_and_off_says_nothing() -> None:
    pictures = []
    for registration in ("off", "estimate"):
        world = World({"a": Offset(), "b": Offset(clock=0.2)}, registration=registration)
        results = [world.step() for _ in range(8)]
        pictures.append([schemas.encode(result.tracks) for result in results])
        assert ("bias" in results[-1].status.sources["b"]) == (registration == "estimate")
    assert pictures[0] == pictures[1]


def test_it_is_as_if_there_had_been_no_error() -> None:
    """Tracklets of a corrected source are taken on, ids stay, and places are as good."""
    how: dict[str, Any] = {"memory": "tracklet", "registration": "correct", **A}
    far, ids = [], []
    for one in (Offset(tracker=True), Offset(tracker=True, clock=0.1, x=15.0, y=10.0)):
        world = World({"a": Offset(tracker=True), "b": one}, **how)
        ids.append(set(world.run(8).tracks.ids.tolist()))
        result = world.run(30)
        ids[-1] &= set(result.tracks.ids.tolist())
        assert confirmed(result) == 25
        assert result.status.sources["b"]["no_tracklets"] == ""
        truth = world.truth(world.second)
        far.append(np.sqrt(np.mean([((result.tracks.means[:, :2] - t[:2]) ** 2).sum(axis=1).min() for t in truth])))
    assert [len(one) for one in ids] == [25, 25]
    assert far[1] < 1.1 * far[0]


def test_a_restarted_centre_goes_on_to_the_bit_and_a_restarted_source_keeps_its_place() -> None:
    how: dict[str, Any] = {**CORRECT, **A, "revise": 0}  # what was kept to make steps again is not in a checkpoint
    world = World({"a": Offset(), "b": Offset(clock=0.2, x=80.0), "c": Offset(clock=2.0)}, **how)
    world.run(9)
    blob = world.centre.checkpoint()
    want = [world.step() for _ in range(4)]
    again = World(world.sources, **how)
    again.run(9)
    again.centre = FusionCentre(again.config, checkpoint=blob, epoch=world.centre.epoch)
    for one in want:
        got = again.step()
        for name in ("ids", "means", "covariances", "status"):
            assert getattr(got.tracks, name).tobytes() == getattr(one.tracks, name).tobytes()
        assert got.status.sources["b"]["bias"] == one.status.sources["b"]["bias"]
    before = bias(want[-1], "b")
    world.epoch["b"] = 2
    world.inform("b")
    result = world.step()
    after = bias(result, "b")
    assert after["clock"]["sigma"] > 2 * before["clock"]["sigma"]
    assert after["x"]["sigma"] < 3 * before["x"]["sigma"]
    assert after["x"]["value"] == pytest.approx(80.0, abs=15.0)


def test_slow_drift_is_followed() -> None:
    result = World({"a": Offset(), "b": Offset(drift=5e-4)}, **CORRECT, **A).run(80)
    said = bias(result, "b")
    assert abs(said["clock"]["value"] - 0.04) < 4 * said["clock"]["sigma"]
    assert abs(said["drift"]["value"] - 5e-4) < 4 * said["drift"]["sigma"]
    assert said["drift"]["observable"]


def test_honest_sources_are_left_alone() -> None:
    world = World({name: Offset(lasting=0.7) for name in "abcd"}, **CORRECT)
    told = [event for _ in range(40) for event in world.step().log.events if event["kind"] == "registration"]
    assert told == []


def test_absurd_numbers_raise_nothing_and_leave_the_rest_as_it_is() -> None:
    world = World({"a": Offset(), "b": Offset(clock=0.2), "c": Offset()}, **CORRECT, **A)
    world.run(6)
    before = bias(world.step(), "b")["clock"]
    for second, (size, variance) in enumerate([(1e12, 1.0), (1e200, 1e300), (0.0, 1e-200), (1.0, 1e200)], start=100):
        said = schemas.LocalTracks(
            source="c", epoch=1, seq=second, sent=0, time=world.centre.time + 10**8, complete=True,
            space=("x", "y", "vx", "vy"), frame=world.centre._intake.frame or schemas.Enu(0.0, 0.0),
            ids=np.arange(1, 26, dtype=np.uint64), means=np.full((25, 4), size),
            covariances=np.tile(variance * np.eye(4), (25, 1, 1)),
        )  # fmt: skip
        world.centre.handle(said, world.centre.time + 10**9)
        after = bias(world.step(), "b")["clock"]
        assert math.isfinite(after["value"])
        assert math.isfinite(after["sigma"])
    after = bias(world.run(5), "b")["clock"]
    assert abs(after["value"] - 0.2) < 5 * before["sigma"]
