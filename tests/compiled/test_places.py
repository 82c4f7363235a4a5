"""Processes that compile: beside their work, and where nothing can be kept, or in a place of its own only."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from threading import Event
from typing import Any

import pytest

import fusion_service
from fusion_service.compiled import PLAIN, begin, road, use
from fusion_service.compiled.road import VARIABLE

NEEDED = ("__init__.py", "arrays.py", "layout.py", "linalg.py", "compiled")

PROGRAM = """
import json, sys, threading
import numpy as np
from fusion_service import linalg
from fusion_service.compiled import begin, is_kept, road
from fusion_service.compiled.either import FAST

roads = sys.modules["fusion_service.compiled.road"]
roads.SHAPES = {name: roads.SHAPES[name] for name in ("inner",)}
rng = np.random.default_rng(14)
A, B = rng.normal(size=(2, 4, 4, 100))
said, kept, found, calls = [], is_kept(), [], 0
begin("auto", threading.Event(), said.append)
at_once = list(said)
while True:
    over = not any(one.name == "compiler" for one in threading.enumerate())
    found.append(linalg.inner(A, B).tobytes())
    calls += not over
    if over:
        break
print(json.dumps({
    "kept": kept, "at_once": at_once, "said": said, "road": road(), "fast": "inner" in FAST, "same": len(set(found)),
    "calls": calls, "taken": FAST["inner"](A, B) is not None,
}))
"""


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A copy of what small matrices need, beside which nothing can be written, whoever one is."""
    pytest.importorskip("numba")
    source, target = Path(fusion_service.__file__).parent, tmp_path / "installed" / "fusion_service"
    target.mkdir(parents=True)
    for name in NEEDED:
        if name == "compiled":
            shutil.copytree(source / name, target / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source / name, target / name)
    (target / "compiled" / "__pycache__").write_text("", "utf-8")
    return target.parent


def run(installed: Path, **variables: str) -> dict[str, Any]:
    known = {key: value for key, value in os.environ.items() if key not in (VARIABLE, "XDG_CACHE_HOME")}
    there = {"PYTHONPATH": str(installed), "PYTHONDONTWRITEBYTECODE": "1", "HOME": os.devnull, **variables}
    program = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(program, env=known | there, cwd=installed, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    told: dict[str, Any] = json.loads(done.stdout)
    return told


def test_where_nothing_can_be_kept_it_compiles_beside_the_work_and_takes_over(installed: Path) -> None:
    told = run(installed)
    assert told["at_once"] == [f"{PLAIN}, until the compiler is done"]
    assert told["said"] == [*told["at_once"], told["road"]]
    assert told["road"].startswith("numba ")
    assert told["calls"] > 0
    assert told["same"] == 1, "the same bits before and after"
    assert told["fast"]
    assert told["taken"]
    assert not told["kept"]
    assert not [*installed.rglob("*.nb[ci]")]


def test_a_place_of_its_own_is_written_once_and_found_again(installed: Path, tmp_path: Path) -> None:
    place = tmp_path / "kept"
    first = run(installed, NUMBA_CACHE_DIR=str(place))
    assert not first["kept"]
    assert [*place.rglob("*.nbc")]
    again = run(installed, NUMBA_CACHE_DIR=str(place))
    assert again["kept"]
    assert again["at_once"] == again["said"] == [again["road"]], "at once, without a thread"


def test_what_was_compiled_beside_a_source_that_is_read_only_now_is_no_use(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """numba looks only where it could write: a process that took it for compiled would wait for its compiler."""
    roads = sys.modules["fusion_service.compiled.road"]
    source = tmp_path / "sources" / "kernels.py"
    (source.parent / "__pycache__").mkdir(parents=True)
    source.write_text("", "utf-8")
    monkeypatch.setattr(roads, "_home", lambda name: type("Home", (), {"__file__": str(source)}))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    python = f"py{sys.version_info.major}{sys.version_info.minor}"
    for name in roads.SHAPES:
        (source.parent / "__pycache__" / f"kernels.{name}-7.{python}.1.nbc").touch()
    assert roads.is_kept()
    access, beside = os.access, source.parent / "__pycache__"
    monkeypatch.setattr(os, "access", lambda place, mode: place != beside and access(place, mode))
    assert not roads.is_kept()


def test_a_compiler_that_fails_leaves_the_plain_road_and_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    roads = sys.modules["fusion_service.compiled.road"]
    told: list[str] = []
    done = Event()

    def fail(*_: Any) -> Any:
        raise RuntimeError("no room")

    def tell(line: str) -> None:
        told.append(line)
        if len(told) == 2:
            done.set()

    monkeypatch.delenv(VARIABLE, raising=False)
    use("off")
    monkeypatch.setattr(roads, "is_kept", lambda: False)
    monkeypatch.setattr(roads, "_installed", lambda: True)
    monkeypatch.setattr(roads, "_compiled", fail)
    begin("auto", Event(), tell)
    assert done.wait(60)
    assert told == [f"{PLAIN}, until the compiler is done", f"{PLAIN}: RuntimeError: no room"]
    assert road() == PLAIN
