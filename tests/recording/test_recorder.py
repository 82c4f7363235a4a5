"""What came in is there, byte for byte: after a kill, in a torn file, on a disk that fails, in a flood."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from rerun.chunk import RrdReader

from fusion_service.bus import Bus, open_bus
from fusion_service.recording import RawMessage, Recorder, default_path, messages, read, repair, run_recorder
from schemas import Message, encode, local_key
from tests.helpers import missions
from tests.helpers.processes import Hub, Program, slowness
from tests.recording.contents import entities, key_of, record, rows, texts
from tests.recording.mission import START, Sent, mission

SECOND = 10**9


def test_every_message_is_read_back_as_it_came(flown: tuple[Path, list[Sent]]) -> None:
    path, said = flown
    expected = [RawMessage(n, sent.received, sent.key, sent.data) for n, sent in enumerate(said)]
    assert list(read(path)) == expected
    assert [encode(message) for message in messages(path)] == [sent.data for sent in said]


def test_raw_rows_stand_at_their_mission_time_where_they_have_one(flown: tuple[Path, list[Sent]]) -> None:
    path, said = flown
    times = [item["time"] for item in rows(path, "/raw/local/radar1/tracks")]
    assert times == [s.message.time for s in said if s.key == local_key("radar1", "tracks")]  # type: ignore[union-attr]
    assert [item["time"] for item in rows(path, "/raw/local/radar1/info")] == [None]


def test_what_does_not_decode_is_kept_counted_and_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, good = tmp_path / "a.rrd", missions.tracks("radar", 0, [1], [(1, 2)])
    odd = [("fusion/v1/local/radar/tracks", b"\xc1"), ("fusion/v1/other/a b/c", b""), (key_of(good), encode(good)[:-3])]
    with Recorder(path) as recorder:
        recorder.handle(key_of(good), encode(good), START)
        for key, data in odd:
            recorder.handle(key, data, START + 1)
    assert [(raw.key, raw.data) for raw in read(path)] == [(key_of(good), encode(good)), *odd]
    assert recorder.undecodable.total() == len(odd)
    told = sorted(text.split("  ", 1)[1] for text in texts(path, "recorder"))
    assert told == [
        "1 messages on fusion/v1/other/a b/c do not decode: not-msgpack",
        "2 messages on fusion/v1/local/radar/tracks do not decode: not-msgpack",
    ]
    with caplog.at_level(logging.WARNING):
        assert [encode(message) for message in messages(path)] == [encode(good)]
    assert "3 messages do not decode" in caplog.text


def test_a_recording_is_never_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.rrd"
    path.write_bytes(b"precious")
    with pytest.raises(FileExistsError, match=r"a\.rrd exists already"):
        Recorder(path)
    assert path.read_bytes() == b"precious"
    monkeypatch.setattr("fusion_service.recording.process.datetime", FrozenClock)
    names = []
    for _ in range(3):
        names.append(default_path(tmp_path).name)
        (tmp_path / names[-1]).touch()
    assert len(set(names)) == 3


class FrozenClock:
    @staticmethod
    def now(zone: object) -> FrozenClock:
        return FrozenClock()

    def strftime(self, form: str) -> str:
        return "mission-now"


def test_what_is_no_recording_is_said_so(tmp_path: Path) -> None:
    (tmp_path / "a.rrd").write_bytes(b"hello")
    with pytest.raises(ValueError, match="is not a recording"):
        list(read(tmp_path / "a.rrd"))
    with pytest.raises(FileNotFoundError, match="no recording"):
        list(read(tmp_path / "b.rrd"))


def test_an_empty_recording_opens(tmp_path: Path) -> None:
    with Recorder(tmp_path / "a.rrd"):
        pass
    assert list(read(tmp_path / "a.rrd")) == []


@pytest.mark.parametrize("torn", [0, 1, 9, 700])
def test_a_file_that_ends_anywhere_gives_all_that_is_whole(tmp_path: Path, torn: int) -> None:
    said = list(mission(6))
    recorder = Recorder(tmp_path / "a.rrd", draw=False)
    sizes = []
    for sent in said:
        recorder.handle(sent.key, sent.data, sent.received)
        recorder.tick()
        sizes.append(os.path.getsize(recorder.path))
    whole = sizes[-1] - torn
    (tmp_path / "torn.rrd").write_bytes(recorder.path.read_bytes()[:whole])
    recorder.close()
    found = [raw.data for raw in read(tmp_path / "torn.rrd")]
    count = sum(size <= whole for size in sizes)
    assert count >= len(said) - 5
    assert found == [sent.data for sent in said[: len(found)]]
    assert len(found) - count in (0, 1), "the seal of a message comes after it, and may be all that is torn"


@pytest.mark.parametrize("torn", [0, 1, 30, 45, 60, 200, 2000, 20_000])
def test_a_torn_recording_opens_once_it_is_repaired(flown: tuple[Path, list[Sent]], tmp_path: Path, torn: int) -> None:
    """Cut in its index, behind it and before it."""
    path = tmp_path / "torn.rrd"
    content = flown[0].read_bytes()
    path.write_bytes(content[: len(content) - torn])
    before = [raw.data for raw in read(path)]
    cut = repair(path)
    assert torn or not cut
    assert path.read_bytes() == content[: len(content) - torn - cut]
    assert repair(path) == 0
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "RRD file has no footer")
        reader = RrdReader(path)
    assert len(reader.recordings()) == 1
    assert reader.blueprints()
    assert [raw.data for raw in read(path)] == before == [sent.data for sent in flown[1]][: len(before)]
    assert len(before) > 700


FILL = """
import os, resource, sys
sys.path.insert(0, sys.argv[2])
from tests.recording.mission import mission
from fusion_service.recording import Recorder, recorder as module
module.FLUSH = 1.0
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
with Recorder(sys.argv[1]) as recorder:
    for sent in mission(100):
        recorder.handle(sent.key, sent.data, sent.received)
        recorder.tick()
