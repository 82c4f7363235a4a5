"""A service that steps on arrival, and its clients, as processes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import schemas
from schemas import GlobalTracks
from schemas.messages import CONFIRMED
from tests.helpers.processes import Hub, eventually, slowness
from tests.helpers.scene import CONFIG, Scene, opened


@pytest.fixture
def scene(hub: Hub, tmp_path: Path) -> Iterator[Scene]:
    with opened(hub, tmp_path) as made:
        yield made


def test_scans_are_stepped_as_they_come_and_a_reader_has_the_whole_picture(scene: Scene) -> None:
    slow = CONFIG.replace("period = 0.2", "period = 1.0")
    config = scene.folder / "arrival.toml"
    config.write_text(slow.format(centre='trigger = "arrival"', endpoint=scene.endpoint, state=scene.folder / "state"))
    scene.run(config)
    for name, *targets in (("r1", 0, 1), ("r2", 1, 2)):
        scene.sensor(str(name), *targets)
    wholes = schemas.Wholes()
    read, newest = 0, None

    def confirmed() -> int:
        nonlocal read, newest
        for message in scene.seen.pictures[read:]:
            newest = wholes.of(message) or newest
        read = len(scene.seen.pictures)
        return 0 if newest is None else int((newest.status == CONFIRMED).sum())

    eventually(lambda: confirmed() == 3)
    begin = len(scene.seen.pictures)
    eventually(lambda: len(scene.seen.pictures) > begin + 20)
    some: list[GlobalTracks] = scene.seen.pictures[begin:]
    deltas = [one for one in some if one.delta]
    assert len(deltas) > 10
    assert all(len(one.ids) <= 3 for one in deltas)
    assert {one.time // 10**9 for one in some[1:]} <= {one.time // 10**9 for one in some if not one.delta} | {
        some[0].time // 10**9
    }
    assert confirmed() == 3
    assert newest is not None
    [(_, data)] = scene.bus.ask(schemas.global_key("centre", "picture"), timeout=20.0)
    picture = schemas.decode(data)
    assert isinstance(picture, GlobalTracks)
    assert not picture.delta
    assert picture.ids.tolist() == newest.ids.tolist()
    waits = [one.sent - one.time for one in deltas]
    print("ms from the time of a scan to its picture:", np.percentile(waits, (50, 100)) / 1e6)
    assert np.median(waits) < 0.15e9 * slowness(), "much less than the sources' and the centre's period"
