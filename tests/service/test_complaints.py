"""What is kept and said of refusals is bounded, whatever is sent, and stands in a status that can be sent."""

from __future__ import annotations

import logging
import time
from dataclasses import replace

import pytest

import schemas
from fusion_service.centre.notes import unplaced
from fusion_service.config import CentreConfig
from fusion_service.service.bounded import BoundedLog
from fusion_service.service.complaints import MOST_BYTES, MOST_HEARD, MOST_NAMED, MOST_WAITING, Complaints
from schemas import Status
from tests.console.scenes import step_log
from tests.hints.test_tracks import NOW, message

STATUS = Status(
    source="centre", epoch=1, seq=0, sent=1, time=1, step=1, uptime=1.0, rates={}, queue={}, refused={}, dropped={},
    sources={"a": {"alive": True}}, tracks={}, step_time={},
)  # fmt: skip


def complaints() -> Complaints:
    return Complaints(CentreConfig(), BoundedLog(1.0))


def error(data: bytes) -> schemas.MessageError:
    with pytest.raises(schemas.MessageError) as caught:
        schemas.decode(data)
    return caught.value


def test_a_machine_that_reads_the_log_is_told_source_and_reason(caplog: pytest.LogCaptureFixture) -> None:
    complaints().misread("r\x1b1", b"{}", error(b"{}"), NOW)
    (line,) = caplog.records
    assert (getattr(line, "source", None), getattr(line, "reason", None)) == ("r\x1b1", "not-msgpack")


def test_a_flood_of_names_is_bounded_in_memory_lines_and_status(caplog: pytest.LogCaptureFixture) -> None:
    told, fault = complaints(), error(b"{}")
    begin = time.monotonic()
    with caplog.at_level(logging.WARNING):
        for k in range(5 * MOST_NAMED):
            told.misread(f"s{k}", b"{}", fault, NOW)
    assert len(caplog.records) <= 20 * (time.monotonic() - begin + 1)
    assert len(told._last) == MOST_NAMED
    status = told.told_in(STATUS)
    assert len(status.sources) <= MOST_NAMED
    assert schemas.decode(schemas.encode(status)).type == "status"


def test_messages_that_wait_for_a_step_are_bounded() -> None:
    told = complaints()
    for k in range(2 * MOST_WAITING):
        told.heard(f"s{k % 1000}", message(k, (0.0, 0.0)), 100, NOW)
    assert len(told._waiting) == MOST_WAITING
    assert len(told._heard) == MOST_HEARD
    for k in range(10):
        told.heard("large", message(k, (0.0, 0.0)), MOST_BYTES // 3, NOW)
    assert told._bytes <= MOST_BYTES
    assert told._bytes == sum(one.size for one in told._waiting.values())


def test_the_same_refusal_is_counted_and_another_one_stands_instead() -> None:
    told, fault = complaints(), error(b"{}")
    for k in range(5):
        told.misread("a", b"{}", fault, NOW + k)
    last = told.told_in(STATUS).sources["a"]["last_refusal"]
    assert (last["reason"], last["count"]) == ("not-msgpack", 5)
    told.misnamed("a", "b", NOW)
    last = told.told_in(STATUS).sources["a"]["last_refusal"]
    assert (last["reason"], last["count"], last["value"]) == ("source", 1, "b")
    told.refused("a", "repeat", None, NOW)
    assert told.told_in(STATUS).sources["a"]["last_refusal"]["reason"] == "source"


def test_a_source_later_than_delay_is_told_of_in_status_and_log(caplog: pytest.LogCaptureFixture) -> None:
    told = Complaints(CentreConfig(period=0.1, delay=0.05), BoundedLog(1.0))
    arriving = Complaints(CentreConfig(period=0.1, delay=0.05, trigger="arrival"), BoundedLog(1.0))
    for k in range(30):
        one = message(k, (0.0, 0.0))
        for each in (told, arriving):
            each.heard("a", one, 100, one.time + 400_000_000)
    with caplog.at_level(logging.WARNING):
        told.think({"a": True}, None)
        told.think({"a": True}, None)
    said = [one for one in told.told_in(STATUS).sources["a"]["doubts"] if "set delay under [centre]" in one]
    assert len(said) == 1
    assert sum("set delay under [centre]" in record.message for record in caplog.records) == 1
    arriving.think({"a": True}, None)
    assert "set delay" not in str(arriving.told_in(STATUS).sources["a"].get("doubts"))


def test_late_data_that_stay_where_they_came_are_told_of_in_the_log_once(caplog: pytest.LogCaptureFixture) -> None:
    told = complaints()
    status = replace(STATUS, notes=(unplaced({"start": 3}),))
    with caplog.at_level(logging.WARNING):
        told.told_in(status)
        told.told_in(replace(STATUS, notes=(unplaced({"start": 4}),)))
        told.told_in(STATUS)
    assert [record.message for record in caplog.records] == [unplaced({"start": 3})]


def test_a_source_that_is_taken_again_is_said_to_be_well() -> None:
    told, fault = complaints(), error(b"{}")
    for name in ("mended", "half", "silent"):
        told.misread(name, b"{}", fault, NOW)
    entries = {name: schemas.Entry(name, 1, 0, 0, "") for name in ("mended", "half", "new")}
    refused = (schemas.Entry("half", 1, 1, 5, "late"),)
    told.stepped(step_log([], taken=tuple(entries.values()), refused=refused))
    last = {name: said["last_refusal"] for name, said in told.told_in(STATUS).sources.items() if "last_refusal" in said}
    assert {name: "well" in one for name, one in last.items()} == {"mended": True, "half": False, "silent": False}
    assert last["mended"]["well"] > last["mended"]["time"]
    told.misread("mended", b"{}", fault, time.time_ns())
    assert "well" not in told.told_in(STATUS).sources["mended"]["last_refusal"]
