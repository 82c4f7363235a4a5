"""Children that end with their parent, whatever kills it: the crew of a demo."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path

import pytest

from fusion_service.lifeline import VARIABLE, end_with_parent
from tests.helpers.processes import Program, eventually, free_endpoint

PARENT = """
import sys, time
from pathlib import Path
from fusion_service.demo.crew import Crew
with Crew(Path(sys.argv[1])) as crew:
    crew.start("hub", ["fusion_service", "hub", "--listen", sys.argv[2]])
    print(crew._processes["hub"].pid, flush=True)
    time.sleep(600)
"""


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return Path(f"/proc/{pid}/stat").exists() and ") Z " in Path(f"/proc/{pid}/stat").read_text()


def test_a_demo_that_is_killed_leaves_nobody(tmp_path: Path) -> None:
    log = tmp_path / "hub.log"
    with Program(PARENT, str(tmp_path), free_endpoint()) as parent:
        hub = int(parent.line(30))
        try:
            eventually(lambda: "listens" in log.read_text(), 30)
            parent.signal(signal.SIGKILL)
            eventually(lambda: gone(hub), 30)
        finally:
            if not gone(hub):
                os.kill(hub, signal.SIGKILL)
    assert "not stopped within" not in log.read_text()


def test_what_is_no_lifeline_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    with open(os.devnull) as file:
        for said in ("", "x", "²", "99999", str(2**70), "-1", str(file.fileno())):
            monkeypatch.setenv(VARIABLE, said)
            end_with_parent()
            assert VARIABLE not in os.environ
    assert not any(thread.name == "lifeline" for thread in threading.enumerate())
