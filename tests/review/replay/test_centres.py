"""A mission in which a centre took the pictures of another one is made again to the bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fusion_service.centre import FusionCentre
from fusion_service.review.replay import run_replay
from tests.centre.worlds import SECOND, START, info, moved, seen, step, tracks, truth
from tests.helpers.flown import Flight, pictures, record, verified


def exchange(memory: str) -> Flight:
    """Two centres that hear each other, one begun again from its checkpoint under way."""
    rng, states = np.random.default_rng(9), truth(5)
    first = Flight({"name": "A", "memory": memory, "lateness": 3.0, "sources": {"global/B": {}, "s": {"ignore": True}}})
    second = FusionCentre({"name": "B", "lateness": 3.0, "sources": {"global/A": {}}}, epoch=START + 3)
    first.put(info("r"), 0.5)
    second.handle(info("s"), START)
    told = None
    for at in range(1, 13):
        if told is not None:
            second.handle(first.steps[-1].tracks, START + at * SECOND)
            first.put(told, at - 0.5)
        first.put(tracks("r", at, seen(moved(states, at), rng)[:4]), at)
        second.handle(tracks("s", at, seen(moved(states, at), rng)[1:], range(2, 6)), START + at * SECOND)
        first.step(at)
        told = step(second, at).tracks
        if at == 7:
            first.begin(first.centre.checkpoint(), 9)
    return first


@pytest.mark.parametrize("memory", ["restart", "recursive"])
def test_it_is_made_again_to_the_bit(memory: str, tmp_path: Path) -> None:
    flight = exchange(memory)
    assert flight.steps[-1].tracks.sources == ("global/B", "r")
    assert len(flight.steps[-1].tracks.ids) == 5
    path = flight.record(tmp_path / "mission.rrd", draw=True)
    replay = verified(path, centre="A")
    assert replay.verdict is not None
    assert (replay.passed, replay.verdict.compared, replay.remarks) == (True, 12, [])
    out = tmp_path / "again.rrd"
    again = run_replay(path, rules=["naive"], out=out, centre="A", say=lambda line: None)
    assert again.players[0].steps == 12
    (name,) = (player.variant.name for player in again.players)
    assert all(one.sources == ("global/B", "r") for one in pictures(out, name)[2:])


def test_without_the_other_centres_pictures_it_says_what_is_missing(tmp_path: Path) -> None:
    flight = exchange("restart")
    log = [
        (key, data, at) for key, data, at in flight.log if not (key.endswith("global/B/tracks") and at > START + 6e9)
    ]
    replay = verified(record(tmp_path / "mission.rrd", log), centre="A")
    assert not any("differs" in one for one in replay.remarks)
    assert any("of global/B is not in the recording" in one for one in replay.remarks)


def test_the_clock_makes_a_mission_of_centres_too(tmp_path: Path) -> None:
    """An upper centre that hears nothing but other centres."""
    rng, states = np.random.default_rng(2), truth(3)
    lower = FusionCentre({"name": "B", "lateness": 3.0}, epoch=START + 3)
    lower.handle(info("s"), START)
    top = Flight({"name": "top", "clock": "message", "lateness": 3.0, "sources": {"global/B": {}}})
    for at in range(1, 9):
        lower.handle(tracks("s", at, seen(moved(states, at), rng)), START + at * SECOND)
        top.put(replace(step(lower, at).tracks, sent=0), at + 0.1)
        top.step(at)
    path = top.record(tmp_path / "mission.rrd")
    replay = run_replay(path, clock=True, centre="top", say=lambda line: None)
    assert replay.players[0].steps >= 7
    assert len(replay.players[0].tracks) == 3
    assert verified(path, centre="top").passed
