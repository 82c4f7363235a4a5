"""Backup, restore, upgrade and rollback of the state: docs/backup.md says how, and this that it is so."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import msgpack
import numpy as np
import pytest

from fusion_service.centre import FusionCentre, glance
from fusion_service.centre.checkpoint import CHECKPOINT_VERSION
from fusion_service.config import CentreConfig
from fusion_service.service.bounded import BoundedLog
from fusion_service.service.ordering import OrderDesk
from fusion_service.service.state import State, open_state
from fusion_service.service.stepping import LastingCentre
from tests.centre.worlds import SECOND, START, info, tracks
from tests.checkpoints.make import FRAME, LAST, fly
from tests.helpers.processes import Hub, eventually
from tests.helpers.scene import Scene, opened

KEPT = sorted((Path(__file__).parents[1] / "checkpoints").glob("*.msgpack"))
CONFIG = CentreConfig(period=0.1, lateness=5.0, coast=0.3, rule="ci")
HOLDS = ("generation", "checkpoint", "ended", "born")


# Upgrade


def test_there_is_one_of_each_release() -> None:
    assert [path.stem for path in KEPT] == ["0.2.0", "0.3.0", "0.4.0", "0.5.0", "0.6.0", "0.7.0", "0.8.0"]


@pytest.mark.parametrize("settings", [{}, {"memory": "recursive"}], ids=str)
@pytest.mark.parametrize("path", KEPT, ids=lambda path: path.stem)
def test_the_checkpoint_of_an_earlier_release_goes_on_with_its_ids(path: Path, settings: dict[str, str]) -> None:
    centre = FusionCentre({"period": 1.0, "frame": FRAME, **settings}, checkpoint=path.read_bytes())
    for second, result in zip(range(LAST + 1, LAST + 5), fly(centre, range(LAST + 1, LAST + 5)), strict=True):
        places = dict(
            zip(result.picture.ids.tolist(), result.picture.means[:, 0].round().astype(int).tolist(), strict=True)
        )
        assert places == {1: second, 2: 1000 + second, 3: 2000 + second}
        assert not result.tracks.ended


# Backup while it runs, and restore


class Running:
    """A centre that goes on in `folder`, of which every step ends a track and begins another."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.state = State(folder)
        self.counts: Counter[str] = Counter()
        desk = OrderDesk(lambda order: None)
        self.lasting = LastingCentre(CONFIG, self.state, desk, BoundedLog(1.0), self.counts, lambda: None)
        self.number = self.lasting.centre.time // (SECOND // 10) - START // (SECOND // 10) if self.old else 0
        self.given: set[int] = set()
        self.ended: set[int] = set()
        if not self.old:
            self.lasting.handle(info("r", period=0.1), START)

    @property
    def old(self) -> bool:
        return self.lasting.centre.time > 0

    def step(self, count: int = 1) -> None:
        for _ in range(count):
            self.number += 1
            first = self.number // 5
            ids = list(range(first, first + 3))
            means: list[list[float]] = [[1000.0 * one, 0.0, 0.0, 0.0] for one in ids]
            now = START + self.number * SECOND // 10
            self.lasting.handle(tracks("r", 0.1 * self.number, means, ids, seq=self.number), now)
            made = self.lasting.step(now)
            assert made is not None
            self.given |= set(made.result.picture.ids.tolist())
            self.ended |= {track for track, _, _ in made.result.tracks.ended}
            self.lasting.save(at_once=self.number % 3 == 0)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    (tmp_path / "state").mkdir()
    one = Running(tmp_path / "state")
    one.step(20)
    yield one
    one.state.close()


@pytest.mark.parametrize("order", [HOLDS, HOLDS[::-1]], ids=["forward", "backward"])
def test_a_copy_made_while_it_runs_gives_no_id_twice(running: Running, tmp_path: Path, order: tuple[str, ...]) -> None:
    """Files are copied one by one, with steps between; the centre goes on after the copy, and gives more ids."""
    copy = tmp_path / "copy"
    copy.mkdir()
    before = set(running.ended)
    for name in order:
        shutil.copyfile(running.folder / name, copy / name)
        running.step(4)
    running.step(20)
    restored = Running(copy)
    given = set(running.given)
    running.given = set()
    restored.step(30)
    new = restored.given - given
    assert new
    assert min(new) > max(given)
    assert not restored.given & before  # none comes back that had ended before the copy was begun
    running.step(10)
    assert not running.given & new  # even where both should go on
    restored.state.close()


def test_without_the_checkpoint_ids_are_new(running: Running, tmp_path: Path) -> None:
    """How one restores what no old id may come back of."""
    copy = tmp_path / "copy"
    copy.mkdir()
    shutil.copyfile(running.folder / "generation", copy / "generation")
    restored = Running(copy)
    restored.step(5)
    assert min(restored.given) > max(running.given)
    restored.state.close()


# Two starts of a service; what is read and written by them is tried above.
@pytest.fixture
def scene(hub: Hub, tmp_path: Path) -> Iterator[Scene]:
    with opened(hub, tmp_path) as made:
        yield made


@pytest.mark.slow
def test_a_service_comes_up_from_a_copy_of_its_folder_with_its_ids(scene: Scene, tmp_path: Path) -> None:
    service = scene.service()
    scene.sensor("r1", 0, 1)
    eventually(scene.seen.sees(0, 1), 30)
    before = scene.seen.confirmed()
    state = tmp_path / "state"
    eventually(lambda: glance((state / "checkpoint").read_bytes()).time >= scene.seen.pictures[-1].time - 10**9)
    shutil.copytree(state, tmp_path / "copy")
    service.kill()
    shutil.rmtree(state)
    shutil.copytree(tmp_path / "copy", state)
    count = len(scene.seen.pictures)
    scene.service()
    eventually(lambda: len(scene.seen.pictures) > count and scene.seen.sees(0, 1)(), 30)
    assert scene.seen.confirmed() == before


# Rollback


def test_a_newer_checkpoint_is_set_aside_and_ids_go_on_above(
    running: Running, caplog: pytest.LogCaptureFixture
) -> None:
    """As an older release finds it: of a version that it does not know."""
    running.lasting.save(at_once=True)
    running.state.close()
    path = running.folder / "checkpoint"
    newer = msgpack.unpackb(path.read_bytes()) | {"v": CHECKPOINT_VERSION + 1}
    path.write_bytes(msgpack.packb(newer))
    rolled = Running(running.folder)
    assert f"the checkpoint is of version {CHECKPOINT_VERSION + 1}, this is {CHECKPOINT_VERSION}" in caplog.text
    assert msgpack.unpackb((running.folder / "checkpoint.refused").read_bytes()) == newer
    rolled.step(5)
    assert min(rolled.given) > max(running.given)
    rolled.state.close()


def test_the_checkpoint_of_before_the_upgrade_goes_on_above_the_newest_generation(running: Running) -> None:
    """Put back beside the generation of now: tracks have their ids, new ones are above all that were given since."""
    old = (running.folder / "checkpoint").read_bytes()
    running.step(30)
    running.state.close()
    with open_state(str(running.folder)) as state:
        since = state.new_generation()
    (running.folder / "checkpoint").write_bytes(old)
    for name in ("ended", "born"):
        (running.folder / name).unlink()
    back = Running(running.folder)
    assert back.lasting.generation > since
    back.step(10)
    assert min(back.given - running.given) > max(running.given)
    assert (np.array(sorted(back.given)) >> 32).max() == back.lasting.generation
    back.state.close()
