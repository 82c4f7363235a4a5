"""What the demo does to show its mission: a viewer where there is a screen, else the line that opens one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fusion_service.demo import viewer

URL = "rerun+http://127.0.0.1:9/proxy"


def test_a_viewer_is_opened_where_there_is_a_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[list[str]] = []

    def start(command: list[str], **rest: Any) -> None:
        started.append(command)

    monkeypatch.setattr(viewer, "find_program", lambda: Path("/opt/rerun"))
    monkeypatch.setattr("subprocess.Popen", start)
    assert f"rerun --connect {URL}" in viewer.look_on(URL, {"DISPLAY": ":0"})
    assert started == [["/opt/rerun", "--connect", URL]]


def test_where_none_can_be_opened_the_line_that_does_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def start(command: list[str], **rest: Any) -> None:
        raise OSError("no such luck")

    monkeypatch.setattr("subprocess.Popen", start)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr(viewer, "find_program", lambda: Path("/opt/rerun"))
    assert viewer.look_on(URL, {}).startswith(
        f"look on: rerun --connect {URL}   (no viewer is opened: there is no screen"
    )
    assert "no such luck" in viewer.look_on(URL, {"WAYLAND_DISPLAY": "wayland-0"})
    monkeypatch.setattr(viewer, "find_program", lambda: None)
    assert "program is not installed" in viewer.look_on(URL, {"DISPLAY": ":0"})
