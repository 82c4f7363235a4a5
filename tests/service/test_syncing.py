"""The disk is waited for on another thread; that steps were skipped or made again is not saved before publishing."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from fusion_service.centre import Skipped
from fusion_service.service.state import State
from fusion_service.service.syncing import Syncing, sync_to_disk
from tests.centre.worlds import START, tracks
from tests.helpers.processes import eventually
from tests.service.test_checkpoints import Made


def test_a_slow_disk_holds_nothing_up_and_is_told_of_where_it_fails(tmp_path: Path) -> None:
    state, begun, go_on, fault = State(tmp_path), threading.Event(), threading.Event(), [True]
    synced: list[Path] = []

    def slow(path: Path) -> None:
        begun.set()
        assert go_on.wait(20.0)
        if fault[0]:
            raise OSError(5, "the disk says no")
        sync_to_disk(path)
        synced.append(path)

    state._syncing = Syncing(slow)
    for number in range(3):
        state.save(b"%d" % number)  # returns while the disk is waited for
    assert begun.wait(20.0)
    assert state.load() == b"2"
    assert not state.trouble
    go_on.set()
    eventually(lambda: "power cut: the disk says no" in state.trouble)
    fault[0], state._synced = False, 0.0
    state.save(b"3")
    state.close()  # waits for it
    assert synced == [tmp_path / "checkpoint"]
    assert not state.trouble
    assert State(tmp_path).load() == b"3"


def test_what_is_late_or_skipped_waits_for_no_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = Made(tmp_path, monkeypatch)
    for _ in range(3):
        made.step(0.0)
    assert made.step(0.0) == 0, "nothing is to be told"
    made.lasting.handle(Skipped(2), START)
    assert made.step(0.0) == 0, "steps were skipped"
    assert [event["kind"] for event in made.result.log.events] == ["skipped"]
    made.number += 30  # calm again
    for _ in range(3):
        made.step(0.0)
    late = tracks("r", 0.1 * made.number - 0.05, [[0.5, 0.0, 0.0, 0.0]], [1], seq=made.number + 1000)
    made.lasting.handle(late, START + made.number * 10**8)
    assert made.step(0.0) == 0, "a step was made again"
    assert [event["kind"] for event in made.result.log.events] == ["revised"]
