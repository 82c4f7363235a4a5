"""Real processes that stand still: the service, the hub. Every id is as before, and none was told to have ended."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.processes import Hub, Program, eventually
from tests.helpers.scene import Scene, opened

PAUSE = 4.0
"""Seconds: more than what ends a track of these sources."""


@pytest.fixture
def scene(hub: Hub, tmp_path: Path) -> Iterator[Scene]:
    with opened(hub, tmp_path) as made:
        yield made


@pytest.mark.parametrize("who", ["service", "hub"])
def test_an_id_outlives_a_pause_of(who: str, scene: Scene, hub: Hub) -> None:
    service = scene.service()
    scene.sensor("r1", 0, 1, 2)
    scene.sensor("r2", 2, 3)
    eventually(scene.seen.sees(0, 1, 2, 3), 20)
    before = scene.seen.confirmed()
    frozen: Program | None = service if who == "service" else hub._program
    assert frozen is not None
    frozen.freeze()
    time.sleep(PAUSE)
    count = len(scene.seen.pictures)
    frozen.signal(signal.SIGCONT)
    eventually(lambda: len(scene.seen.pictures) > count + 5 and scene.seen.sees(0, 1, 2, 3)(), 20)
    assert scene.seen.confirmed() == before
    assert all(set(picture.ids.tolist()) <= set(before.values()) for picture in scene.seen.pictures[count:])
    assert [one for picture in scene.seen.pictures for one in picture.ended] == []
    steps = [event["steps"] for log in scene.seen.logs for event in log.events if event["kind"] == "skipped"]
    told = {event["kind"] for log in scene.seen.logs for event in log.events} & {"suspended", "resumed"}
    assert told or max(steps, default=0) * 0.2 > PAUSE / 2
