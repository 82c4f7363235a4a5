"""Ids over outages: of sources, of the network, of the centre itself."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import numpy as np
import pytest

from fusion_service.centre import FusionCentre, Order, Skipped, SourceFound, SourceLost, StepResult
from schemas.messages import COASTING, TENTATIVE
from tests.centre.worlds import START, centre, give, info, moved, seen, step, tracks, truth

SOURCES = ("r1", "r2", "r3")
COUNT = 12


class World:
    """Three sources that see twelve targets once a second, under ids of their own, and a centre; what it has told."""

    def __init__(self, *, told: bool = True, **config: object) -> None:
        self.made = centre(SOURCES, coast=5.0, **config)
        if told:
            give(self.made, *(SourceFound(name) for name in SOURCES))
        self.truth, self.rng, self.second = truth(COUNT), np.random.default_rng(7), 0
        self.epoch = dict.fromkeys(SOURCES, 1)
        self.ended: list[tuple[int, str]] = []
        self.events: list[dict[str, object]] = []

    def go(self, seconds: int, speaking: Collection[str] = SOURCES, *, steps: bool = True) -> StepResult | None:
        """So many seconds in which these sources speak; steps: are made."""
        result = None
        for _ in range(seconds):
            self.second += 1
            give(self.made, *self.said(speaking))
            if steps:
                result = step(self.made, self.second)
                self.ended += [(track, why) for track, why, _ in result.tracks.ended]
                self.events += result.log.events
        return result

    def said(self, speaking: Collection[str]) -> list[Any]:
        """What these sources say now."""
        out = []
        for number, name in enumerate(SOURCES):
            states = seen(moved(self.truth, self.second), self.rng)
            if name in speaking:
                ids = np.roll(np.arange(1, COUNT + 1), number)
                out.append(tracks(name, self.second, states, ids, epoch=self.epoch[name]))
        return out

    def ids(self, result: StepResult | None) -> dict[int, int]:
        """{target: global id} of the last picture, of which each track must be one of the targets."""
        assert result is not None
        picture, places = result.tracks, moved(self.truth, self.second)[:, :2]
        picture_places = picture.means[:, :2]
        far = np.linalg.norm(picture_places[:, None] - places[None], axis=2)
        shown = picture.status != TENTATIVE
        assert (far.min(axis=1)[shown] < 600.0).all()
        return dict(zip(far.argmin(axis=1)[shown].tolist(), picture.ids[shown].tolist(), strict=True))

    def kinds(self) -> list[object]:
        return [event["kind"] for event in self.events if event["kind"] in ("suspended", "resumed")]


@pytest.mark.parametrize(("pause", "rule"), [(4, "auto"), (15, "auto"), (90, "auto"), (30, "ci")])
def test_a_network_that_is_gone_costs_no_id(pause: int, rule: str) -> None:
    """Nothing comes, and the tokens go after a while; steps go on."""
    world = World(rule=rule)
    before = world.ids(world.go(10))
    assert len(before) == COUNT
    quiet = world.go(min(pause, 10), ())
    give(world.made, *(SourceLost(name) for name in SOURCES))
    if pause > 10:
        quiet = world.go(pause - 10, ())
        assert quiet is not None
        assert len(quiet.tracks.ids) == 0
        assert quiet.status.tracks["suspended"] == COUNT
    give(world.made, *(SourceFound(name) for name in SOURCES))
    assert world.ids(world.go(1)) == before
    result = world.go(10)
    assert world.ids(result) == before
    assert world.ended == []
    assert len(result.tracks.ids) == COUNT  # type: ignore[union-attr]
    assert world.kinds() == ["suspended", "resumed"] * (pause > 10)
    assert "suspended" not in result.status.tracks  # type: ignore[union-attr]


def test_sources_that_come_back_one_after_the_other_find_their_tracks() -> None:
    world = World()
    before = world.ids(world.go(10))
    world.go(20, ())
    for speaking in (["r2"], ["r2", "r3"], SOURCES):
        result = world.go(4, speaking)
        assert world.ids(result) == before
        assert len(result.tracks.ids) == COUNT  # type: ignore[union-attr]
    assert world.ended == []


@pytest.mark.parametrize("pause", [3, 15, 60])
def test_a_centre_that_was_frozen_holds_all_it_had(pause: int) -> None:
    """The sources went on; nothing of it came. In the first picture after it all are there."""
    world = World()
    before = world.ids(world.go(10))
    world.second += pause - 1
    give(world.made, Skipped(pause - 1))
    result = world.go(1, ())
    assert world.ids(result) == before
    assert world.ids(world.go(5)) == before
    assert world.ended == []


@pytest.mark.parametrize("pause", [90, 500])
def test_what_was_there_before_a_long_time_is_not_shown_and_comes_back(pause: int) -> None:
    world = World()
    before = world.ids(world.go(10))
    world.second += pause - 1
    give(world.made, Skipped(pause - 1))
    result = world.go(1, ())
    assert result is not None
    assert len(result.tracks.ids) == 0
    assert world.ids(world.go(5)) == before
    assert world.ended == []


@pytest.mark.parametrize("pause", [5, 50])
def test_a_centre_made_anew_from_its_checkpoint_has_its_ids(pause: int) -> None:
    world = World()
    before = world.ids(world.go(10))
    blob = world.made.checkpoint()
    world.second += pause
    world.made = FusionCentre(world.made.config, blob, generation=77)
    give(world.made, Skipped(pause))
    assert world.ids(world.go(2, ())) == before
    assert world.ids(world.go(5)) == before
    assert world.ended == []


def test_a_freeze_keeps_no_dead_track_alive() -> None:
    """Sources that stay silent after it are told from those that speak; what these do not list is gone."""
    world = World()
    world.go(10)
    world.second += 14
    give(world.made, Skipped(14))
    world.truth = world.truth[:8]
    for _ in range(8):
        world.second += 1
        for number, name in enumerate(SOURCES):
            ids = np.roll(np.arange(1, COUNT + 1), number)
            keep = np.arange(8)
            states = seen(moved(world.truth, world.second), world.rng)
            give(world.made, tracks(name, world.second, states, ids[keep]))
        result = step(world.made, world.second)
    assert len(result.tracks.ids) == 8


def test_what_is_not_heard_again_in_time_ends() -> None:
    world = World(remember=30.0)
    world.go(10)
    world.go(29, ())
    assert world.ended == []
    world.go(3, ())
    assert {why for _, why in world.ended} == {"lost"}
    assert len(world.ended) == COUNT
    result = world.go(5)
    old = {track for track, _ in world.ended}
    assert not old & set(world.ids(result).values())


def test_a_new_run_of_a_source_takes_over_no_id() -> None:
    world = World()
    world.go(10, ["r1"])
    world.go(20, ())
    world.epoch["r1"] = START // 10**9 * 10**9 + 5
    result = world.go(5, ["r1"])
    assert len(world.ended) == COUNT
    assert not {track for track, _ in world.ended} & set(world.ids(result).values())


def test_a_local_id_that_means_another_object_now_begins_anew() -> None:
    """Trackers that number their tracks anew use the same numbers for whatever comes first."""
    world = World()
    world.go(10, ["r1"])
    world.go(20, ())
    world.truth = truth(COUNT, seed=99)
    result = world.go(5, ["r1"])
    assert len(world.ended) >= COUNT - 3  # one may lie where another can have got to
    assert len(set(world.ids(result).values()) & {track for track, _ in world.ended}) == 0
    assert world.ids(result).keys() == set(range(COUNT))


@pytest.mark.parametrize(
    "how", [lambda: World(told=False), lambda: World(suspend=False)], ids=["without tokens", "not wanted"]
)
def test_else_silence_ends_a_track_as_ever(how: Callable[[], World]) -> None:
    world = how()
    world.go(10)
    world.go(15, ())
    assert len(world.ended) == COUNT


def test_a_source_that_speaks_of_others_is_no_outage() -> None:
    """A receiver that sends what it hears: one ship is heard no more, the other is."""
    made = centre((), coast=5.0)
    give(made, info("ais"), SourceFound("ais"))
    ended: list[Any] = []
    for second in range(1, 60):
        ids = [1, 2] if second < 20 else [1]
        means = [[1000.0 * one, 0, 0, 0] for one in ids]
        give(made, tracks("ais", second, means, ids, complete=False))
        ended += step(made, second).tracks.ended
    assert [why for _, why, _ in ended] == ["lost"]


def test_orders_about_a_suspended_track_stand() -> None:
    world = World()
    before = world.ids(world.go(10))
    give(world.made, Order("rename", track=before[4], name="VIKING"))
    world.go(30, ())
    result = world.go(2)
    assert world.ids(result) == before
    picture = result.tracks  # type: ignore[union-attr]
    assert picture.callsign is not None
    assert picture.callsign[picture.ids.tolist().index(before[4])] == "VIKING"


def test_what_ended_in_a_file_beside_the_checkpoint_is_not_waited_for() -> None:
    world = World()
    before = world.ids(world.go(10))
    world.go(15, ())
    assert world.made.let_go(np.array([before[4]], dtype=np.uint64)) == 1
    assert before[4] not in world.ids(world.go(2)).values()


def test_an_outage_in_the_checkpoint_goes_on_as_it_would_have() -> None:
    world = World()
    before = world.ids(world.go(10))
    world.go(20, ())
    twin = FusionCentre(world.made.config, world.made.checkpoint())
    mine, rng = world.made, world.rng.bit_generator.state
    world.go(5)
    world.made, world.second = twin, world.second - 5
    world.rng.bit_generator.state = rng
    assert world.ids(world.go(5)) == before
    assert twin.checkpoint() == mine.checkpoint()


def test_a_hundred_thousand_outages_do_not_grow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion_service.centre.suspended.MOST_SUSPENDED", 8)
    world = World()
    world.go(10)
    result = world.go(20, ())
    assert result is not None
    assert result.status.tracks["suspended"] == 8
    assert len(world.ended) == 4
    assert COASTING not in result.tracks.status


@pytest.mark.parametrize("revise", [0.0, 100.0])
@pytest.mark.parametrize("lost", [(), (3, 4, 5, 6, 7, 8, 9, 10)], ids=["all comes after all", "some of it does"])
def test_what_comes_after_an_outage_of_what_was_said_in_it_gives_no_other_ids(
    revise: float, lost: Collection[int]
) -> None:
    """The steps of the outage are made again with it: tracks that were suspended in them never were."""
    world = World(lateness=20.0, revise=revise, stale_periods=1.0)
    before = world.ids(world.go(10))
    world.go(1, ())
    for name in SOURCES:
        world.made.handle(SourceLost(name), START)
    kept = []
    for ago in range(12):
        world.second += 1
        kept += [] if ago in lost else world.said(SOURCES)
        result = step(world.made, world.second)
        world.ended += [(track, why) for track, why, _ in result.tracks.ended]
    assert result.status.tracks["suspended"] == COUNT
    give(world.made, *kept)
    seen_ids = set(before.values())
    for _ in range(10):
        result = world.go(1)  # type: ignore[assignment]
        seen_ids |= set(result.tracks.ids.tolist())
        assert "suspended" not in result.status.tracks
    assert world.ids(result) == before
    assert world.ended == []
    assert seen_ids == set(before.values())
