"""Late data that cannot be put in their places are counted, and it is said what kept them from it."""

from __future__ import annotations

from typing import Any

import pytest

import schemas
from fusion_service.centre import Centre, Skipped, make_centre
from fusion_service.centre.notes import UNPLACED
from schemas import Status
from tests.centre.test_late import PERIOD, QUICK, SCANS, SECOND, START, fly, ordered, world


def status_of(centre: Centre, data: bytes, at: int) -> Status:
    """After a late message and three steps more."""
    centre.handle(schemas.decode(data), at)
    for k in range(3):
        status = centre.step(at + k * SECOND // 2).status
    assert schemas.decode(schemas.encode(status)).type == "status"
    return status


def note_of(status: Status) -> str:
    (note,) = (note for note in status.notes or () if note.startswith(UNPLACED))
    return note


def test_of_a_step_of_before_a_restart() -> None:
    scans = ordered(world(4))
    held, rest = scans[6][1], [*scans[:6], *scans[7:]]
    before, _, _ = fly(rest, QUICK, stop=8)
    assert "unplaced" not in before.step(START + round(8.5 * PERIOD * SECOND)).status.queue
    after, _ = make_centre(before.config, before.checkpoint())
    status = status_of(after, held, START + 5 * SECOND)
    source = schemas.decode(held).source
    assert status.queue["unplaced"] == 1
    assert status.sources[source]["unplaced"] == 1
    assert note_of(status).startswith(f"{UNPLACED}1 from before this process began")
    assert "late" not in status.queue


def test_of_steps_that_were_let_go_for_want_of_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion_service.centre.history.MOST_COMPONENTS", 30)
    scans = ordered(world(4))
    centre, _, _ = fly([*scans[:18], *scans[19:]], QUICK)
    status = status_of(centre, scans[18][1], START + round((PERIOD * SCANS + 0.5) * SECOND))
    assert "1 of steps that were let go" in note_of(status)


def test_of_what_must_wait_longer_for_its_turn_than_steps_are_kept() -> None:
    scans = [(at + 8 * PERIOD, data) for at, data in ordered(world(2))]
    settings: dict[str, Any] = {**QUICK, "revise": 0.01}
    centre, _, _ = fly(scans, settings, stop=SCANS + 8)
    for k in range(20):
        status = centre.step(START + round((PERIOD * (SCANS + 9 + k)) * SECOND)).status
    assert status.queue["unplaced"] == len(scans)
    assert "revise under [centre] higher" in note_of(status)


def test_of_what_came_while_the_centre_was_behind() -> None:
    scans = ordered(world(4))
    centre, _, _ = fly([*scans[:6], *scans[7:]], QUICK, stop=10)
    centre.handle(Skipped(1), START + 5 * SECOND)
    status = status_of(centre, scans[6][1], START + round(5.5 * SECOND))
    assert "1 while the centre was behind" in note_of(status)


def test_what_is_put_in_its_place_is_not_counted() -> None:
    scans = ordered(world(4))
    centre, _, _ = fly([*scans[:18], *scans[19:]], QUICK)
    status = status_of(centre, scans[18][1], START + round((PERIOD * SCANS + 0.5) * SECOND))
    assert status.queue["late"] == 1
    assert "unplaced" not in status.queue
    assert not any(note.startswith(UNPLACED) for note in status.notes or ())
