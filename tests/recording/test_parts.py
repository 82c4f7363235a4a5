"""A mission in parts: nothing is lost between them, each is whole in itself, old ones go, a torn one is gone on."""

from __future__ import annotations

import logging
import os
import signal
import time
from itertools import pairwise
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from fusion_service.bus import open_bus
from fusion_service.cli import main
from fusion_service.commands import arguments
from fusion_service.errors import ReviewError
from fusion_service.recording import Recorder, Rotation, messages, parts, read
from fusion_service.recording.parts import DEFAULT_SIZE, Folder, is_folder
from fusion_service.recording.reader import recording_id
from fusion_service.recording.repair import mend
from schemas import decode, local_key
from tests.helpers.processes import Hub, Program, eventually
from tests.recording.contents import entities, rows, static
from tests.recording.mission import RADARS, Sent, mission

INFOS = [local_key(name, "info") for name in RADARS]


def fly(folder: Path, said: list[Sent], rotation: Rotation, every: int = 20) -> None:
    with Recorder(folder, rotation=rotation) as recorder:
        for number, sent in enumerate(said):
            recorder.handle(sent.key, sent.data, sent.received)
            if number % every == every - 1:
                recorder.tick()


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Sent]]:
    """The first minute of the made-up mission in parts."""
    folder, said = tmp_path_factory.mktemp("parts") / "mission", list(mission(60))
    fly(folder, said, Rotation(size=80_000))
    assert len(parts(folder)) >= 4
    return folder, said


def test_no_message_is_lost_or_told_twice(cut: tuple[Path, list[Sent]]) -> None:
    folder, said = cut
    found = list(read(folder))
    assert [(raw.key, raw.data, raw.received) for raw in found] == [(s.key, s.data, s.received) for s in said]
    assert [raw.arrival for raw in found] == list(range(len(said)))
    assert len(messages(folder)) == len(said)


def test_every_part_is_whole_in_itself(cut: tuple[Path, list[Sent]]) -> None:
    folder, said = cut
    assert [path.name for path in parts(folder)] == [f"{n:04d}.rrd" for n in range(1, len(parts(folder)) + 1)]
    assert len({recording_id(path) for path in parts(folder)}) == 1
    infos = {sent.key: sent.data for sent in said if sent.key in INFOS}
    styled = static(parts(folder)[0], "/picture/local/radar2/ellipses")
    for number, path in enumerate(parts(folder)):
        own = list(read(path))
        assert [raw.arrival for raw in own] == list(range(len(own)))
        assert {raw.key: raw.data for raw in own if raw.key in INFOS} == infos
        reader = RrdReader(path)
        assert reader.blueprints()
        assert len(reader.store().summary())
        assert static(path, "/picture/local/radar2/ellipses") == styled
        assert static(path, "/grid")
        first = min(decode(raw.data).time for raw in own if raw.key not in INFOS)  # type: ignore[union-attr]
        for entity in ("/picture/sensors/radar2", "/picture/sensors/radar2/coverage", "/picture/global/main"):
            stands = rows(path, entity)[0]
            assert stands["time"] <= first + 10**9  # from the beginning, and not from that of the mission
            assert not number or stands["time"] >= first - 2 * 10**9
        assert {"/error/main/1", "/counts/main/confirmed", "/health/main"} <= entities(path)
        assert static(path, "/error/main/1")["SeriesLines:names"] == ["target 1"]


def test_series_begin_anew_and_keep_their_colours(cut: tuple[Path, list[Sent]]) -> None:
    folder, _ = cut
    for entity in ("/error/main/3", "/existence/main/2"):
        looks = [static(path, entity) for path in parts(folder) if entity in entities(path)]
        assert len(looks) >= 3
        assert len({str(look["SeriesLines:colors"]) for look in looks}) == 1


def test_what_a_missing_or_unreadable_part_costs_is_said(
    cut: tuple[Path, list[Sent]], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder, said = cut
    for path in parts(folder):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "0002.rrd").unlink()
    (tmp_path / "0004.rrd").write_bytes(b"rubbish")
    with caplog.at_level(logging.WARNING):
        found = [(raw.key, raw.data) for raw in read(tmp_path)]
    assert "no part 2" in caplog.text
    assert "0004.rrd is not a recording" in caplog.text
    lost = {(raw.key, raw.data) for number in (2, 4) for raw in read(folder / f"000{number}.rrd")}
    assert found == [(sent.key, sent.data) for sent in said if (sent.key, sent.data) not in lost or sent.key in INFOS]
    caplog.clear()
    (tmp_path / "0001.rrd").unlink()
    with caplog.at_level(logging.WARNING):
        keys = [raw.key for raw in read(tmp_path)]
    assert "begins with part 3" in caplog.text
    assert sorted(keys[:3]) == sorted(INFOS)  # a mission whose beginning is deleted has its infos still


