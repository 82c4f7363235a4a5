"""A recording that has just begun is told from one that cannot be read."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion_service.cli import main
from fusion_service.recording.salvage import HEADER, NOTHING_YET
from fusion_service.recording.verifying import verify
from tests.helpers.damage import spans

WHOLE = (Path(__file__).parents[1] / "recordings" / "tracks.rrd").read_bytes()
FIRST = spans(WHOLE)[0][1]
"""Where the record ends that says which recording it is."""


def written(path: Path, data: bytes) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("length", [0, 3, HEADER, HEADER + 10, FIRST - 1])
def test_every_command_says_that_nothing_is_there_yet(
    length: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = written(tmp_path / "mission.rrd", WHOLE[:length])
    folder = written(tmp_path / "parts" / "0001.rrd", WHOLE[:length]).parent
    for command in ("verify", "evaluate", "explain", "repair"):
        assert main([command, str(file)]) == 1
        assert f"{file}: {NOTHING_YET}" in capsys.readouterr().err
    assert main(["verify", str(folder)]) == 1
    assert f"{folder}: {NOTHING_YET}" in capsys.readouterr().err


def test_one_that_holds_its_name_alone_is_no_alarm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = written(tmp_path / "mission.rrd", WHOLE[:FIRST])
    assert main(["verify", str(file)]) == 0
    assert "nothing has been recorded in it yet" in capsys.readouterr().out


def test_a_part_that_has_just_begun_is_told_beside_the_others(tmp_path: Path) -> None:
    folder = written(tmp_path / "parts" / "0001.rrd", WHOLE).parent
    written(folder / "0002.rrd", b"")
    found = verify(folder)
    assert "part 2 has just begun" in found.notes
    assert found.messages


def test_what_is_no_recording_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for data in (b"RR", b"RRF3" + bytes(20), b"PK", bytes(40), WHOLE[:HEADER] + bytes(100) + WHOLE[FIRST:]):
        file = written(tmp_path / "mission.rrd", data)
        main(["verify", str(file)])
        assert (NOTHING_YET in capsys.readouterr().err) == (data == b"RR")
