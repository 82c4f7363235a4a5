"""A service that is behind: what it leaves out, what it says, and that its tracks do not suffer for it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre, Refused
from fusion_service.config import CentreConfig
from fusion_service.service.overload import HOLD, Overload, overtaken
from fusion_service.service.timing import StepTimes
from schemas.messages import COASTING, CONFIRMED
from tests.centre.worlds import SECOND, START, info, tracks
from tests.helpers.processes import Hub, eventually, slowness
from tests.helpers.scene import CONFIG, Scene, opened

SLOW = """
import sys, threading, time
from pathlib import Path
from fusion_service.centre import FusionCentre
from fusion_service.config import load_config
from fusion_service.service.daemon import run_service
path, slow = sys.argv[1:]
step = FusionCentre.step
def slowed(centre, at):
    time.sleep(0.6 if Path(slow).exists() else 0.0)
    return step(centre, at)
FusionCentre.step = slowed
run_service(load_config(path), threading.Event())
"""


def scan(source: str, at: float, seq: int, **changes: Any) -> tuple[str, bytes]:
    return source, schemas.encode(tracks(source, at, [[0.0, 0, 0, 0]], seq=seq, **changes))


def left(*items: tuple[str, bytes]) -> tuple[list[int], dict[str, int]]:
    """Which of the items are left, and what went by source."""
    kept, gone = overtaken(items, lambda item: item)
    return [k for k, item in enumerate(items) if any(one is item for one in kept)], dict(gone)


def test_the_newest_complete_scan_of_a_source_is_left_whatever_the_order_and_of_each_run_its_own() -> None:
    assert left(scan("a", 2, 2), scan("b", 1, 1), scan("a", 1, 1), scan("a", 3, 3)) == ([1, 3], {"a": 2})
    assert left(scan("a", 3, 3), scan("a", 2, 2), scan("a", 1, 1, epoch=2)) == ([0, 1, 2], {})
    assert left(scan("a", 3, 1), scan("a", 3, 2)) == ([1], {"a": 1})
    assert left() == ([], {})


def test_partial_scans_and_what_cannot_be_read_stay() -> None:
    partial = scan("a", 2, 2, complete=False)
    assert left(scan("a", 1, 1), partial, scan("a", 3, 3)) == ([1, 2], {"a": 1})
    assert left(scan("a", 1, 1), scan("a", 2, 2, complete=False)) == ([0, 1], {})
    for bad in (b"", b"\xc1", b"\x81", b"\xdf\xff\xff\xff\xff", b"\x81\xa4type", bytes(17 * 2**20), b"\x91" * 5000):
        assert left(scan("a", 1, 1), ("a", bad), scan("a", 3, 3)) == ([1, 2], {"a": 1})
    nobody: list[tuple[str, object]] = [("", object()), ("", object())]
    assert overtaken(nobody, lambda item: None)[0] == nobody


def test_a_delta_overtakes_no_picture_and_a_full_one_does() -> None:
    centre = FusionCentre({"trigger": "arrival", "period": 1.0, "frame": {"kind": "enu", "lat": 59.0, "lon": -55.0}})
    data = []
    for k in range(1, 12):
        centre.handle(tracks("r", 0.1 * k, [[0.0, 0, 0, 0]], seq=k), START)
        data.append(("global/x", schemas.encode(centre.step(START + k * SECOND // 10).tracks)))
    full = [k for k, (_, one) in enumerate(data) if not schemas.decode(one).delta]  # type: ignore[union-attr]
    assert full == [0, 9]
    assert left(*data) == ([k for k in range(11) if k != 0], {"global/x": 1})


def test_it_is_behind_while_there_are_signs_of_it_and_a_second_longer() -> None:
    one = Overload(0.1)
    assert not one.look(0.0, 0.2, 0)
    assert one.look(1.0, 0.3, 0)
    assert one.since == 1.0
    assert one.look(1.0 + 0.9 * HOLD, 0.0, 0)
    assert not one.look(1.0 + HOLD, 0.0, 0)
    assert not one.look(10.0, 0.0, 1)
    assert one.look(10.5, 0.0, 2)
    assert one.look(10.4 + HOLD, 0.0, 2)
    assert not one.look(10.5 + HOLD, 0.0, 2)
    assert not Overload(float("inf")).look(0.0, 1e6, 0)


def test_by_the_messages_time_steps_are_skipped_only_while_they_take_longer_than_they_stand_for() -> None:
    times = StepTimes(CentreConfig(clock="message", period=0.1, lateness=0.0))

    def due(at: float) -> list[float]:
        assert times.fault(tracks("r", at, [[0.0, 0, 0, 0]]), START + 10 * SECOND) == ""
        found = []
        while (step := times.due(START, 0)) is not None:
            found.append(round((step - START) / SECOND, 3))
        return found

    assert due(0.5) == [0.5]
    assert due(1.0) == [0.6, 0.7, 0.8, 0.9, 1.0]
    for _ in range(5):
        times.made(0.5)
    assert due(1.5) == [1.5]
    assert (times.skipped, times.untold(), times.untold()) == (4, 4, 0)
    for _ in range(10):
        times.made(0.01)
    assert due(2.0) == [1.6, 1.7, 1.8, 1.9, 2.0]
    assert times.untold() == 0


@pytest.mark.parametrize("told", [True, False])
def test_a_source_of_which_data_were_dropped_is_not_silent(told: bool) -> None:
    centre = FusionCentre({"period": 0.1, "delay": 0.0, "lateness": 5.0, "coast": 0.3})
    now = START + 3 * SECOND
    centre.handle(info("r", period=0.1), now)
    statuses: dict[int, list[int]] = {}
    ids = set()
    for k in range(1, 31):
        if k <= 12 or k > 24:
            centre.handle(tracks("r", 0.1 * k, [[0.0, 0, 0, 0]], seq=k), now)
        elif told:
            centre.handle(Refused("r", "queue", 1, dropped=True), now)
        picture = centre.step(START + k * SECOND // 10).tracks
        statuses[k] = picture.status.tolist()
        ids.update(picture.ids.tolist())
    assert statuses[12] == statuses[30] == [CONFIRMED]
    assert [statuses[k] for k in (15, 24)] == ([[CONFIRMED]] * 2 if told else [[COASTING], []])
    assert len(ids) == 2 - told


@pytest.fixture
def scene(hub: Hub, tmp_path: Path) -> Iterator[Scene]:
    with opened(hub, tmp_path) as made:
        yield made


def test_a_service_that_is_behind_says_so_loses_and_doubles_nothing_and_recovers(scene: Scene) -> None:
    config, slow = scene.folder / "centre.toml", scene.folder / "slow"
    config.write_text(CONFIG.format(centre="", endpoint=scene.endpoint, state=scene.folder / "state"))
    scene.start(SLOW, str(config), str(slow))
    for name in ("r1", "r2"):
        scene.sensor(name, 0, 1, 2)
    eventually(lambda: scene.seen.sees(0, 1, 2)() and len(scene.seen.feeders(scene.seen.confirmed()[0])) == 2)
    before, first = scene.seen.confirmed(), len(scene.seen.pictures)
    slow.touch()
    eventually(lambda: "overload" in scene.last_status().step_time and scene.last_status().queue["overtaken"] >= 4)
    eventually(lambda: scene.last_status().dropped)  # told by the next step
    status = scene.last_status()
    assert status.step_time["skipped"] > 0
    assert status.step_time["latency"] > 0.5
    assert any(note.startswith("overload") for note in status.notes or ())
    assert sum(status.dropped.values()) > 0
    time.sleep(1.0)
    slow.unlink()
    ended = time.monotonic()
    eventually(lambda: "overload" not in scene.last_status().step_time and not scene.last_status().notes)
    at = next(at for at, one in reversed(scene.seen.statuses) if "overload" in one.step_time)
    assert at - ended < 2.0 * slowness()
    assert scene.seen.confirmed() == before
    for picture in scene.seen.pictures[first:]:
        assert sorted(picture.ids.tolist()) == sorted(before.values())
        assert (picture.status == CONFIRMED).all()
        assert (picture.contributor_counts == 2).all()
    events = [event for log in scene.seen.logs for event in log.events if event["kind"] == "skipped"]
    assert sum(event["steps"] for event in events) > 0
    overtook = [entry for log in scene.seen.logs for entry in log.dropped if entry.reason == "overtaken"]
    assert np.sum([entry.count for entry in overtook]) >= 4
