"""What is on disk when: ids before they are published, the rest once a second and after publishing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion_service.centre import Order
from fusion_service.config import CentreConfig
from fusion_service.service.bounded import BoundedLog
from fusion_service.service.ordering import OrderDesk
from fusion_service.service.state import State
from fusion_service.service.stepping import LastingCentre
from tests.centre.worlds import SECOND, START, info, tracks
from tests.helpers.processes import Hub, eventually
from tests.helpers.scene import Scene, opened


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


@pytest.fixture
def scene(hub: Hub, tmp_path: Path) -> Iterator[Scene]:
    with opened(hub, tmp_path) as made:
        yield made


def test_an_id_that_was_seen_once_is_kept_however_soon_the_service_is_killed(scene: Scene) -> None:
    """Killed with kill -9 as soon as the picture with a new track is seen, twice."""
    scene.sensor("r1", 0)
    service = scene.service("confirm_hits = 1")
    ids: dict[int, int] = {}
    for number in range(2):
        target = number + 1
        scene.sensor(f"n{number}", target)
        eventually(scene.seen.sees(*range(target + 1)), 15)
        service.kill()
        ids |= {target: scene.seen.confirmed()[target]}
        count = len(scene.seen.pictures)
        service = scene.service("confirm_hits = 1")
        eventually(lambda: len(scene.seen.pictures) > count and len(scene.seen.confirmed()) == target + 1, 15)  # noqa: B023
        assert {k: scene.seen.confirmed()[k] for k in ids} == ids
        assert set(scene.seen.pictures[-1].ids.tolist()) == set(scene.seen.confirmed().values())
    born = scene.seen.born()
    assert len(born) == len(set(born)) == 3
