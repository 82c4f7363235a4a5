"""The service answers whatever it is at: the heartbeat, what is bounded in a status, and floods of a real service."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import schemas
from fusion_service.bus import Inbox
from fusion_service.service.bounded import MOST_TOLD, BoundedLog
from fusion_service.service.heartbeat import GRACE, Heartbeat
from fusion_service.service.status import MOST_NAMED, StatusMaker
from tests.helpers.processes import Hub, eventually, slowness
from tests.helpers.scene import CONFIG, opened

STALLED = """
import sys, threading, time
from pathlib import Path
from fusion_service.centre import FusionCentre
from fusion_service.config import load_config
from fusion_service.service.daemon import run_service
path, slow = sys.argv[1:]
step = FusionCentre.step
def slowed(centre, at):
    end = time.monotonic() + (4.0 if Path(slow).exists() else 0.0)
    Path(slow).unlink(missing_ok=True)
    while time.monotonic() < end:
        sum(range(1000))
    return step(centre, at)
FusionCentre.step = slowed
run_service(load_config(path), threading.Event())
"""


def test_a_loop_that_is_late_is_spoken_for_and_one_that_is_not_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock of its own."""
    now, said = [100.0], list[tuple[float, bool]]()
    monkeypatch.setattr("fusion_service.service.heartbeat.time", SimpleNamespace(monotonic=lambda: now[0]))
    with Heartbeat(0.1, lambda busy, alive: said.append((busy, alive))) as heart:
        for _ in range(10):
            now[0] += 0.1
            heart.beat()
            time.sleep(0.02)
        assert not said
        heart.turned()
        for count in (1, 2, 3):
            now[0] += 0.1 + 1.1 * GRACE
            eventually(lambda count=count: len(said) == count)  # type: ignore[misc]
    assert all(alive for _, alive in said)
    assert [busy for busy, _ in said] == pytest.approx([k * (0.1 + 1.1 * GRACE) for k in (1, 2, 3)])


def test_a_status_names_a_thousand_sources_and_counts_the_rest() -> None:
    maker = StatusMaker("centre")
    alive = {f"s{k}": True for k in range(300_000)}
    status = maker.make(None, epoch=1, inbox=Inbox[int](10), refused={}, alive=alive, skipped=0)
    assert len(status.sources) == MOST_NAMED + 1
    assert status.sources["*"] == {"more": 300_000 - MOST_NAMED}
    assert schemas.decode(schemas.encode(status)).type == "status"


def test_what_may_be_said_how_often_is_bounded() -> None:
    told = BoundedLog(1.0)
    for number in range(3 * MOST_TOLD):
        assert told.allows(f"note {number}", 600.0)
    assert len(told._told) <= MOST_TOLD


def test_an_inbox_is_bounded_in_bytes() -> None:
    inbox: Inbox[bytes] = Inbox(10_000, slot_bytes=2**26 // 10_000)
    for number in range(200):
        inbox.put(f"s{number % 7}", bytes(2**20), 2**20)
    waiting = inbox.take(0.0)
    assert 50 < len(waiting) <= 64
    assert sum(inbox.dropped.values()) == 200 - len(waiting)


def test_a_service_in_a_step_of_four_seconds_goes_on_saying_its_status(hub: Hub, tmp_path: Path) -> None:
    with opened(hub, tmp_path) as scene:
        config, slow = scene.folder / "centre.toml", scene.folder / "slow"
        config.write_text(CONFIG.format(centre="", endpoint=scene.endpoint, state=scene.folder / "state"))
        scene.start(STALLED, str(config), str(slow))
        scene.sensor("r1", 0)
        eventually(scene.seen.sees(0), 20)
        slow.touch()
        begin = time.monotonic()
        eventually(lambda: scene.last_status().step_time.get("busy", 0.0) > 2.0)
        status = scene.last_status()
        assert any("for" in note and "one step" in note for note in status.notes or ())
        eventually(lambda: "busy" not in scene.last_status().step_time)
        stamps = [begin, *(at for at, _ in scene.seen.statuses if at > begin)]
        assert np.diff(stamps).max() < 2.0 * slowness()  # 1.1 s on a quiet machine; the step takes four
        eventually(scene.seen.sees(0))


@pytest.mark.parametrize("what", ["components", "keys"])
def test_messages_that_would_cost_seconds_are_refused_with_a_reason(hub: Hub, tmp_path: Path, what: str) -> None:
    from benchmarks.floods import FLOODS

    with opened(hub, tmp_path) as scene:
        scene.service()
        scene.sensor("r1", 0, 1)
        eventually(scene.seen.sees(0, 1), 20)
        before = scene.seen.confirmed()
        enough = threading.Event()

        def flood() -> None:
            """Again and again: where the machine is busy most of it is dropped on its way."""
            while not enough.is_set():
                FLOODS[what](scene.bus)
                enough.wait(2.0)

        thread = threading.Thread(target=flood)
        begin = time.monotonic()
        thread.start()
        reason = {"components": "too-many-components", "keys": "not-msgpack"}[what]
        try:
            eventually(lambda: scene.last_status().refused.get(reason, 0) >= 5)
        finally:
            enough.set()
            thread.join()
        eventually(lambda: scene.seen.statuses[-1][0] > time.monotonic() - 0.2)
        stamps = [begin, *(at for at, _ in scene.seen.statuses if at > begin)]
        assert np.diff(stamps).max() < 2.0 * slowness()  # seventeen where they are taken
        assert scene.seen.confirmed() == before
        assert scene.last_status().step_time["failed"] == 0