"""


def test_a_disk_that_fails_ends_the_recorder_with_an_error_and_keeps_what_is_on_it(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    with Program(FILL, str(path), str(Path(__file__).parents[2])) as program:
        code, errors = program.end(30)
    assert code == 1
    assert f"OSError: cannot write to {path} any more" in errors
    said = [sent.data for sent in mission(100)]
    found = [raw.data for raw in read(path)]
    assert len(found) >= 3
    assert found == said[: len(found)]


def test_a_disk_that_fills_up_ends_the_recording_in_good_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said = list(mission(1))
    recorder = Recorder(tmp_path / "a.rrd")
    recorder.handle(said[0].key, said[0].data, said[0].received)
    monkeypatch.setattr("fusion_service.recording.recorder.RESERVE", 1 << 62)
    with pytest.raises(OSError, match="is full but for"), recorder:
        recorder.tick()
    assert [raw.data for raw in read(tmp_path / "a.rrd")] == [said[0].data]
    assert len(RrdReader(tmp_path / "a.rrd").store().summary())  # the index is there


# ------------------------------------------------------------------ the process on the bus

RECORD = """
import os, signal, sys, threading
from fusion_service.bus import open_bus
from fusion_service.recording import run_recorder
stop = threading.Event()
signal.signal(signal.SIGTERM, lambda *_: stop.set())
def say(recorder):
    os.write(1, f"{recorder.messages}\\n".encode())
with open_bus([sys.argv[1]], stop=stop) as bus:
    run_recorder(bus, sys.argv[2], realm="sea/north", stop=stop, interval=0.1, on_tick=say)