def test_a_recorder_goes_on_where_one_was_killed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder, said = tmp_path / "m", list(mission(30))
    fly(folder, said[:60], Rotation())
    content = (folder / "0001.rrd").read_bytes()
    (folder / "0001.rrd").write_bytes(content[:-5000])
    kept = [raw.data for raw in read(folder)]
    with pytest.raises(OSError, match="by another process"), Recorder(folder):
        Recorder(folder)
    assert "torn record cut" in caplog.text
    fly(folder, said[60:], Rotation())
    assert [path.name for path in parts(folder)] == ["0001.rrd", "0002.rrd", "0003.rrd"]
    assert len({recording_id(path) for path in parts(folder)}) == 1
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        assert [raw.data for raw in read(folder)] == kept + [sent.data for sent in said[60:]]
    assert "without a recorder before part 3" in caplog.text


def test_what_lies_in_the_folder_besides_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "0007.rrd").write_bytes(b"no recording")
    (tmp_path / "notes.rrd").write_bytes(b"mine")
    with Recorder(tmp_path) as recorder:
        assert recorder.path.name == "0008.rrd"
    assert (tmp_path / "0007.rrd").read_bytes() == b"no recording"
    assert (tmp_path / "notes.rrd").read_bytes() == b"mine"
    (tmp_path / "a.rrd").touch()
    with pytest.raises(FileExistsError, match="is a file"):
        Recorder(tmp_path / "a.rrd", rotation=Rotation())


