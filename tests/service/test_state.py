"""What survives the process: generations that are never taken twice, a checkpoint that is whole or not there."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from fusion_service.service import state as state_module
from fusion_service.service.state import StateError, open_state
from tests.helpers.processes import Program

TAKER = """
import sys
from fusion_service.service.state import open_state
with open_state(sys.argv[1]) as state:
    n = 0
    while True:
        print(state.new_generation(), flush=True)
        state.save(bytes([n % 251]) * 100_000)
        n += 1
"""


def test_generations_grow_across_starts(tmp_path: Path) -> None:
    taken = []
    for _ in range(4):
        with open_state(str(tmp_path / "deep" / "state")) as state:
            taken += [state.new_generation(), state.new_generation()]
    assert taken == sorted(set(taken))


def test_a_lost_folder_does_not_bring_old_generations_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_state(str(tmp_path / "one")) as state:
        first = state.new_generation()
    later = state_module._by_clock() + 5
    monkeypatch.setattr(state_module, "_by_clock", lambda: later)
    with open_state(str(tmp_path / "two")) as state:
        assert state.new_generation() > first
    monkeypatch.setattr(state_module, "_by_clock", lambda: 1)
    with open_state(str(tmp_path / "one")) as state:
        assert state.new_generation() > first


def test_killed_at_any_moment_nothing_is_taken_twice_and_the_checkpoint_is_whole(tmp_path: Path) -> None:
    folder = str(tmp_path / "state")
    printed: list[int] = []
    for rounds in (3, 17, 40):
        with Program(TAKER, folder) as program:
            printed += [int(program.line()) for _ in range(rounds)]
            program.kill()
        with open_state(folder) as state:
            blob = state.load()
            assert blob is not None
            assert re.fullmatch(rb"(.)\1*", blob, re.DOTALL)
            assert len(blob) == 100_000
            printed.append(state.new_generation())
    assert printed == sorted(set(printed))


def test_one_service_holds_the_folder(tmp_path: Path) -> None:
    taken = pytest.raises(StateError, match="another service uses the state folder")
    with open_state(str(tmp_path)), taken, open_state(str(tmp_path)):
        pass
    with open_state(str(tmp_path)):
        pass


def test_what_is_wrong_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StateError, match="cannot be used"), open_state(str(tmp_path / "file")):
        pass
    (tmp_path / "link").symlink_to(tmp_path)
    with pytest.raises(StateError, match="name the folder itself"), open_state(str(tmp_path / "link")):
        pass


def test_without_a_folder_generations_still_grow() -> None:
    with open_state(None) as state:
        assert state.new_generation() < state.new_generation()
        assert state.load() is None
        state.save(b"nothing")


def test_an_unusable_checkpoint_is_set_aside(tmp_path: Path) -> None:
    with open_state(str(tmp_path)) as state:
        state.save(b"bad")
        state.set_aside()
        assert state.load() is None
        assert os.listdir(tmp_path).count("checkpoint.refused") == 1
