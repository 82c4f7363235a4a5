"""What survives the process: generations that are never taken twice, a checkpoint that is whole or not there."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fusion_service.centre import FusionCentre, Whereabouts
from fusion_service.service import state as state_module
from fusion_service.service.state import StateError, open_state
from fusion_service.service.young import born_in, noted
from schemas import GlobalTracks
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


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 512 KiB of its own, where this process may mount one."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=512k", "none", folder], capture_output=True).returncode:
        pytest.skip("no disk can be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", folder], check=True)


def fill(disk: Path) -> None:
    """Leave not a byte on it."""
    with open(disk / "filler", "ab", buffering=0) as file:
        for size in (65536, 4096, 1):
            with contextlib.suppress(OSError):
                while file.write(bytes(size)):
                    pass


@pytest.mark.parametrize("known", [True, False], ids=["a state folder that was used", "a new one"])
def test_a_full_disk_at_the_start_is_told_and_no_id_is_given_twice(
    small_disk: Path, known: bool, caplog: pytest.LogCaptureFixture
) -> None:
    taken, folder = [], small_disk / "state"
    ended = np.arange(5, 1005, dtype=np.uint64)
    if known:
        with open_state(str(folder)) as state:
            taken.append(state.new_generation())
            state.save(b"checkpoint")
    else:
        folder.mkdir(mode=0o700)
    fill(small_disk)
    for _ in range(2):
        with open_state(str(folder)) as state:
            taken.append(state.new_generation())
            assert "full disk" in state.trouble
            assert "ids are safe" in state.trouble
            with pytest.raises(OSError, match="No space"):
                state.save(bytes(200_000))
            assert "cannot be saved" in state.trouble
            if known:
                assert state.load() == b"checkpoint"
                state.note_ended(ended)
                state.note_born(noted(picture(), 5, nowhere))
                assert born_in(state.born()).tracks[0] == (("r1", 7, 70), 700)
                assert ended.tolist() == state.ended()[-1000:].tolist()
    assert taken == sorted(set(taken))
    assert "full disk" in caplog.text
    (small_disk / "filler").unlink()
    with open_state(str(folder)) as state:
        assert state.new_generation() > taken[-1]
        state.save(b"new")
        assert state.trouble == ""
        assert state.load() == b"new"
        assert not len(state.ended())
        assert born_in(state.born()) == ([], [])


def test_where_files_may_not_grow_the_service_starts_too(tmp_path: Path) -> None:
    """As a full disk, for a process that may write no byte to a file."""
    with open_state(str(tmp_path)) as state:
        first = state.new_generation()
    with Program(LIMITED, str(tmp_path)) as program:
        generation, trouble = program.line().split(" ", 1)
    assert int(generation) > first
    assert "ids are safe while the clock is" in trouble


LIMITED = """
import resource, sys
from fusion_service.service.state import open_state
with open_state(sys.argv[1]) as state:
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    print(state.new_generation(), state.trouble, flush=True)
"""


@pytest.mark.parametrize(
    ("written", "above"), [("7\n", 10), ("0", 4_000_000_000), ("seven", 9), ("-3", 9), ("", 3), (f"{2**40}", 3)]
)
def test_a_generation_that_cannot_be_is_mended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, written: str, above: int
) -> None:
    """The clock is of no use here."""
    monkeypatch.setattr(state_module, "_by_clock", lambda: 1)
    (tmp_path / "generation").write_text(written)
    with open_state(str(tmp_path)) as state:
        taken = [state.new_generation(above), state.new_generation()]
    assert above < taken[0] < taken[1]
    assert "ids go on above" in caplog.text
    caplog.clear()
    with open_state(str(tmp_path)) as state:
        assert state.new_generation(above) > taken[1]
    assert "ids go on above" not in caplog.text


def mode(path: Path) -> int:
    return stat.S_IMODE(path.lstat().st_mode)


def test_files_are_their_owners_alone_and_links_are_not_followed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder, other = tmp_path / "state", tmp_path / "other"
    other.write_bytes(b"of somebody else")
    folder.mkdir(mode=0o755)
    folder.chmod(0o755)
    (folder / "checkpoint").write_bytes(b"old")
    (folder / "checkpoint").chmod(0o644)
    for name in ("generation", "ended", "born", "lock", "checkpoint.part"):
        (folder / name).symlink_to(other)
    with open_state(str(folder)) as state:
        assert state.load() == b"old"
        state.new_generation()
        state.note_ended(np.array([1], dtype=np.uint64))
        state.note_born(b"note")
        state.save(b"new")
    assert other.read_bytes() == b"of somebody else"
    assert mode(folder) == 0o700
    for name in ("generation", "checkpoint", "ended", "born", "lock"):
        assert mode(folder / name) == 0o600, name
        assert not (folder / name).is_symlink()
    told = [record.message for record in caplog.records]
    assert len(told) == 7, told
    assert sum("was open to others" in one for one in told) == 2
    assert sum("not followed" in one for one in told) == 5


def picture() -> GlobalTracks:
    """Tracks 5 and 700: of r2, and of r1 and r2."""
    base = FusionCentre({}).step(10**9).tracks
    return dataclasses.replace(
        base,
        ids=np.array([5, 700], dtype=np.uint64),
        sources=("r1", "r2"),
        contributor_counts=np.array([1, 2], dtype=np.uint16),
        contributor_source=np.array([1, 0, 1], dtype=np.uint16),
        contributor_epoch=np.array([9, 7, 9], dtype=np.uint64),
        contributor_id=np.array([1, 70, 2**63], dtype=np.uint64),
    )


def nowhere(above: int) -> Whereabouts:
    """Where they are, of tracks that have no place."""
    return Whereabouts.nothing(above % 5)


def test_notes_of_what_begins_are_read_up_to_where_they_are_torn(tmp_path: Path) -> None:
    with open_state(str(tmp_path)) as state:
        for above in (0, 5, 700):
            state.note_born(noted(picture(), above, nowhere))
    with open_state(str(tmp_path)) as state:
        state.note_born(noted(picture(), 699, nowhere))  # of a later process, behind the others
        data = state.born()
    young = [(("r1", 7, 70), 700), (("r2", 9, 2**63), 700)]
    whole = [(("r2", 9, 1), 5), *young, *young, *young]
    assert born_in(data).tracks == whole
    for cut in range(len(data)):
        part = born_in(data[:cut]).tracks
        assert part == whole[: len(part)]
        assert born_in(data[:cut] + bytes(64)).tracks == part
        assert isinstance(born_in(data[:cut] + b"\xff" * 64).tracks, list)