def test_old_parts_go_by_size_and_by_age_and_never_the_running_one(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(1, 6):
        (tmp_path / f"{number:04d}.rrd").write_bytes(bytes(100))
        os.utime(tmp_path / f"{number:04d}.rrd", (time.time() - 100 * (6 - number),) * 2)
    current = tmp_path / "0005.rrd"

    def left(rotation: Rotation) -> list[int]:
        folder = Folder(tmp_path, rotation)
        folder.retain(current)
        folder.close()
        return [int(path.stem) for path in parts(tmp_path)]

    assert left(Rotation()) == [1, 2, 3, 4, 5]
    assert left(Rotation(keep_for=450.0)) == [2, 3, 4, 5]
    assert left(Rotation(size=100, keep_size=350)) == [3, 4, 5]
    assert left(Rotation(keep_size=10)) == [5]
    assert "0001.rrd deleted: ended more than 450 s ago" in caplog.text
    assert "0002.rrd deleted: the parts are larger than 350 bytes" in caplog.text


def test_a_full_disk_takes_the_oldest_part_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fly(tmp_path, list(mission(20)), Rotation(size=1))
    before = len(parts(tmp_path))
    assert before > 3
    said = next(iter(mission(1)))
    free = [1 << 40, 0, 0, 1 << 40, 1 << 40]
    with Recorder(tmp_path, rotation=Rotation(keep_for=1e6)) as recorder:
        monkeypatch.setattr(
            "fusion_service.recording.recorder.shutil.disk_usage", lambda path: Room(free.pop(0) if free else 0)
        )
        recorder.handle(said.key, said.data, said.received)
        recorder.tick()
        assert len(parts(tmp_path)) == before + 1
        recorder.tick()
        assert len(parts(tmp_path)) == before - 1
        recorder.tick()
        with pytest.raises(OSError, match="is full but for"):
            recorder.tick()
    assert parts(tmp_path) == [recorder.path]
    assert [raw.data for raw in read(recorder.path)] == [said.data]


class Room:
    def __init__(self, free: int) -> None:
        self.free = free


# ------------------------------------------------------------------ repair


def test_repair_cuts_a_torn_part_and_writes_its_index(
    cut: tuple[Path, list[Sent]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = cut
    path = tmp_path / "0001.rrd"
    content = parts(folder)[0].read_bytes()
    path.write_bytes(content[: int(0.8 * len(content))])
    before = list(read(path))
    with pytest.warns(match="no footer"), pytest.raises(RuntimeError):
        RrdReader(path).store()
    assert main(["repair", str(path)]) == 0
    said = capsys.readouterr().out
    assert "torn record cut at its end" in said
    assert "index written" in said
    assert list(read(path)) == before
    reader = RrdReader(path)
    assert len(reader.store().summary())
    assert reader.blueprints()
    assert recording_id(path) == recording_id(parts(folder)[0])
    assert main(["repair", str(tmp_path)]) == 0
    assert "whole, nothing to be done" in capsys.readouterr().out
    assert [p.name for p in tmp_path.iterdir()] == ["0001.rrd"]


def test_repair_says_what_it_cannot_mend(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["repair", str(tmp_path / "none.rrd")]) == 1
    assert main(["repair", str(tmp_path)]) == 1
    assert "no recordings" in capsys.readouterr().err
    (tmp_path / "0001.rrd").write_bytes(b"rubbish")
    fly(tmp_path, [], Rotation())
    assert main(["repair", str(tmp_path)]) == 1
    said = capsys.readouterr().out.splitlines()
    assert [line.split(": ")[-1] for line in said[1:]] == ["whole, nothing to be done"]
    assert "not a recording" in said[0]
    with pytest.raises(ReviewError, match="not a recording"):
        mend(tmp_path / "0001.rrd")


def test_what_is_being_written_is_not_mended(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Cutting it, or putting a copy in its place, would lose what the recorder writes from then on."""
    said = list(mission(10))
    fly(tmp_path, said[:20], Rotation())
    with Recorder(tmp_path) as recorder:
        before = recorder.path.stat().st_ino
        assert main(["repair", str(tmp_path)]) == 1
        lines = capsys.readouterr().out.splitlines()
        assert [line.split(": ")[1] for line in lines] == [
            "whole, nothing to be done",
            "wait until its recorder has ended",
        ]
        for sent in said[20:]:
            recorder.handle(sent.key, sent.data, sent.received)
    assert recorder.path.stat().st_ino == before
    assert [raw.data for raw in read(tmp_path)] == [sent.data for sent in said]
    assert main(["repair", str(tmp_path)]) == 0


def test_a_folder_in_which_no_part_can_be_begun_is_let_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(path: Path) -> None:
        raise OSError("no")

    with monkeypatch.context() as patch:
        patch.setattr("fusion_service.recording.recorder.parts", broken)
        with pytest.raises(OSError, match="no"):
            Recorder(tmp_path, rotation=Rotation())
    with Recorder(tmp_path, rotation=Rotation()) as recorder:
        assert recorder.path.name == "0001.rrd"


def test_a_part_that_goes_while_it_is_read_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    said = list(mission(10))
    fly(tmp_path, said[:20], Rotation())
    fly(tmp_path, said[20:30], Rotation())
    fly(tmp_path, said[30:], Rotation())
    found = read(tmp_path)
    first = next(found)
    (tmp_path / "0002.rrd").unlink()
    with caplog.at_level(logging.WARNING):
        assert [raw.data for raw in (first, *found)] == [sent.data for sent in (*said[:20], *said[30:])]
    assert "part left out" in caplog.text


def test_repair_leaves_what_is_being_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The index is written into a copy that takes the file's place: a running recorder would go on in the old one."""
    said = list(mission(3))
    path = tmp_path / "mission.rrd"
    with Recorder(path) as recorder:
        for number, sent in enumerate(said):
            recorder.handle(sent.key, sent.data, sent.received)
            if number == len(said) // 2:
                recorder.tick()
                assert main(["repair", str(path)]) == 1
                assert capsys.readouterr().err.count("wait until its recorder has ended") == 1
    assert len(list(read(path))) == len(said)
    assert main(["repair", str(path)]) == 0


def test_a_part_is_free_once_the_next_has_begun(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Recorder(tmp_path, rotation=Rotation(size=10_000)) as recorder:
        for number, sent in enumerate(mission(20)):
            recorder.handle(sent.key, sent.data, sent.received)
            if number % 20 == 0:
                recorder.tick()
        there = parts(tmp_path)
        assert len(there) > 1
        assert main(["repair", str(tmp_path)]) == 1
        told = capsys.readouterr().out.splitlines()
    assert [line.endswith("wait until its recorder has ended") for line in told] == [
        path == there[-1] for path in there
    ]


# ------------------------------------------------------------------ units and the command line


@pytest.mark.parametrize(
    ("text", "value"),
    [("500MB", 5e8), ("1.5 gib", 1.5 * 2**30), ("20GB", 2e10), ("7B", 7), ("2k", 2000), (".5kB", 500)],
)
def test_sizes(text: str, value: float) -> None:
    assert arguments.size(text) == value


@pytest.mark.parametrize(
    ("text", "value"), [("90", 90), ("1h", 3600), ("0.5 s", 0.5), ("15min", 900), ("7d", 604800), ("2W", 1209600)]
)
def test_durations(text: str, value: float) -> None:
    assert arguments.duration(text) == value


@pytest.mark.parametrize("text", ["", "MB", "-1GB", "0", "1e999", "nan", "5 parsecs", "1h30", "9" * 400])
def test_what_is_no_size_or_duration_is_said_in_one_line(text: str) -> None:
    for read_it in (arguments.size, arguments.duration):
        with pytest.raises(ValueError, match=r"is not a (size|duration): give a number") as error:
            read_it(text)
        assert "\n" not in str(error.value)


def test_limits_that_cannot_hold_are_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert Rotation().limit == DEFAULT_SIZE
    assert Rotation(every=5.0).limit is None
    assert Rotation(every=5.0, keep_size=1000).limit == 100
    with pytest.raises(ValueError, match="two parts"):
        Rotation(size=100, keep_size=150)
    command = ["record", "--out", str(tmp_path / "m"), "--rotate-size", "1GB", "--keep-size", "1GB"]
    assert main(command) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    with pytest.raises(SystemExit) as error:
        main(["record", "--rotate-every", "often"])
    assert error.value.code == 2
    assert "'often' is not a duration" in capsys.readouterr().err
    assert is_folder("mission/")
    assert is_folder(tmp_path)
    assert not is_folder("mission.rrd")


LOAD = """
import os, signal, sys, time
sys.path.insert(0, sys.argv[3])
from fusion_service.bus import open_bus
from tests.recording.mission import mission
count = int(sys.argv[2])
with open_bus([sys.argv[1]], wait=60.0) as bus:
    said = [sent for sent in mission(count)]
    publishers = {}
    for sent in said:
        publishers.setdefault(sent.key, bus.publisher(sent.key, cache=2000))
    os.write(1, b"ready\\n")
    sys.stdin.readline()
    for sent in said:
        publishers[sent.key].put(sent.data)
        time.sleep(0.002)
    os.write(1, b"done\\n")
    sys.stdin.readline()
"""


def test_the_process_loses_nothing_when_it_rotates_under_load_and_is_killed(hub: Hub, tmp_path: Path) -> None:
    """Parts of a fraction of a second; killed at the end, gone on with, stopped."""
    folder = tmp_path / "m"
    options = ["--out", str(folder), "--rotate-size", "60kB", "--rotate-every", "0.4s", "--flush", "0.1s"]
    command = ["record", "--connect", hub.endpoint, *options]
    run = f"import sys; from fusion_service.cli import main; sys.exit(main({command!r}))"
    said = list(mission(150))
    with (
        Program(run) as recorder,
        Program(LOAD, hub.endpoint, "150", str(Path(__file__).parents[2])) as load,
    ):
        assert load.line(20) == "ready"
        eventually(lambda: folder.is_dir() and parts(folder), 20)
        load.tell()
        assert load.line(30) == "done"
        eventually(lambda: sum(1 for _ in read(folder)) == len(said), 20, every=0.5)
        recorder.signal(signal.SIGKILL)
        recorder.kill()
    found = list(read(folder))
    assert len(parts(folder)) >= 3
    for key in {sent.key for sent in said}:
        assert [raw.data for raw in found if raw.key == key] == [sent.data for sent in said if sent.key == key]
    assert all(a.received <= b.received for a, b in pairwise(found) if a.key == b.key)
    count = len(parts(folder))
    with Program(run) as recorder, open_bus([hub.endpoint], wait=60.0):
        eventually(lambda: len(parts(folder)) > count, 20)
        recorder.signal(signal.SIGTERM)
        assert recorder.end()[0] == 0
    assert [raw.data for raw in read(folder)][: len(found)] == [raw.data for raw in found]
