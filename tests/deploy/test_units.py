"""The units of systemd: every line is a command of ours, and systemd itself finds nothing wrong with them."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from fusion_service import cli
from fusion_service.config import load_config
from tests.deploy.units import FOLDER, PROGRAM, UNITS, command, settings

EXPOSURE = 2.0
"""Of 10, as `systemd-analyze security` counts it: what is reached from the network, and little else."""
UNWATCHED = ("fusion-console", "fusion-hub")
"""Whose work is done by threads of libraries: a beat of ours would say nothing."""
needs_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")


def test_there_is_a_unit_of_each() -> None:
    assert set(UNITS) == {
        *("fusion-centre", "fusion-console", "fusion-hub", "fusion-metrics", "fusion-recorder", "fusion-standby")
    }


@pytest.mark.parametrize("unit", UNITS)
def test_what_it_starts_is_a_command(unit: str) -> None:
    args = cli._parser().parse_args(command(unit)[3:])
    said = settings(unit)
    assert said["Type"] == ["notify"]
    assert said["ExecReload"] == ["/bin/kill -HUP $MAINPID"]
    assert said["User"] == said["Group"] == ["fusion"]
    assert ("WatchdogSec" in said) == (unit not in UNWATCHED)
    assert args.log_format == "auto"  # JSON under systemd
    for name in ("NoNewPrivileges", "PrivateTmp", "ProtectHome"):
        assert said[name] == ["yes"]
    assert said["ProtectSystem"] == ["strict"]


def test_what_is_written_is_in_the_state_folder() -> None:
    record = cli._parser().parse_args(command("fusion-recorder")[3:])
    assert f"/var/lib/{settings('fusion-recorder')['StateDirectory'][0]}/" == record.out
    config = load_config(FOLDER / "centre.toml")
    assert f"/var/lib/{settings('fusion-centre')['StateDirectory'][0]}" == config.service.state
    assert settings("fusion-standby")["StateDirectory"] == ["fusion/standby"]


def readable(unit: str, folder: Path) -> Path:
    """The unit with a program that there is on this machine."""
    path = folder / f"{unit}.service"
    path.write_text(UNITS[unit].read_text("utf-8").replace(PROGRAM, "/bin/true"), "utf-8")
    return path


@needs_systemd
def test_systemd_finds_nothing_wrong(tmp_path: Path) -> None:
    paths = [readable(unit, tmp_path) for unit in UNITS]
    done = subprocess.run(["systemd-analyze", "verify", "--man=no", *paths], capture_output=True, text=True)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@needs_systemd
def test_they_are_hardened(tmp_path: Path) -> None:
    for unit in UNITS:
        look = ["systemd-analyze", "security", "--offline=true", "--no-pager", str(readable(unit, tmp_path))]
        done = subprocess.run(look, capture_output=True, text=True)
        found = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
        assert found, done.stdout + done.stderr
        assert float(found[1]) <= EXPOSURE, unit
