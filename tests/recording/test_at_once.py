"""`record` says what it cannot do before it waits for a hub, which is not there in these tests."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from fusion_service.cli import main
from tests.helpers.processes import free_endpoint


def record(out: Path | str, capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    code = main(["record", "--connect", free_endpoint(), "--out", str(out), *words])
    return code, capsys.readouterr().err


def test_a_place_that_is_no_good_is_told_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, told = record(tmp_path / "nosuch" / "a.rrd", capsys)
    assert code == 1
    assert f"{tmp_path}/nosuch is no folder that exists: make it, or name another place with --out" in told
    (tmp_path / "there.rrd").touch()
    code, told = record(tmp_path / "there.rrd", capsys)
    assert (code, "exists already" in told) == (1, True)
    code, told = record(tmp_path / "there.rrd", capsys, "--rotate-every", "1h")
    assert (code, "exists already" in told) == (1, True)
    code, told = record("/proc/a.rrd", capsys)
    assert (code, told.count("\n"), "/proc cannot be written" in told) == (1, 1, True)
    code, told = record(tmp_path / "a.rrd", capsys, "--name", "a b")
    assert (code, "--name: bad name 'a b'" in told) == (2, True)


def test_a_package_that_is_missing_is_told_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    code, told = record(tmp_path / "a.rrd", capsys)
    assert code == 1
    assert "recording needs rerun-sdk" in told
    assert "[record]'" in told
    assert told.count("\n") == 1
