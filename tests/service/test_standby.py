"""A centre of two processes: killed, frozen, told to hand over, split: one picture goes on with the same ids."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from fusion_service.cli import main
from tests.helpers.link import Hubs
from tests.helpers.pair import Pair, Watch
from tests.helpers.processes import Hub, Program, eventually, slowness

TARGETS = (0, 1, 2, 3)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def scene(hub: Hub, folder: Path, stack: ExitStack) -> Pair:
    pair = Pair((hub.endpoint, hub.endpoint), folder, stack)
    pair.sensor("r1", 0, 1, 2)
    pair.sensor("r2", 1, 2, 3)
    return pair.started(*TARGETS)


def test_killed_frozen_and_told_the_other_goes_on_and_back(hub: Hub, tmp_path: Path, stack: ExitStack) -> None:
    pair = scene(hub, tmp_path, stack)
    watch, first, second = pair.watch, *pair.programs
    assert first is not None
    assert second is not None
    before = watch.pictures[-1].targets
    assert main(["order", "rename", "--track", str(before[2]), "--name", "PILOT", "--connect", hub.endpoint]) == 0
    first.kill()
    killed = time.monotonic()
    number = len(watch.pictures) - 1
    seen = pair.taken_over(number)
    print("taken over from a killed one after", seen.at - killed, "s")
    assert seen.at - killed < 2.0 * slowness(), "with its session after ten"
    assert seen.targets == before
    assert "PILOT" in (seen.picture.callsign or ())
    eventually(lambda: pair.active() == 1)
    assert watch.status is not None

    pair.centre(0)  # as its supervisor starts it again: it stands by
    eventually(watch.ready, 20)
    second.freeze()
    frozen = time.monotonic()
    number = len(watch.pictures) - 1
    seen = pair.taken_over(number)
    print("from a frozen one after", seen.at - frozen, "s")
    assert seen.at - frozen < 3.0 * slowness()
    assert seen.targets == before
    second.signal(signal.SIGCONT)
    eventually(lambda: pair.active() == 0 and watch.ready(), 20)  # it stood down, and stands by

    number = len(watch.pictures) - 1
    assert main(["order", "handover", "--connect", hub.endpoint]) == 0
    seen = pair.taken_over(number)
    assert seen.targets == before
    assert seen.picture.time - watch.pictures[number].picture.time < 1.2e9 * slowness()
    eventually(lambda: pair.active() == 1 and watch.ready(), 20)
    assert "PILOT" in (watch.pictures[-1].picture.callsign or ())
    assert watch.faults() == []
    assert set(watch.names()) == set(before.values())
    assert all(set(one.picture.ids.tolist()) <= set(before.values()) for one in watch.pictures[number:])
    second.signal(signal.SIGTERM)
    code, said = second.end()
    assert code == 0
    assert "takes over as centre: its token is gone" in said
    assert "stands down: another is active under term" in said


def test_where_the_bus_splits_both_go_on_and_the_later_one_stays(tmp_path: Path, stack: ExitStack) -> None:
    hubs = stack.enter_context(Hubs())
    pair = Pair(hubs.endpoints, tmp_path, stack)
    near, far = pair.watch, Watch(hubs.endpoints[1], stack)
    pair.sensor("r1", 0, 1, 2)
    pair.sensor("r2", 0, 1, 2, hub=1)
    pair.started(0, 1, 2)
    eventually(lambda: far.sees(0, 1, 2))
    before = near.pictures[-1].targets
    hubs.link.cut()
    eventually(lambda: near.status and any("stands by no more" in one for one in near.status.notes or ()))
    eventually(lambda: far.status and any("the bus is split" in one for one in far.status.notes or ()))
    terms = [watch.status.term or 0 for watch in (near, far) if watch.status]
    assert [term % 4 for term in terms] == [0, 1]
    pair.sensor("r3", 7, hub=0)
    pair.sensor("r4", 9, hub=1)
    eventually(lambda: near.sees(0, 1, 2, 7))
    eventually(lambda: far.pictures and 9 in far.pictures[-1].targets)
    assert near.pictures[-1].targets[7] != far.pictures[-1].targets[9]
    hubs.link.mend()
    took = eventually(lambda: far.ready())
    print("whole again after", took)
    eventually(lambda: near.sees(0, 1, 2, 7, 9) and far.sees(0, 1, 2, 7, 9))
    assert max(terms) == terms[1]
    eventually(lambda: pair.active() == 1)
    assert near.pictures[-1].targets == far.pictures[-1].targets
    shown = {**near.names(), **far.names()}
    assert all(len(of) == 1 for of in shown.values())
    first = pair.programs[0]
    assert first is not None
    first.signal(signal.SIGTERM)
    assert f"stands down: another is active under term {terms[1]}" in first.end()[1]
    faults = [one for watch in (near, far) for one in watch.faults()]
    assert all(one.startswith("a picture of run") for one in faults), faults  # on its way when the bus was whole again
    assert set(before.values()) <= set(near.pictures[-1].targets.values())


def test_none_hands_over_to_nobody_and_all_to_one_of_other_settings(
    hub: Hub, tmp_path: Path, stack: ExitStack, capsys: pytest.CaptureFixture[str]
) -> None:
    pair = Pair((hub.endpoint, hub.endpoint), tmp_path, stack)
    lonely: Program = pair.centre(1, standby=True)
    pair.sensor("r1", 0)
    pair.centre(0)
    eventually(lambda: pair.watch.sees(0), 40)  # three processes load
    eventually(pair.watch.ready, 20)
    lonely.kill()
    lonely.__exit__()
    eventually(lambda: not pair.watch.ready())
    assert main(["order", "handover", "--connect", hub.endpoint]) == 1
    assert "no handover: nobody stands by" in capsys.readouterr().err
    pair.centre(1, standby=True, more="gate = 0.98\n")  # an upgrade with other settings: it is copied, not followed
    eventually(pair.watch.ready, 20)
    before, number = pair.watch.pictures[-1].targets, len(pair.watch.pictures) - 1
    assert main(["order", "handover", "--connect", hub.endpoint]) == 0
    assert pair.taken_over(number).targets == before
    assert pair.watch.faults() == []
