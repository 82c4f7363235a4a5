"""Sources that are wrong about themselves in any way: what comes of them is sound, repeatable and replayable."""

from __future__ import annotations

import pytest

from fusion_service.centre.supervision import unlinked
from tests.centre.test_random_missions import check_mission
from tests.centre.worlds import centre, give, moved, step, tracks, truth
from tests.helpers import source_missions

QUICK, STEPS = (1, 38), 18


@pytest.mark.parametrize("seed", QUICK)
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
        said = {} if second < 8 else {"identity": ("icao:abc123",)}
        give(world, *(tracks(name, second, [[x, 0.0, 0.0, 0.0]], [7], **said) for name, x in place.items()))
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
    real = unlinked.match
    monkeypatch.setattr(unlinked, "match", lambda one, other, *rest: asked.append(len(one)) or real(one, other, *rest))
    _ahead()
    assert max(asked) <= 6
