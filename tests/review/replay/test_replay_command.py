"""The command `replay`: what it says, its exit codes, and a mission of real processes."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

import schemas
from fusion_service.cli import main
from fusion_service.commands import replay as command
from fusion_service.config import config_hash
from fusion_service.errors import ReviewError
from schemas import GlobalTracks
from tests.helpers import flown
from tests.helpers.flown import Flight, edited, record
from tests.helpers.processes import Hub, Program, eventually
from tests.helpers.scene import COMMAND, opened


def test_mistakes_are_told_before_anything_is_written(mission: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "out.rrd"
    (mission.parent / "parts").mkdir()
    (mission.parent / "parts" / "0001.rrd").touch()
    cases: list[tuple[list[str], int, str]] = [
        (["--rule", "magic", "--out", str(out)], 2, "magic"),
        (["--rule", "ci:criterion", "--out", str(out)], 2, "write NAME or NAME:OPTION=VALUE"),
        (["--rule", "ci:colour=red", "--out", str(out)], 2, "ci has no option 'colour'"),
        (["--set", "gate=7", "--out", str(out)], 2, "gate"),
        (["--set", "gate", "--out", str(out)], 2, "write KEY=VALUE"),
        ([], 2, "nothing to do"),
        (["--verify", "--rule", "ci"], 1, "leave out --rule"),
        (["--out", str(mission)], 1, "exists already"),
        (["--out", str(mission.parent / "parts")], 1, "exists already"),
        (["--out", str(mission.parent)], 1, "exists already"),
        (["--verify", "--json", str(mission)], 1, "is what is read"),
        (["--verify", "--json", str(tmp_path / "gone" / "r.json")], 1, "in a folder that exists"),
        (["--out", str(out), "--config", "nowhere.toml"], 2, "cannot be read"),
        (["--out", str(out), "--centre", "nobody"], 1, "holds no centre 'nobody'"),
    ]
    for arguments, code, words in cases:
        assert main(["replay", str(mission), *arguments]) == code, arguments
        assert words in capsys.readouterr().err
        assert not out.exists()
    assert main(["replay", str(tmp_path / "none.rrd"), "--verify"]) == 1
    assert "no recording at" in capsys.readouterr().err


def test_a_missing_extra_is_told_in_one_line(mission: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["replay", str(mission), "--verify"]) == 1
    errors = capsys.readouterr().err
    assert "pip install -e '" in errors
    assert "[record]'" in errors
    assert len(errors.strip().splitlines()) == 1


def test_the_verdict_is_the_exit_code(flight: Flight, mission: Path, tmp_path: Path, capsys: Any) -> None:
    result = tmp_path / "result.json"
    assert main(["replay", str(mission), "--verify", "--json", str(result)]) == 0
    assert "14 steps made again: equal to the bit" in capsys.readouterr().out
    told = json.loads(result.read_text())
    assert told["verify"]["passed"] is True
    assert told["variants"][0]["config_hash"] == config_hash(flight.config)

    def changed(message: Any) -> Any:
        if isinstance(message, GlobalTracks) and message.step == 3:
            return dataclasses.replace(message, existence=message.existence * 0.5)
        return message

    bad = record(tmp_path / "bad.rrd", edited(flight.log, changed))
    assert main(["replay", str(bad), "--verify"]) == 1
    errors = capsys.readouterr().err
    assert "differs first at step 3" in errors
    assert "existence" in errors
    assert len(errors.strip().splitlines()) == 1


def test_a_service_killed_and_started_again_is_verified_from_its_recording(hub: Hub, tmp_path: Path) -> None:
    """Real processes: hub, sensors, a service that is killed and comes back with its checkpoint, and the recorder."""
    path = tmp_path / "mission.rrd"
    with opened(hub, tmp_path) as scene:
        recorder = scene.start(COMMAND, "record", "--out", str(path), "--connect", scene.endpoint)
        eventually(path.exists, 20)
        scene.sensor("r1", 0, 1, 2)
        scene.sensor("r2", 1, 2, 3)
        service = scene.service('rule = "hmd-ga"\nmemory = "recursive"')
        eventually(scene.seen.sees(0, 1, 2, 3))
        logs: list[bytes] = []
        scene.bus.subscribe(schemas.global_key("centre", "log"), lambda key, data: logs.append(data))
        eventually(lambda: len(scene.seen.pictures) > 10 and logs)
        count = len(logs)
        eventually(lambda: len(logs) > count)  # not between a picture and its log
        service.kill()
        killed = len(scene.seen.pictures)
        service = scene.service('rule = "hmd-ga"\nmemory = "recursive"')
        eventually(lambda: len(scene.seen.pictures) > killed + 10)
        service.signal(flown.SIGTERM)
        assert service.end()[0] == 0
        recorder.signal(flown.SIGTERM)
        assert recorder.end()[0] == 0
    result = tmp_path / "result.json"
    with Program(COMMAND, "replay", str(path), "--verify", "--json", str(result)) as program:
        assert program.end(60) == (0, "")
    told = json.loads(result.read_text())
    assert told["verify"]["compared"] >= 20
    assert told["remarks"] == []
    assert told["variants"][0]["config"]["rule"] == "hmd-ga"


def test_a_verification_that_is_stopped_has_not_passed(mission: Path) -> None:
    """At once, and after some steps: it says how far it came, and ends with code 1."""
    parser = argparse.ArgumentParser()
    command.add(parser)
    args = parser.parse_args([str(mission), "--verify"])

    class Later(threading.Event):
        """Set when it has been asked so often."""

        def __init__(self, limit: int) -> None:
            super().__init__()
            self.left = limit

        def is_set(self) -> bool:
            self.left -= 1
            return self.left < 0

    asked = Later(10**6)
    command.run(args, asked)
    whole = 10**6 - asked.left
    for limit, says in ((0, "stopped"), (whole - 20, r"stopped after [1-9]\d* steps were compared; .*")):
        with pytest.raises(ReviewError, match=f"{says}.* is not verified"):
            command.run(args, Later(limit))
