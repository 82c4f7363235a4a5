"""The demo as a user runs it: a whole mission in real processes, scored from its recording."""

from __future__ import annotations

import json
import math
import os
import signal
import time
from pathlib import Path

import fuse_again
import pytest
from processes import Program, eventually

from fusion_service.config import load_config
from fusion_service.recording import messages
from schemas import GlobalTracks, StepLog, Truth

COMMAND = "import sys\nfrom fusion_service.cli import main\nraise SystemExit(main(sys.argv[1:]))"
PARTS = {
    "gospa",
    "gospa_localisation",
    "gospa_missed",
    "gospa_false",
    "rmse_position",
    "anees",
    "identity_switches",
}


def processes_with(text: str) -> list[int]:
    """Processes with `text` among their arguments."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                command = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if text.encode() in command and int(entry.name) != os.getpid():
                found.append(int(entry.name))
    return found


def test_three_radars_from_start_to_score(tmp_path: Path) -> None:
    out, scores = tmp_path / "out", tmp_path / "scores.json"
    with Program(COMMAND, "demo", "--speed", "30", "--out", str(out), "--json", str(scores)) as program:
        code, errors = program.end(timeout=90.0)
    assert code == 0, errors
    assert processes_with(str(tmp_path)) == []
    result = json.loads(scores.read_text())
    assert (result["scenario"], result["rule"]) == ("three-radars", "ci")
    assert set(result["sources"]) == {"radar1", "radar2", "radar3"}
    for numbers in (*result["sources"].values(), result["fused"]):
        assert set(numbers) == PARTS
        assert all(math.isfinite(value) for value in numbers.values())
    fused = result["fused"]
    assert fused["gospa"] < min(one["gospa"] for one in result["sources"].values())
    shared = result["shared"]["seen_by_2_or_more"]
    assert shared["fused_rmse"] < shared["best_rmse"]
    assert shared["fused_anees"] < 1.2
    assert (out / "map.png").read_bytes()[:4] == b"\x89PNG"
    recorded = messages(result["recording"])
    pictures = [message for message in recorded if isinstance(message, GlobalTracks)]
    logs = [message for message in recorded if isinstance(message, StepLog)]
    assert len(pictures) == len(logs) == 31
    assert any(isinstance(message, Truth) for message in recorded)
    pairs = fuse_again.again(load_config(out / "centre.toml").centre, recorded)
    assert len(pairs) == 31
    assert fuse_again.differing(pairs) == []


def test_ctrl_c_in_the_middle_ends_everything_and_the_recording_opens(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with Program(COMMAND, "demo", "--speed", "10", "--out", str(out)) as program:
        eventually(lambda: (out / "radar3.log").exists(), 30)
        eventually(lambda: (out / "mission.rrd").stat().st_size > 100_000, 30)
        begin = time.monotonic()
        program.signal(signal.SIGINT)
        code, errors = program.end()
        assert time.monotonic() - begin < 5.0
    assert code == 0, errors
    assert processes_with(str(tmp_path)) == []
    assert any(isinstance(message, GlobalTracks) for message in messages(out / "mission.rrd"))


@pytest.mark.skipif("FUSION_DATA" not in os.environ, reason="set FUSION_DATA to the folder of the Autoferry recordings")
def test_autoferry_from_start_to_score(tmp_path: Path) -> None:
    out, scores = tmp_path / "out", tmp_path / "scores.json"
    arguments = ("--scenario", "autoferry:2", "--speed", "30", "--out", str(out), "--json", str(scores))
    with Program(COMMAND, "demo", *arguments) as program:
        code, errors = program.end(timeout=90.0)
    assert code == 0, errors
    result = json.loads(scores.read_text())
    assert set(result["sources"]) == {"lidar", "radar"}
    assert set(result["fused"]) == PARTS
