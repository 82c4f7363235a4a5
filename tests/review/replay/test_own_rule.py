"""A mission that was fused by a rule of one's own: made again by the very file, and by no other without saying so."""

from __future__ import annotations

from pathlib import Path

import pytest

from fusion_service.cli import main
from fusion_service.errors import ReviewError
from fusion_service.review.replay import run_replay
from fusion_service.rules import RULES, load_own
from tests.helpers.flown import messy, pictures

BODY = """
import numpy as np

def fuse(means, covariances):
    information = np.linalg.inv(covariances).mean(axis=1)
    covariance = np.linalg.inv(information)
    mean = (covariance @ (np.linalg.inv(covariances) @ means[..., None]).mean(axis=1))[..., 0]
    return mean, 0.5 * (covariance + covariance.swapaxes(-1, -2))
"""


def quiet(line: str) -> None: ...


def test_a_mission_is_verified_by_the_file_that_fused_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "my_rule.py"
    file.write_text(BODY)
    name = load_own(f"{file}:fuse")[0].name
    mission = messy({"rule": name}, steps=6, targets=4).record(tmp_path / "mission.rrd")
    monkeypatch.setattr(RULES, "own", {})  # another process, at another time
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ReviewError, match=r"my_rule.py:fuse, SHA-256 [0-9a-f]{16}.*--rule PATH/my_rule.py:fuse"):
        run_replay(mission, verify=True, say=quiet)
    assert not RULES.own, "a recording loads no code, though the file lies beside it"
    assert main(["replay", str(mission), "--verify", "--rule", "my_rule.py:fuse"]) == 0
    assert "equal to the bit" in capsys.readouterr().out

    lines: list[str] = []
    out = tmp_path / "out.rrd"
    run_replay(mission, rules=["my_rule.py:fuse", "naive"], out=out, draw=False, say=lines.append)
    assert {picture.rule for picture in pictures(out, "my_rule")} == {name}

    file.write_text(BODY + "# another\n")
    monkeypatch.setattr(RULES, "own", {})
    with pytest.raises(ReviewError, match=r"another file now: .*nothing can be verified"):
        run_replay(mission, rules=["my_rule.py:fuse"], verify=True, say=quiet)
    run_replay(mission, rules=["my_rule.py:fuse"], out=tmp_path / "other.rrd", draw=False, say=lines.append)
    assert any("is another file now: the mission was fused by that with hash" in line for line in lines)
    shown = pictures(tmp_path / "other.rrd", "my_rule")
    assert len(shown) == 6
    assert shown[0].rule != name
