"""What is on disk when: ids before they are published, the rest once a second and after publishing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion_service.centre import FusionCentre, Order
from fusion_service.config import CentreConfig
from fusion_service.service.bounded import BoundedLog
from fusion_service.service.ordering import OrderDesk
from fusion_service.service.state import State
from fusion_service.service.stepping import LastingCentre
from tests.centre.worlds import SECOND, START, info, tracks
from tests.helpers.processes import Hub, eventually
from tests.helpers.scene import Scene, opened
from tests.kills import killed


class Made:
    """A lasting centre, a source, and the checkpoints that it saves."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.saved, self.number = 100.0, 0, 0
        monkeypatch.setattr("fusion_service.service.stepping.time.monotonic", lambda: self.now)
        self.state = State(folder)
        save = self.state.save

        def counted(blob: bytes) -> None:
            self.saved += 1
            save(blob)

        monkeypatch.setattr(self.state, "save", counted)
        desk = OrderDesk(lambda order: None)
        self.counts: Counter[str] = Counter()
        self.config = CentreConfig(period=0.1, lateness=5.0, coast=2.0, rule="ci")
        self.lasting = LastingCentre(self.config, self.state, desk, BoundedLog(1.0), self.counts, lambda: None)
        self.lasting.handle(info("r", period=0.1), START + 100 * SECOND)

    def step(self, *places: float) -> int:
        """A step with these tracks of the source, and how many checkpoints were saved before it is published."""
        self.number += 1
        means: list[list[float]] = [[place, 0.0, 0.0, 0.0] for place in places]
        ids = [1 + round(place) for place in places]
        self.lasting.handle(tracks("r", 0.1 * self.number, means, ids, seq=self.number), START + 100 * SECOND)
        before = self.saved
        made = self.lasting.step(START + self.number * SECOND // 10)
        assert made is not None
        self.result = made.result
        return self.saved - before

    def again(self) -> LastingCentre:
        """As after kill -9."""
        desk = OrderDesk(lambda order: None)
        return LastingCentre(self.config, self.state, desk, BoundedLog(1.0), Counter(), lambda: None)

    def after(self, **how: Any) -> int:
        before = self.saved
        self.lasting.save(**how)
        return self.saved - before


def test_what_is_confirmed_and_orders_are_on_disk_before_they_are_published_and_ended_ids_beside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Made(tmp_path, monkeypatch)
    assert made.step(0.0) == 1, "the run"
    assert made.step(0.0) == 1, "a track is confirmed"
    assert made.step(0.0, 9000.0) == 0, "a track is born"
    assert made.step(0.0, 9000.0) == 1, "it is confirmed"
    made.lasting.handle(Order("mute", "other"), START)
    assert made.step(0.0, 9000.0) == 1, "an order"
    ended: list[int] = []
    for _ in range(30):
        assert made.step(9000.0) == 0
        ended += [track for track, _, _ in made.result.tracks.ended]
        assert State(tmp_path).ended().tolist() == ended
    assert len(ended) == 1
    again = made.again()
    assert ended[0] not in again.centre.view().ids.tolist()
    assert made.result.tracks.ids.tolist() == again.centre.view().ids.tolist()
    made.after(at_once=True)
    assert State(tmp_path).ended().tolist() == []


def test_a_step_that_fails_brings_no_ended_track_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Made(tmp_path, monkeypatch)
    for _ in range(4):
        made.step(0.0, 9000.0)
    gone = made.result.tracks.ids[0]
    while gone in made.result.tracks.ids:
        made.step(9000.0)
    made.lasting.centre.step = None  # type: ignore[method-assign, assignment]
    made.step(9000.0)
    assert made.result.tracks.ids.tolist() == [gone + np.uint64(1)]
    assert made.counts["failed_steps"] == 1


def test_the_rest_is_saved_once_a_second_after_publishing_and_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Made(tmp_path, monkeypatch)
    made.step(0.0)
    made.step(0.0)
    assert made.after() == 0, "nothing has changed since"
    saved = []
    for _ in range(25):
        made.now += 0.1
        assert made.step(0.0) == 0
        saved.append(made.after())
    assert sum(saved) == 2
    assert made.after() == 0
    assert made.after(at_once=True) == 1
    assert made.after(at_once=True) == 0
    assert made.again().centre.time == made.lasting.centre.time


def goes_on(made: Made, lasting: LastingCentre, *places: float, after: float = 0.1) -> list[int]:
    """The ids of a step of the centre that was made again, with these tracks."""
    second = 0.1 * made.number + after
    means: list[list[float]] = [[place, 0.0, 0.0, 0.0] for place in places]
    ids = [1 + round(place) for place in places]
    lasting.handle(tracks("r", second, means, ids, seq=made.number + 1), START + 100 * SECOND)
    result = lasting.step(START + round(second * SECOND))
    assert result is not None
    made.result = result.result
    return [int(one) for one in result.result.tracks.ids]


@pytest.mark.parametrize("how", ["killed", "a step fails"])
def test_a_track_that_began_after_the_checkpoint_has_its_id_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    made = Made(tmp_path, monkeypatch)
    made.step(0.0)
    made.step(0.0)
    assert made.step(0.0, 9000.0, 18000.0) == 0
    ids = [int(one) for one in made.result.tracks.ids]
    assert len(ids) == 3, "two of them are known by their note alone"
    lasting = made.lasting
    if how == "killed":
        lasting = made.again()
        assert lasting.centre.view().ids.tolist() == ids[:1]
        assert goes_on(made, lasting, 0.0, 18000.0, 27000.0, 9000.0)[:3] == ids
    else:
        lasting.centre.step = None  # type: ignore[method-assign, assignment]
        made.step(0.0, 9000.0, 18000.0)
        assert made.counts["failed_steps"] == 1
        assert goes_on(made, lasting, 0.0, 9000.0, 18000.0, after=0.2) == ids
    assert made.result.tracks.ended == ()
    twin = lasting.centre.checkpoint()
    assert FusionCentre(made.config, twin).checkpoint() == twin


def test_an_id_that_nobody_takes_again_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Made(tmp_path, monkeypatch)
    made.step(0.0)
    made.step(0.0)
    made.step(0.0, 9000.0)
    young = int(made.result.tracks.ids[1])
    lasting = made.again()
    ended = []
    for second in range(1, 70):
        assert young not in goes_on(made, lasting, 0.0, after=float(second))
        ended += [track for track, _, _ in made.result.tracks.ended]
        made.number += 1
    assert ended.count(young) == 1


def test_a_checkpoint_far_ahead_of_the_clock_is_set_aside_and_ids_go_on_above_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    made = Made(tmp_path, monkeypatch)
    for _ in range(3):
        made.step(0.0)
    made.after(at_once=True)
    newest = int(made.result.tracks.ids.max())
    monkeypatch.setattr("fusion_service.service.state._by_clock", lambda: 1)
    for back, aside in ((300, False), (86_400, True)):
        now = made.lasting.centre.time / 1e9 - back
        monkeypatch.setattr("fusion_service.service.stepping.time.time", lambda now=now: now)
        again = made.again()
        assert (again.centre.time < 0) is aside
        assert (tmp_path / "checkpoint.ahead").exists() is aside
        assert ("24.0 h ahead of the clock" in caplog.text) is aside
    assert again._generation > newest >> 32
    (tmp_path / "generation").unlink()
    made.state.save(made.lasting.centre.checkpoint())
    monkeypatch.setattr("fusion_service.service.stepping.time.time", lambda: 2e9)
    assert made.again()._generation > newest >> 32


def test_what_has_ended_and_cannot_be_noted_does_not_come_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Made(tmp_path, monkeypatch)
    for _ in range(3):
        made.step(0.0, 9000.0)

    def full(_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(made.state, "note_ended", full)
    monkeypatch.setattr(made.state, "save", full)
    while len(made.result.tracks.ids) == 2:
        made.step(9000.0)
    assert made.counts["unsaved"] > 0
    assert made.again().centre.view().ids.tolist() == []


def test_ids_of_young_tracks_outlive_kills_at_random_moments() -> None:
    """More of them: `python -m tests.kills`."""
    tally = killed(2)
    assert tally.young > 0
    assert (tally.changed, tally.twice, tally.back) == ({}, {}, [])


PATIENT = "confirm_hits = 1\nstale_periods = 100\ncoast_periods = 100"
"""A busy machine takes its time to start the service again: no track ends for that."""


@pytest.fixture
def scene(hub: Hub, tmp_path: Path) -> Iterator[Scene]:
    with opened(hub, tmp_path) as made:
        yield made


def test_an_id_that_was_seen_once_is_kept_however_soon_the_service_is_killed(scene: Scene) -> None:
    """Killed with kill -9 as soon as the picture in which a track is confirmed is seen."""
    scene.sensor("r1", 0)
    service = scene.service(PATIENT)
    scene.sensor("r2", 1)
    eventually(scene.seen.sees(0, 1))
    service.kill()
    ids, count = scene.seen.confirmed(), len(scene.seen.pictures)
    scene.service(PATIENT)
    eventually(lambda: len(scene.seen.pictures) > count and len(scene.seen.confirmed()) == 2)
    assert scene.seen.confirmed() == ids
    assert sorted(scene.seen.pictures[-1].ids.tolist()) == sorted(ids.values())
    born = scene.seen.born()  # the log of the last step before the kill may not have gone out
    assert len(born) == len(set(born))
    assert set(born) <= set(ids.values())
    assert {int(track) for picture in scene.seen.pictures for track in picture.ids} == set(ids.values())
    assert len(set(ids.values())) == 2
