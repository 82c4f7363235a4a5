"""The demo as a user runs it: a whole mission in real processes, scored from its recording."""

from __future__ import annotations

import json
import math
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from fusion_service.cli import main
from fusion_service.config import ConfigError, centre_config, load_config
from fusion_service.demo import DemoError, plan_mission, run_demo
from fusion_service.demo import run as run_module
from fusion_service.errors import DataError, UsageError
from fusion_service.recording import messages
from schemas import Enu, GlobalTracks, StepLog, Truth
from tests.helpers import fuse_again
from tests.helpers.processes import Program, eventually, slowness

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


def test_three_radars_from_start_to_score(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, scores = tmp_path / "out", tmp_path / "scores.json"
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    arguments = ("--speed", "30", "--live", "--out", str(out), "--json", str(scores))
    with Program(COMMAND, "demo", *arguments, fresh=True) as program:
        assert program.line(60).startswith("three-radars: 300 s")
        line = program.line(60)
        assert line.startswith("look on: rerun --connect rerun+http://127.0.0.1:")
        assert "no screen here" in line
        code, errors = program.end(timeout=90.0)
    assert code == 0, errors
    assert processes_with(str(tmp_path)) == []
    result = json.loads(scores.read_text())
    assert (result["scenario"], result["rule"]) == ("three-radars", "auto")
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
    again = tmp_path / "again.json"
    assert main(["evaluate", result["recording"], "--json", str(again)]) == 0
    (row,) = json.loads(again.read_text())["rows"]
    assert {name: row[name] for name in ("sources", "fused", "shared", "scored")} == {
        name: result[name] for name in ("sources", "fused", "shared", "scored")
    }
    pairs = fuse_again.again(load_config(out / "centre.toml").centre, recorded)
    assert len(pairs) == 31
    assert fuse_again.differing(pairs) == []


def test_ctrl_c_in_the_middle_ends_everything_and_the_recording_opens(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with Program(COMMAND, "demo", "--speed", "10", "--out", str(out), fresh=True) as program:
        eventually(lambda: (out / "radar3.log").exists(), 30)
        eventually(lambda: (out / "mission.rrd").stat().st_size > 100_000, 30)
        begin = time.monotonic()
        program.signal(signal.SIGINT)
        code, errors = program.end()
        assert time.monotonic() - begin < 5.0 * slowness()
    assert code == 0, errors
    assert processes_with(str(tmp_path)) == []
    assert any(isinstance(message, GlobalTracks) for message in messages(out / "mission.rrd"))


def run(folder: Path, **changes: Any) -> None:
    settings: dict[str, Any] = {
        "scenario": "three-radars",
        "rule": "ci",
        "criterion": None,
        "memory": "restart",
        "data": None,
    }
    settings |= {"speed": 30.0, "seed": 1, "out": folder / "out", "json_path": None, "stop": threading.Event()}
    run_demo(**(settings | changes))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rule": "magic"}, "rule: is 'magic', must be one of"),
        ({"criterion": "best"}, "rule_options: ci cannot fuse 1 source here: criterion 'best'"),
        ({"changes": ["gate=2"]}, "gate: is 2, must be a number"),
        ({"changes": ["gat=0.9"]}, "gat: unknown key"),
        ({"changes": ["rule=bci", "rule_options.max_correlation=7"]}, "max_correlation must lie between 0 and 1"),
        ({"changes": ["gate"]}, "--set gate: write KEY=VALUE"),
        ({"changes": ["a\nb=1"]}, "write KEY=VALUE"),
    ],
)
def test_settings_that_cannot_be_are_told_before_anything_is_there(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        run(tmp_path, **changes)
    assert words in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_scores_that_cannot_be_written_are_told_before_anything_is_there(tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    with pytest.raises(DemoError, match="give another file with --json"):
        run(tmp_path, json_path=tmp_path / "taken")
    assert not (tmp_path / "out").exists()


def test_settings_of_the_command_are_above_those_of_the_scenario(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(run_module, "_fly", lambda *_: None)
    stop = threading.Event()
    stop.set()
    out = tmp_path / 'a "b"\\c \U0001f6a2\x7f'
    given = ["rule=bci", "rule_options.max_correlation = 0.5", 'memory = "recursive"', "frame.lat=1"]
    run(tmp_path, out=out, stop=stop, criterion="trace", changes=[*given, "sources.'r.1'.ignore=true"])
    config = load_config(out / "centre.toml")
    assert config.service.state == str(out / "state")
    assert (config.centre.rule, config.centre.memory) == ("bci", "recursive")
    assert config.centre.rule_options == {"criterion": "trace", "max_correlation": 0.5}
    assert config.centre.frame == Enu(1.0, -55.2676093)
    assert config.centre.sources["r.1"].ignore


@pytest.mark.parametrize(
    "arguments",
    [
        ("demo", "--speed", "0"),
        ("demo", "--speed", "nan"),
        ("demo", "--seed", "-1"),
        ("hub", "--listen", "127.0.0.1:7447"),
        ("run", "--connect", "tcp/127.0.0.1:99999"),
        ("record", "--connect", "nonsense"),
    ],
)
def test_bad_values_of_options_are_bad_usage(arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert f"argument {arguments[1]}: {arguments[2]!r} is not " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("scenario", "options", "words"),
    [
        ("two-radars", {}, "unknown scenario"),
        ("three-radars", {"cameras": True}, "--cameras goes with"),
        ("autoferry:2", {"tracker": "imm"}, "--tracker goes with"),
        ("autoferry:2", {}, "--data or in FUSION_DATA"),
        ("mrclam:6", {}, "--data or in FUSION_DATA"),
        ("mrclam:6", {"cameras": True}, "--cameras goes with"),
        ("mrclam:6", {"tracker": "imm"}, "--tracker goes with"),
    ],
)
def test_what_is_no_mission_is_bad_usage(
    scenario: str, options: dict[str, Any], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FUSION_DATA", raising=False)
    with pytest.raises(UsageError, match=words) as caught:
        plan_mission(scenario, **options)
    assert caught.value.exit_code == 2


def test_the_data_may_stand_in_a_folder_of_their_name(tmp_path: Path) -> None:
    inside = tmp_path / "autoferry"
    inside.mkdir()
    times = ((1, 5.0), (2, 95.0), (3, 400.0))  # of a lidar, a radar, a camera
    (inside / "scenario2_detections.json").write_text(json.dumps([{"sensorID": k, "time": t} for k, t in times]))
    with pytest.raises(DataError, match=r"no scenario3_detections\.json in"):
        plan_mission("autoferry:3", data=str(tmp_path))
    for given in (tmp_path, inside):
        plan = plan_mission("autoferry:2", data=str(given))
        assert str(inside) in plan.clients["lidar"]
        assert plan.seconds == 90.0
    (inside / "scenario3_detections.json").touch()
    with pytest.raises(DataError, match=r"scenario3_detections\.json is no file of detections"):
        plan_mission("autoferry:3", data=str(tmp_path))


def test_each_robot_is_two_clients(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no 6/landmarks\.csv in"):
        plan_mission("mrclam:6", data=str(tmp_path))
    (tmp_path / "6").mkdir()
    (tmp_path / "6" / "landmarks.csv").touch()
    plan = plan_mission("mrclam:6", data=str(tmp_path))
    robots = {f"robot{n}{suffix}" for n in range(1, 6) for suffix in ("", "-self")}
    assert set(plan.clients) == {*robots, "truth"}
    assert plan.cutoff == plan.settings(1.0)["period"] == 1.0
    centre_config(plan.settings(1.0))


@pytest.mark.slow
@pytest.mark.skipif("FUSION_DATA" not in os.environ, reason="set FUSION_DATA to the folder of the Autoferry recordings")
def test_autoferry_from_start_to_score(tmp_path: Path) -> None:
    out, scores = tmp_path / "out", tmp_path / "scores.json"
    arguments = ("--scenario", "autoferry:2", "--speed", "30", "--out", str(out), "--json", str(scores))
    with Program(COMMAND, "demo", *arguments, fresh=True) as program:
        code, errors = program.end(timeout=90.0)
    assert code == 0, errors
    result = json.loads(scores.read_text())
    assert set(result["sources"]) == {"lidar", "radar"}
    assert set(result["fused"]) == PARTS
