"""Sources that are wrong about themselves in any way: what comes of them is sound, repeatable and replayable."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.arrays import Ints
from fusion_service.centre.supervision import honesty, unlinked
from fusion_service.centre.supervision.deciding import with_innovations
from fusion_service.centre.supervision.hat import Pairs
from fusion_service.centre.supervision.matching import Tracks2, match
from tests.centre.test_random_missions import check_mission
from tests.centre.worlds import SPACE, centre, give, moved, step, tracks, truth
from tests.helpers import source_missions

QUICK, STEPS = (7, 38), 18


@pytest.mark.parametrize("seed", QUICK[1:])
def test_any_mission(seed: int) -> None:
    print("seed", seed)
    check_mission(source_missions.fly(seed, STEPS), seed)


def test_the_missions_hold_what_they_should() -> None:
    """They are not empty: errors found and taken off, states changed, alarms, extents, platforms."""
    events, extents, applied = set[str](), 0, 0
    for seed in QUICK:
        mission = source_missions.fly(seed, STEPS)
        for result in mission.results:
            events |= {str(event["kind"]) for event in result.log.events}
            extents += result.tracks.extent is not None
            applied += sum(bool(one.get("bias_applied")) for one in result.status.sources.values())
    assert events >= {"registration", "supervision", "alarm"}, events
    assert extents
    assert applied


def test_three_tracks_of_one_identity_become_one_without_a_chain() -> None:
    """Two would end for the oldest, which would itself end for the one with more sources: what a quiet local track of
    the first is linked to has to be there."""
    names = ("r1", "r2", "r3", "r4")
    world = centre(names)
    place = {"r1": 0.0, "r2": 300.0, "r3": -300.0, "r4": -300.0}
    ended: dict[int, int | None] = {}
    for second in range(1, 30):
        said = None if second < 8 else ("icao:abc123",)
        give(world, *(tracks(name, second, [[x, 0.0, 0.0, 0.0]], [7], identity=said) for name, x in place.items()))
        result = step(world, second)
        new = {old: other for old, _, other in result.tracks.ended}
        there = set(result.tracks.ids.tolist())
        assert all(other is None or other in there for other in new.values()), (second, new, there)
        ended |= new
    assert ended


def _ahead(**config: float) -> list[int]:
    """How many global tracks there are, step by step, of 12 targets that two sources see, one of them 3 s late."""
    states = truth(12, seed=3) * [1.0, 1.0, 5.0, 5.0]
    world = centre(("r1", "r2"), registration="correct", **config)
    count = []
    for second in range(1, 21):
        give(world, tracks("r1", second, moved(states, second)), tracks("r2", second, moved(states, second - 3)))
        count.append(len(step(world, second).tracks.ids))
    return count


def test_sources_that_can_have_no_error() -> None:
    """Nothing is supposed to be wrong, so nothing is looked for where targets stand twice."""
    assert _ahead(clock_sigma=0.0, translation_sigma=0.0, heading_sigma=0.0)[-1] > 20


def test_crowds_that_share_nothing_are_looked_at_in_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of so many tracks as would fill the memory every so many are looked at, and the offset is found all the same."""
    whole = _ahead()
    assert whole[-1] == 12
    monkeypatch.setattr(unlinked, "MOST_COMPARED", 80)
    asked: list[int] = []

    def watched(one: Tracks2, other: Tracks2, *rest: Any) -> tuple[Ints, Ints]:
        asked.append(len(one))
        return match(one, other, *rest)

    monkeypatch.setattr(unlinked, "match", watched)
    _ahead()
    assert max(asked) <= 6


def test_nothing_is_thought_of_a_source_beside_nobody() -> None:
    """Its own innovations decide who of two is wrong; with nobody to be compared with they name no one."""
    none, nobody = np.zeros(0), np.zeros(0, dtype=np.intp)
    alone = Pairs(nobody, nobody, none, none, none, 2)
    joined, sure = with_innovations(alone, 2, [(0, 4.5, 100.0)], 2)
    assert not len(joined.first)
    assert not sure.any()
    two = Pairs(np.array([0]), np.array([1]), np.array([2.5]), np.array([0.5]), np.array([50.0]), 2)
    joined, sure = with_innovations(two, 2, [(0, 4.5, 100.0)], 2)
    assert len(joined.first) == 2
    assert sure.all()


def test_a_heading_that_is_not_known_of_a_sensor_far_away_leaves_covariances_definite() -> None:
    """What it adds is 1e10 times what the track is uncertain by itself: less than rounding keeps of it."""
    platform = schemas.Platform((-5e7, 3e7, -1e6), heading_sigma=3.0)
    world = centre(("r1",))
    for second in range(1, 4):
        sigma = np.array([0.02, 0.02, 0.002, 0.002])
        give(world, tracks("r1", second, [[140.0, 55.0, 2.0, 2.0]], sigma=sigma, platform=platform))
        P = step(world, second).tracks.covariances
        root = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        assert root[0, 0] > 1e7
        assert (np.linalg.eigvalsh(P / root[:, :, None] / root[:, None]) > 1e-14).all()


def test_pairs_of_sources_that_are_gone_make_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sources come and go: those of now are compared, whoever was before."""
    monkeypatch.setattr(honesty, "MOST_SOURCE_PAIRS", 6)
    watched = honesty.Honesty(SPACE)
    for turn in range(5):
        names = tuple(f"s{turn}{k}" for k in range(3))
        number = watched._numbers(names)
        key = np.array([number[0] * honesty.BASE + number[1], number[1] * honesty.BASE + number[2]])
        assert (watched._places(key) >= 0).all(), turn
