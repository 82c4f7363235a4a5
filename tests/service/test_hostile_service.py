"""What would end a service that trusts: it goes on, with the same picture, and says what it refused."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import msgpack
import numpy as np
import pytest

import schemas
from fusion_service.bus import BusError
from tests.helpers.processes import Hub, eventually
from tests.helpers.scene import Scene, opened


@pytest.fixture
def scene(hub: Hub, tmp_path: Path) -> Iterator[Scene]:
    with opened(hub, tmp_path) as made:
        made.service()
        made.sensor("r1", 0, 1)
        eventually(made.seen.sees(0, 1))
        yield made


def goes_on(scene: Scene, before: dict[int, int]) -> bool:
    count = len(scene.seen.pictures)
    eventually(lambda: len(scene.seen.pictures) > count + 3)
    return scene.seen.confirmed() == before and scene.last_status().step_time["failed"] == 0


def info(source: str, seq: int) -> bytes:
    return schemas.encode(
        schemas.SensorInfo(
            source=source, epoch=1, seq=seq, sent=0, frame=schemas.Enu(59.0, -55.0), position=(0.0, 0.0, 0.0),
            period=1.0, motion=schemas.Motion("cv", 1.0),
        )
    )  # fmt: skip


def test_a_token_that_is_no_name(scene: Scene) -> None:
    before = scene.seen.confirmed()
    scene.bus.announce("fusion/v1/local/radar 1/alive")
    scene.bus.announce(schemas.local_key("radar9", "alive"))
    eventually(lambda: scene.said_of("radar9", "alive"))
    assert goes_on(scene, before)
    assert "radar 1" not in scene.last_status().sources


def test_an_order_that_cannot_be_obeyed_is_answered_with_the_reason(scene: Scene) -> None:
    before = scene.seen.confirmed()
    orders: list[object] = [
        {"what": "mute", "source": "radar 2"},
        {"what": "mute", "source": 7},
        {"what": "delete", "track": -1},
        {"what": "delete", "track": 2**64 - 1 + 1.0},
        {"what": "delete"},
        {"what": ["delete"]},
        [],
    ]
    for order in orders:
        with pytest.raises(BusError, match=r"order|name"):
            scene.bus.ask(schemas.global_key("centre", "orders"), msgpack.packb(order))
        assert goes_on(scene, before), order


def test_a_sequence_that_jumps_to_the_end(scene: Scene) -> None:
    before = scene.seen.confirmed()
    publisher = scene.bus.publisher(schemas.local_key("r2", "info"))
    for seq in (0, 2**64 - 1):
        publisher.put(info("r2", seq))
    eventually(lambda: int(str(scene.said_of("r2", "gaps") or 0)) > 2**60)
    assert goes_on(scene, before)


def test_a_state_folder_that_is_gone(scene: Scene) -> None:
    before = scene.seen.confirmed()
    shutil.rmtree(scene.folder / "state")
    eventually(lambda: scene.last_status().step_time["unsaved"] > 0)
    assert goes_on(scene, before)


def test_a_thousand_tracks_in_one_place(scene: Scene) -> None:
    before = scene.seen.confirmed()
    count = 1000
    for name in ("r2", "r3", "r4"):
        now = time.time_ns()
        message = schemas.LocalTracks(
            source=name, epoch=now, seq=0, sent=now, time=now, complete=True, space=("x", "y", "vx", "vy"),
            frame=schemas.Enu(59.0, -55.0), ids=np.arange(1, count + 1, dtype=np.uint64),
            means=np.tile([5e5, 0.0, 0.0, 0.0], (count, 1)), covariances=np.tile(np.eye(4), (count, 1, 1)),
        )  # fmt: skip
        scene.bus.publisher(schemas.local_key(name, "tracks")).put(schemas.encode(message))
    eventually(lambda: scene.seen.pictures[-1].contributor_counts.sum() >= 3 * count, 20)
    near = scene.seen.pictures[-1]
    old = np.isin(near.ids, list(before.values()))
    assert old.sum() == len(before)
    assert scene.last_status().step_time["failed"] == 0


def test_refusals_are_told_before_any_step(hub: Hub, tmp_path: Path) -> None:
    with opened(hub, tmp_path) as scene:
        scene.service(centre='clock = "message"')
        publisher = scene.bus.publisher(schemas.local_key("r1", "tracks"))
        eventually(lambda: scene.seen.statuses)
        for _ in range(3):
            publisher.put(b"garbage")
        eventually(lambda: scene.last_status().refused == {"not-msgpack": 3})
