"""What one that stands by holds of the active centre, without a bus: the same state, or it says why not."""

from __future__ import annotations

import dataclasses

import pytest

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.config import CentreConfig
from fusion_service.service.shadow import Shadow
from fusion_service.service.young import born_in
from schemas import GlobalTracks, LocalTracks, SensorInfo
from tests.centre.worlds import START
from tests.helpers import random_missions
from tests.helpers.random_missions import GENERATION

NONE = "it has none yet"


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


class Watched:
    """A mission flown again, whose messages and logs a shadow hears. loads: why it was given a checkpoint each time.
    lost: numbers of steps whose messages the shadow does not hear. early: a step is made of its log before its picture
    is heard, as where one stands by."""

    def __init__(self, seed: int, lost: tuple[int, ...] = (), early: bool = False, **settings: object) -> None:
        mission = random_missions.fly(seed)
        self.config: CentreConfig = dataclasses.replace(mission.config, **settings)  # type: ignore[arg-type]
        self.given = mission.given
        self.centre = FusionCentre(self.config, generation=GENERATION, epoch=START)
        self.clock = Clock()
        self.shadow = Shadow(self.config, self.clock)
        self.loads: list[str] = []
        self._lost, self._early = lost, early
        self._made = 0

    def step(self) -> GlobalTracks:
        given = self.given[self._made]
        self._made += 1
        for event, received in given.events:
            self.centre.handle(event, received)
            if isinstance(event, (LocalTracks, SensorInfo)) and self._made not in self._lost:
                self.shadow.local(event, "key", b"data", received)
        result = self.centre.step(max(given.time, self.centre.time + 1))
        for message in (result.log, result.tracks) if self._early else (result.tracks, result.log):
            self.shadow.output(schemas.decode(schemas.encode(message)))
            if self._early:
                self.shadow.advance()
        for _ in range(2):
            self.clock.now += 1.0
            self.shadow.advance()
        return result.picture

    def load(self, picture: GlobalTracks) -> None:
        self.loads.append(self.shadow.wanted)
        assert self.shadow.load(self.centre.checkpoint(), (START, picture.step)) == ""

    def held(self) -> list[int]:
        """The global tracks of a centre that begins with what the shadow holds."""
        blob, ended, *_ = self.shadow.heritage()
        ids = FusionCentre(self.config, blob).view().ids
        return sorted(set(ids.tolist()) - set(ended.tolist()))


@pytest.mark.parametrize("seed", [7])
def test_where_no_step_is_made_again_one_checkpoint_is_enough_for_a_messy_mission(seed: int) -> None:
    watched = Watched(seed, revise=0.0)
    for _ in watched.given:
        picture = watched.step()
        if watched.shadow.lacks:
            watched.load(picture)
        assert watched.held() == sorted(watched.centre.view().ids.tolist())
    assert watched.loads == [NONE]
    assert watched.shadow.off == 0
    assert watched.shadow.steps == len(watched.given) - 1


@pytest.mark.parametrize("early", [False, True], ids=["picture first", "log first"])
def test_with_steps_made_again_it_says_when_its_tracks_are_others(early: bool) -> None:
    """A checkpoint does not tell what came before it: late data then change the active centre's steps alone."""
    watched = Watched(2, early=early)
    for _ in watched.given:
        picture = watched.step()
        if watched.shadow.lacks:
            watched.load(picture)
        assert watched.held() == sorted(watched.centre.view().ids.tolist())
    assert len(watched.loads) > 1
    assert all(why == NONE or "gave other tracks" in why for why in watched.loads)


def test_without_a_message_it_goes_on_from_the_step_before_without_what_ended() -> None:
    watched = Watched(2, lost=(9,), revise=0.0)
    pictures = [watched.step() for _ in range(6)]
    watched.load(pictures[-1])
    made = [watched.step() for _ in range(2)]
    first = set(watched.centre.view().ids.tolist())
    later = [watched.step() for _ in range(6)]
    assert watched.shadow.wanted == "a message that step 9 took did not come here"
    assert watched.shadow.mark == (START, 8)
    ended = {track for one in later for track, _, _ in one.ended}
    assert made[-1].step == 8
    assert first & ended
    assert set(watched.held()) == first - ended
    born = {track for _, track in born_in(watched.shadow.heritage().born).tracks}
    newer = {one for picture in later for one in picture.ids.tolist()} - first
    assert newer
    assert born >= newer, "which go on under their ids"


def test_from_the_last_checkpoint_it_goes_on_without_what_ended_in_the_steps_that_it_made() -> None:
    watched = Watched(2, early=True, revise=0.0)
    watched.load([watched.step() for _ in range(6)][-1])
    first = set(watched.centre.view().ids.tolist())
    later = [watched.step() for _ in range(8)]
    assert not watched.shadow.wanted
    ended = {track for one in later for track, _, _ in one.ended}
    assert first & ended
    watched.shadow._stray("its steps came out wrong")
    assert set(watched.held()) == first - ended
    born = {track for _, track in born_in(watched.shadow.heritage().born).tracks}
    assert born >= set(watched.centre.view().ids.tolist()) - first


def test_another_config_is_copied_not_followed() -> None:
    watched = Watched(1)
    watched.shadow = Shadow(dataclasses.replace(watched.config, gate=0.9), watched.clock)
    watched.load(watched.step())
    watched.step()
    assert "other settings" in watched.shadow.wanted
    assert watched.shadow.ready


def test_it_begins_with_nothing_and_takes_no_rubbish() -> None:
    shadow = Shadow(CentreConfig(), Clock())
    assert shadow.load(b"rubbish", (1, 1)).startswith("the checkpoint cannot be read")
    assert not shadow.ready
    blob, ended, *_ = shadow.heritage()
    assert blob is None
    assert len(ended) == 0
    assert shadow.left(0) == []
