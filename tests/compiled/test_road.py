"""Which road is taken, and what is said of it."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event
from types import SimpleNamespace

import pytest

from fusion_service.centre import FusionCentre
from fusion_service.compiled import PLAIN, begin, is_kept, road, use
from fusion_service.compiled.either import FAST
from fusion_service.compiled.road import SHAPES, VARIABLE


@pytest.fixture(autouse=True)
def plain(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.delenv(VARIABLE, raising=False)
    use("off")
    yield
    use("off")


def without_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numba", None)


def test_without_numba_all_is_plain(monkeypatch: pytest.MonkeyPatch) -> None:
    without_numba(monkeypatch)
    assert use("auto") == road() == PLAIN
    with pytest.raises(ValueError, match=r"numba cannot be used .*: pip install numba"):
        use("on")
    assert FAST == {}


def test_the_variable_decides_for_auto_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    without_numba(monkeypatch)
    monkeypatch.setenv(VARIABLE, "on")
    with pytest.raises(ValueError, match="numba"):
        use("auto")
    assert use("off") == PLAIN
    monkeypatch.setenv(VARIABLE, "fast")
    with pytest.raises(ValueError, match="one of auto, on, off"):
        use("auto")


def test_the_road_is_told_once_it_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setenv(VARIABLE, "off")
    begin("auto", Event(), told.append)
    assert told == [PLAIN]


def start(centre: FusionCentre) -> dict[str, object]:
    (event,) = (event for event in centre.step(10**9).log.events if event["kind"] == "start")
    return event


def test_a_recording_says_which_road_was_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "road" not in start(FusionCentre({}))
    pytest.importorskip("numba")
    name = use("on")
    assert start(FusionCentre({}))["road"] == name == road()
    assert name.startswith("numba ")


def test_what_is_wanted_and_stopped_is_not_compiled() -> None:
    pytest.importorskip("numba")
    stop = Event()
    stop.set()
    assert use("on", stop) == PLAIN


def test_kernels_of_a_process_that_was_killed_while_it_compiled_are_not_all(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Nor are those of an older version of the source."""
    source = tmp_path / "kernels.py"
    source.write_text("", "utf-8")
    monkeypatch.setattr(
        sys.modules["fusion_service.compiled.road"], "_home", lambda name: SimpleNamespace(__file__=str(source))
    )
    (tmp_path / "__pycache__").mkdir()
    python = f"py{sys.version_info.major}{sys.version_info.minor}"
    for name in SHAPES:
        assert not is_kept()
        (tmp_path / "__pycache__" / f"kernels.{name}-7.{python}.nbi").touch()
        assert not is_kept(), "the code itself is written after its index, or never"
        (tmp_path / "__pycache__" / f"kernels.{name}-7.{python}.1.nbc").touch()
    assert is_kept()
    later = time.time() + 100
    os.utime(source, (later, later))
    assert not is_kept()
