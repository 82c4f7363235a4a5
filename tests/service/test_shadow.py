"""What one that stands by holds of the active centre, without a bus: the same state, or it says why not."""

from __future__ import annotations

import dataclasses

import pytest

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.config import CentreConfig
from fusion_service.service.shadow import Shadow
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
    lost: numbers of steps whose messages the shadow does not hear."""

    def __init__(self, seed: int, lost: tuple[int, ...] = (), **settings: object) -> None:
        mission = random_missions.fly(seed)
        self.config: CentreConfig = dataclasses.replace(mission.config, **settings)  # type: ignore[arg-type]
        self.given = mission.given
        self.centre = FusionCentre(self.config, generation=GENERATION, epoch=START)
        self.clock = Clock()
        self.shadow = Shadow(self.config, self.clock)
        self.loads: list[str] = []
        self._lost = lost
        self._made = 0

    def step(self) -> GlobalTracks:
        given = self.given[self._made]
        self._made += 1
        for event, received in given.events:
            self.centre.handle(event, received)
            if isinstance(event, (LocalTracks, SensorInfo)) and self._made not in self._lost:
                self.shadow.local(event, "key", b"data", received)
        result = self.centre.step(max(given.time, self.centre.time + 1))
        for message in (result.tracks, result.log):
            self.shadow.output(schemas.decode(schemas.encode(message)))
        for _ in range(2):
            self.clock.now += 1.0
            self.shadow.advance()
        return result.picture

    def load(self, picture: GlobalTracks) -> None:
        self.loads.append(self.shadow.wanted)
        assert self.shadow.load(self.centre.checkpoint(), (START, picture.step)) == ""

    def held(self) -> list[int]:
        """The global tracks of a centre that begins with what the shadow holds."""
        blob, ended, _ = self.shadow.heritage()
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


@pytest.mark.parametrize("seed", [2])
def test_with_steps_made_again_it_says_when_its_tracks_are_others(seed: int) -> None:
    """A checkpoint does not tell what came before it: late data then change the active centre's steps alone."""
    watched = Watched(seed)
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
    blob, ended, _ = shadow.heritage()
    assert blob is None
    assert len(ended) == 0
    assert shadow.left(0) == []
