"""`explain --target`: the story of a true object, of a mission whose story is known."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

import schemas
from fusion_service.cli import main
from fusion_service.recording import Recorder
from fusion_service.recording.scoring import Scoring, scoring_of
from schemas import GlobalTracks, LocalTracks, Message, StepLog, Truth
from tests.helpers.missed import PLACES, SECONDS, mission
from tests.helpers.missions import START


def key(message: Message) -> str:
    if isinstance(message, GlobalTracks | StepLog):
        return schemas.global_key(message.source, "tracks" if isinstance(message, GlobalTracks) else "log")
    if isinstance(message, Truth):
        return schemas.truth_key(message.source)
    return schemas.local_key(message.source, "tracks" if isinstance(message, LocalTracks) else "info")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recorded with a cut-off of 50 m."""
    path = tmp_path_factory.mktemp("target") / "my mission.rrd"
    with Recorder(path, draw=False, cutoff=50.0) as recorder:
        for message in mission():
            recorder.handle(key(message), schemas.encode(message), START)
    return path


def test_who_saw_it_and_which_tracks_followed_it_is_told(flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert scoring_of(flown) == Scoring(50.0, None)
    assert main(["explain", str(flown), "--target", "9"]) == 0
    out = capsys.readouterr().out
    assert "cut-off 50 m" in out
    told = [line.split("  ", 1) for line in out.splitlines() if line[:1].isdigit()]
    spans = {what.strip(): when for when, what in told}
    assert spans["covered by a"] == spans["covered by b"] == f"0.0-{SECONDS:.1f}"
    assert spans["followed by track 90, RMSE 0 m"] == "0.0-6.0"
    assert spans["followed by track 95, RMSE 0 m"] == f"14.0-{SECONDS:.1f}"
    assert spans["no fused track: lost from 6.0 to 14.0: seen by none"] == "6.0-14.0"
    words = shlex.split(next(line for line in out.splitlines() if "fusion-service explain" in line))
    assert words[words.index("explain") + 1] == str(flown)
    assert "It was lost once, and found again once. Without a track for 8.0 s: seen by none 8.0 s." in out


def test_a_target_by_its_name_in_a_table(flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    x, y = PLACES[7]
    rows = [f"{START + k * 10**9},tern,{x},{y}" for k in range(SECONDS + 1)]
    (tmp_path / "gps.csv").write_text("\n".join(["time,id,x,y", *rows]))
    asked = ["explain", str(flown), "--target", "tern", "--truth", str(tmp_path / "gps.csv")]
    assert main(asked) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[1].startswith("target 1 (tern) against the tracks of centre centre")
    assert "no fused track: lost from 9.0: seen, but out of the centre's gate (seen by a)" in out
    assert "velocities: slopes of straight lines through five fixes" in out
    assert main([*asked[:3], "gull", *asked[4:]]) == 1
    assert "no target 'gull' at a scored time; there are: tern" in capsys.readouterr().err


def test_mistakes(flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", str(flown), "--target", "1", "--track", "1"]) == 2
    assert "leave out --track" in capsys.readouterr().err
    assert main(["explain", str(flown), "--cutoff", "1"]) == 2
    assert "go with --target" in capsys.readouterr().err
