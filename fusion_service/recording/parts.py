"""A mission in parts: a folder of recordings 0001.rrd, 0002.rrd, ..., each of them whole in itself.

All have one recording id, so that `rerun DIR/*.rrd` shows them as one. A folder is written by one recorder at a time.
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from fusion_service.errors import ReviewError

__all__ = ["DEFAULT_SIZE", "Folder", "Rotation", "begin", "is_folder", "nobody_writes", "number_of", "parts", "unused"]

log = logging.getLogger(__name__)

NAME = re.compile(r"(\d{4,9})\.rrd")
DEFAULT_SIZE = 500 * 10**6
"""Bytes after which a part ends if nothing else is said."""


@dataclass(frozen=True, slots=True)
class Rotation:
    """When a part ends, and which parts are kept: by bytes and by seconds, None for no limit. keep_size counts the part
    that is being written; one that ended more than keep_for ago goes. Raises `ValueError` where keep_size does not hold
    two parts."""

    size: int | None = None
    every: float | None = None
    keep_size: int | None = None
    keep_for: float | None = None

    def __post_init__(self) -> None:
        if self.keep_size is not None and self.size is not None and self.keep_size < 2 * self.size:
            raise ValueError(
                f"what is kept, {self.keep_size} bytes, must hold two parts of {self.size} bytes: keep more, or make "
                "the parts smaller"
            )

    @property
    def limit(self) -> int | None:
        """Bytes after which a part ends: as said; a tenth of what is kept, if that is less than `DEFAULT_SIZE`."""
        if self.size is not None:
            return self.size
        if self.keep_size is not None:
            return min(DEFAULT_SIZE, max(self.keep_size // 10, 1))
        return DEFAULT_SIZE if self.every is None else None

    @property
    def keeps(self) -> bool:
        """Whether old parts may be deleted."""
        return self.keep_size is not None or self.keep_for is not None


def number_of(path: Path) -> int | None:
    """The number of a part by its name, None if it is none."""
    match = NAME.fullmatch(path.name)
    return int(match[1]) if match else None


def parts(folder: Path) -> list[Path]:
    """The parts in `folder`, the first one first."""
    found = [(number, path) for path in folder.iterdir() if (number := number_of(path)) is not None and path.is_file()]
    return [path for _, path in sorted(found)]


def is_folder(path: str | Path) -> bool:
    """Whether what `path` names is, or is meant as, a folder of parts."""
    return str(path).endswith(("/", os.sep)) or Path(path).is_dir()


def begin(path: Path) -> BinaryIO:
    """Make the file of a recording; it is known as being written until what is returned is closed, or its process
    ends. `FileExistsError` if there is one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        file = path.open("xb")
    except FileExistsError:
        raise FileExistsError(f"{path} exists already: name another file, or move it away") from None
    with contextlib.suppress(OSError):  # a file system without locks
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return file


@contextlib.contextmanager
def nobody_writes(path: Path) -> Iterator[None]:
    """`ReviewError` if a recorder, or another who mends, is at the file `path`; keeps others away meanwhile."""
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ReviewError(f"{path} is being written just now: wait until its recorder has ended") from None
        except OSError:  # a file system without locks
            pass
        yield


def unused(path: str | Path) -> Path:
    """`path`, for a recording that is not to go on from another. `FileExistsError` for a folder with parts."""
    if Path(path).is_dir() and parts(Path(path)):
        raise FileExistsError(f"{path} holds a recording already: name another file or folder")
    return Path(path)


class Folder:
    """`path` as the folder of a mission that is being recorded, held against other recorders until `close`.
    `OSError` if it cannot be made or another holds it."""

    def __init__(self, path: Path, rotation: Rotation) -> None:
        self.path = path
        self._rotation = rotation
        path.mkdir(parents=True, exist_ok=True)
        self._lock = os.open(path, os.O_RDONLY)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._lock)
            raise OSError(f"{path} is being recorded into by another process: name another folder") from None
        self._began = 0.0
        self._asked = False

    def ask(self) -> None:
        """The part that is being written is to end. On any thread."""
        self._asked = True

    def close(self) -> None:
        """Let others record into it."""
        os.close(self._lock)

    def next(self) -> Path:
        """The part that follows all there are."""
        last = max((number_of(path) or 0 for path in parts(self.path)), default=0)
        self._began, self._asked = time.monotonic(), False
        return self.path / f"{last + 1:04d}.rrd"

    def full(self, current: Path) -> bool:
        """Whether the part that is being written is to end."""
        rotation = self._rotation
        if self._asked:
            return True
        if rotation.every is not None and time.monotonic() - self._began >= rotation.every:
            return True
        return rotation.limit is not None and current.stat().st_size >= rotation.limit

    def retain(self, current: Path) -> None:
        """Delete the parts that are not to be kept."""
        rotation = self._rotation
        if not rotation.keeps:
            return
        old: list[tuple[Path, os.stat_result]] = []
        for path in parts(self.path):
            with contextlib.suppress(FileNotFoundError):  # somebody else has deleted it meanwhile
                if path != current:
                    old.append((path, path.stat()))
        if rotation.keep_for is not None:
            oldest = time.time() - rotation.keep_for
            while old and old[0][1].st_mtime < oldest:
                self._delete(old.pop(0)[0], f"ended more than {rotation.keep_for:g} s ago")
        if rotation.keep_size is not None:
            total = sum(said.st_size for _, said in old) + current.stat().st_size
            while old and total > rotation.keep_size:
                path, said = old.pop(0)
                total -= said.st_size
                self._delete(path, f"the parts are larger than {rotation.keep_size} bytes")

    def make_room(self, current: Path) -> bool:
        """Delete the oldest part for one more on a full disk; whether there was one that may go."""
        old = [path for path in parts(self.path) if path != current]
        if not self._rotation.keeps or not old:
            return False
        self._delete(old[0], "the disk is all but full")
        return True

    def _delete(self, path: Path, reason: str) -> None:
        with contextlib.suppress(FileNotFoundError):
            path.unlink()
        log.warning("%s deleted: %s", path, reason)