"""


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_a_recorder_that_is_killed_or_stopped_leaves_all_it_wrote(
    hub: Hub, tmp_path: Path, end: signal.Signals
) -> None:
    path = tmp_path / "new" / "a.rrd"
    said = [(sent.key.replace("fusion/", "sea/north/"), sent.data) for sent in mission(5)]
    with Program(RECORD, hub.endpoint, str(path)) as program, open_bus([hub.endpoint], wait=60.0) as bus:
        publishers = {key: bus.publisher(key, cache=100) for key, _ in said}
        program.line(20)
        begin = time.time_ns()
        token = bus.announce("sea/north/v1/local/radar1/alive")
        for key, data in said:
            publishers[key].put(data)
        while int(program.line()) < len(said):
            pass
        token.close()
        done = time.time_ns()
        for _ in range(4):  # that the token is gone comes by itself, and is in no count
            program.line()
        stopped = time.monotonic()
        program.signal(end)
        program.end()
        assert time.monotonic() - stopped < 2.0 * slowness()
    found = list(read(path))
    assert sorted((raw.key, raw.data) for raw in found) == sorted(said)
    assert [raw.arrival for raw in found] == list(range(len(said)))
    assert all(begin <= raw.received <= done for raw in found)
    for key in publishers:
        assert [raw.data for raw in found if raw.key == key] == [data for name, data in said if name == key]
    if end == signal.SIGTERM:
        assert any("left the bus" in text for text in texts(path, "sources"))


class Flood:
    """A bus on which three messages come at once, before anybody takes one."""

    def watch(self, key: str, put: Callable[..., None]) -> Flood:
        return self

    def subscribe(self, key: str, put: Callable[..., None], on_miss: Callable[..., None]) -> Flood:
        for sent in list(mission(1))[:3]:
            put("fusion/v1/local/a/tracks", sent.data)
        return self

    def close(self) -> None:
        pass


def test_what_is_dropped_just_before_the_end_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion_service.recording.process.CAPACITY", 1)
    stop = threading.Event()
    stop.set()
    recorder = run_recorder(cast(Bus, Flood()), tmp_path / "a.rrd", stop=stop)
    assert recorder.messages == 1
    assert any("2 messages on fusion/v1/local/a/tracks were lost" in text for text in texts(recorder.path, "recorder"))


# ------------------------------------------------------------------ it keeps up


def test_a_thousand_tracks_a_second_take_little_of_it(tmp_path: Path) -> None:
    places = np.random.default_rng(1).uniform(-1e4, 1e4, (100, 2))
    said = [(s, missions.tracks(f"radar{n}", s, range(100), places)) for s in range(10) for n in range(10)]
    coded = [(key_of(message), encode(message), START + s * SECOND) for s, message in said]
    with Recorder(tmp_path / "a.rrd", frame=missions.FRAME) as recorder:
        begin = time.process_time()
        for number, (key, data, received) in enumerate(coded):
            recorder.handle(key, data, received)
            if number % 10 == 9:
                recorder.tick()
        used = time.process_time() - begin
    assert used < 5.0  # of ten seconds


def test_closing_twice_changes_nothing(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "a.rrd")
    recorder.close()
    content = recorder.path.read_bytes()
    recorder.close()
    assert recorder.path.read_bytes() == content


def test_a_flood_of_sources_and_tracks_is_recorded_and_only_partly_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fusion_service.recording.drawing.scene.MAX_SOURCES", 3)
    monkeypatch.setattr("fusion_service.recording.drawing.scene.MAX_TRACKS", 10)
    monkeypatch.setattr("fusion_service.recording.drawing.scene.MAX_ASSESSED", 2)
    places = np.zeros((11, 2))
    said: list[Message] = [missions.tracks(f"radar{n}", 0, [1], [(n, n)]) for n in range(5)]
    said += [missions.tracks("radar0", 1, range(11), places), missions.picture(1, range(3), places[:3])]
    path = tmp_path / "a.rrd"
    recorder = record(path, *said)
    assert [raw.data for raw in read(path)] == [encode(message) for message in said]
    drawn = {name for name in entities(path) if name.startswith("/picture/local/") and name.count("/") == 3}
    assert drawn == {"/picture/local/radar0", "/picture/local/radar1", "/picture/local/radar2"}
    assert len(rows(path, "/picture/local/radar0")) == 1
    assert recorder.undrawn == {"more than 3 sources": 2, "more than 10 tracks": 1, "more than 2 tracks to assess": 1}
