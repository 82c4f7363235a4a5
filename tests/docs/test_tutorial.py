"""The tutorial as a reader follows it: its files written, its shell lines run by one shell, with real processes.

Only the port differs, and the clone: its `.venv/bin/activate` puts this Python's commands on the path.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from fusion_service.config import load_config
from tests.docs.pages import ROOT, blocks
from tests.helpers.processes import free_endpoint, slowness

BLOCKS = blocks("docs/tutorial.md")
COMMANDS = {"python": "", "fusion-service": "-m fusion_service", "sensor-client": "-m sensor_clients"}
TRACK = re.compile(r"^track (\d+): -?\d+ m east, -?\d+ m north, sigma ([\d.]+), ([\d.]+) m, from (\d) sources$", re.M)


def clone(folder: Path) -> Path:
    """A folder that has `.venv/bin/activate`, as a clone after `make demo`."""
    there = folder / ".venv" / "bin"
    there.mkdir(parents=True)
    for name, module in COMMANDS.items():
        (there / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" -W error {module} "$@"\n', "utf-8")
        (there / name).chmod(0o755)
    (there / "activate").write_text(f'export PATH="{there}:$PATH" PYTHONPATH="{ROOT}"\n', "utf-8")
    return folder


def script() -> str:
    """Who reads takes longer than a recorder needs to begin: it hears the sensors from their first word on."""
    text = "".join(block.text for block in BLOCKS if block.language == "sh")
    starts = "fusion-service record --out mission.rrd --connect $BUS &\n"
    assert starts in text
    text = text.replace(starts, f"{starts}until [ -e mission.rrd ]; do sleep 0.1; done\n")
    assert text.count("tcp/127.0.0.1:7447") == 1
    return "set -eu; trap 'kill $(jobs -p) 2>/dev/null || true' EXIT\n" + text.replace(
        "tcp/127.0.0.1:7447", free_endpoint()
    )


@pytest.mark.skipif(shutil.which("bash") is None, reason="the tutorial's shell is bash")
def test_the_tutorial_runs_as_it_stands(tmp_path: Path) -> None:
    folder = tmp_path / "empty"
    folder.mkdir()
    for block in BLOCKS:
        if block.language in ("python", "toml"):
            name = re.match(r"# (\S+)\n", block.text)
            assert name is not None, block.name
            (folder / name[1]).write_text(block.text, "utf-8")
    load_config(folder / "centre.toml")
    environment = {**os.environ, "CLONE": str(clone(tmp_path / "clone"))}
    pipe, command = subprocess.PIPE, ["bash", "-c", script()]
    shell = subprocess.Popen(
        command, cwd=folder, env=environment, stdout=pipe, stderr=pipe, text=True, start_new_session=True
    )
    try:
        out, errors = shell.communicate(timeout=150 * slowness())
    finally:
        with suppress(ProcessLookupError):
            os.killpg(shell.pid, signal.SIGKILL)
        shell.wait()
    assert shell.returncode == 0, out + errors
    shown = TRACK.findall(out)
    assert len(shown) >= 10, out + errors
    assert [count for *_, count in shown[-2:]] == ["2", "2"]
    for _, *sigmas, count in shown:
        if count == "2":
            assert all(9.7 < float(sigma) < 20 for sigma in sigmas), "above that of independent radars, below twice"
    assert "equal to the bit" in out
    assert (folder / "rules.html").stat().st_size > 10_000
    rows = dict(re.findall(r"^(\S+) +(?:ci|naive|hmd-ga) +2/2 +(.+?) *$", out[out.index("fusions, which") :], re.M))
    assert {"centre", "ci", "naive", "hmd-ga"} <= set(rows)
    assert rows["centre"] == rows["ci"], "the same again"
    rmse, anees = ({name: float(row.split()[column]) for name, row in rows.items()} for column in (3, 5))
    assert rmse["naive"] <= 1.05 * rmse["ci"]
    assert anees["ci"] < 0.75 * anees["naive"]
    assert 0.4 < anees["naive"] < 2.0


def test_what_it_shows_is_what_it_prints() -> None:
    shown = [block.text for block in BLOCKS if block.language == "text"]
    assert len(TRACK.findall(shown[0])) == 2
    assert "ANEES" in shown[1]
