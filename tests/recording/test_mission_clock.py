"""A wrong `time` stretches no axis: what a recording with one holds, read back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from fusion_service.recording import Recorder, read
from fusion_service.recording.drawing.mission_clock import AHEAD, MissionClock
from schemas import Ecef, Entry, Message, StepLog, encode, global_key, local_key
from tests.helpers.missed import mission
from tests.helpers.missions import FRAME, SECOND, START, STILL, at, info, picture, tracks, truth
from tests.recording.contents import key_of, record, rows, texts

END = 20


def times(path: Path) -> list[int]:
    """The mission times of all rows of all entities."""
    found: list[int] = []
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if not chunk.is_static and "time" in batch.schema.names:
            found += batch.column("time").cast("int64").to_pylist()
    return found


def told(seconds: range, wrong: int, centre: bool = True) -> list[Message]:
    """Two sources and a centre; the time of the first one's messages is divided by `wrong`."""
    said: list[Message] = [info("a"), info("b")]
    for t in seconds:
        right = tracks("a", t, [1], STILL)
        said += [replace(right, time=right.time // wrong), tracks("b", t, [1], STILL)]
        said += [picture(t, [1], STILL)] if centre else []
    return said


@pytest.mark.parametrize("centre", [True, False])
@pytest.mark.parametrize("wrong", [10**9, 10**6, 10**3])
def test_a_time_in_another_unit_is_kept_raw_and_not_drawn(tmp_path: Path, wrong: int, centre: bool) -> None:
    path = tmp_path / "a.rrd"
    said = told(range(END + 1), wrong, centre)
    recorder = record(path, *said)
    assert [raw.data for raw in read(path)] == [encode(message) for message in said]
    found = times(path)
    assert len(found) > 100
    assert min(found) >= START
    assert max(found) <= at(END)
    assert recorder.undrawn["its time is not the mission's"] == END + 1
    assert not rows(path, "/picture/local/a")
    assert len(rows(path, "/picture/local/b")) >= END + 1
    assert any("a: 1 not drawn: its time is not the mission's" in line for line in texts(path, "recorder"))


def test_a_source_whose_messages_are_refused_for_their_time_is_not_drawn_until_one_is_taken(tmp_path: Path) -> None:
    """A source 30 minutes behind: the centre refuses it from its first step on, and takes it after 10 s."""
    path = tmp_path / "a.rrd"
    log = next(message for message in mission() if isinstance(message, StepLog))
    with Recorder(path) as recorder:

        def hear(key: str, message: Message, t: float) -> None:
            recorder.handle(key, encode(message), at(t))

        for t in range(END):
            entry = Entry("a", 1, t, 0, "late" if t < 10 else "")
            taken, refused = ((), (entry,)) if t < 10 else ((entry,), ())
            late = replace(tracks("a", t, [1], STILL), time=at(t) - (1800 * SECOND if t < 10 else 0))
            hear(key_of(picture(t, [1], STILL)), picture(t, [1], STILL), t)
            one = replace(log, seq=t, step=t, time=at(t), taken=taken, refused=refused)
            hear(global_key("centre", "log"), one, t + 0.01)
            hear(local_key("a", "tracks"), late, t + 0.02)
    found = times(path)
    assert (min(found), max(found)) == (START, at(END - 1))
    assert recorder.undrawn == {"its time is not the mission's": 10}


def test_a_mission_of_another_age_is_on_its_own_timeline(tmp_path: Path) -> None:
    """Played back from 1990, or from a laboratory whose clock begins at 0: with no centre, and with one."""
    for begin in (631_152_000 * SECOND, 0):
        for centre in (True, False):
            clock = MissionClock()
            received = START
            assert clock.place(replace(tracks("a", 0, [1], STILL), time=begin), received) is None
            first = replace(tracks("a", 0, [1], STILL), time=begin)
            if centre:
                assert clock.place(replace(picture(0, [1], STILL), time=begin), received) == begin
            else:
                clock.settle([first])
            assert clock.judge(first) == begin
            assert clock.place(replace(first, time=begin + 60 * SECOND), received) == begin + 60 * SECOND


def test_of_sources_that_disagree_the_most_are_right_and_else_the_later() -> None:
    far = 100 * 365 * 86_400 * SECOND
    some: list[Any] = [
        replace(tracks(name, 0, [1], STILL), time=time) for name, time in (("a", 5), ("b", 9), ("c", far))
    ]
    clock = MissionClock()
    clock.settle(some)
    assert [clock.judge(one) for one in some] == [5, 9, None]
    clock = MissionClock()
    clock.settle(some[1:])
    assert [clock.judge(one) for one in some] == [None, None, far]


def test_what_is_ahead_of_the_centre_by_more_than_an_hour_is_not_on_it() -> None:
    clock = MissionClock()
    clock.place(picture(0, [1], STILL), START)
    for off, there in ((AHEAD, True), (AHEAD + 1, False), (-AHEAD, True), (-AHEAD - 1, False)):
        message = replace(truth(0, [1], STILL, frame=FRAME), time=START + off)
        assert (clock.place(message, START) is not None) == there


def test_a_sensor_without_a_place_on_earth_is_said_in_a_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Two sources in ECEF that stand, by their word, in the centre of the Earth."""
    nowhere: dict[str, Any] = {"space": ("x", "y", "z"), "frame": Ecef(), "means": np.zeros((1, 3))}
    said: list[Message] = [info("a", frame=Ecef()), info("b", frame=Ecef())]
    said += [tracks(name, t, [1], [], **nowhere) for t in range(8) for name in "ab"]
    for more in ([], [picture(3, [1], STILL)]):
        path = tmp_path / f"{len(more)}.rrd"
        recorder = record(path, *said, *more)
        assert len(list(read(path))) == len(said) + len(more)
        assert "Traceback" not in caplog.text
        assert recorder.undrawn.total() >= 2
