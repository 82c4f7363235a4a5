"""Small files that only their owner reads, in one folder: replaced whole, or appended to where room was made before.

No symbolic link is followed: one that stands where a file belongs is moved out of the way, and said. A file that others
could read is closed to them, and said. `Notes` is a file with room reserved at the start, so that what must be noted
can be noted on a full disk.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import stat
from collections.abc import Iterator
from pathlib import Path

__all__ = ["FULL", "Files", "Notes", "opened_folder"]

FULL = frozenset((errno.ENOSPC, errno.EDQUOT, errno.EFBIG))
"""What a disk says that is full, or a quota or limit that is used up."""
WORD = 8
"""Bytes that a note begins at a multiple of."""

log = logging.getLogger(__name__)


def opened_folder(path: Path) -> None:
    """Make the folder if need be, for its owner alone. Raises OSError; `NotADirectoryError` for a symbolic link."""
    with contextlib.suppress(FileExistsError):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.mkdir(mode=0o700)
    found = path.lstat()
    if stat.S_ISLNK(found.st_mode):
        raise NotADirectoryError(errno.ENOTDIR, "it is a symbolic link, which is not followed: name the folder itself")
    if not stat.S_ISDIR(found.st_mode):
        raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
    if mode := stat.S_IMODE(found.st_mode) & 0o077:
        try:
            path.chmod(0o700)
        except PermissionError:
            log.warning("the folder %s is open to others and not ours to close: its owner should chmod 700 it", path)
        else:
            log.warning("the folder %s was open to others (mode %03o): it is 0700 now", path, mode | 0o700)


class Files:
    """Those in `folder`, by name."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def open(self, name: str, flags: int) -> int:
        """A descriptor. A link of that name is set aside, and none is there then. Raises OSError."""
        path, flags = self.folder / name, flags | os.O_NOFOLLOW | os.O_CLOEXEC
        try:
            handle = os.open(path, flags, 0o600)
        except OSError as error:
            if error.errno != errno.ELOOP:
                raise
            self.set_aside(name, "link")
            log.warning("%s was a symbolic link, which is not followed: it is %s.link now", path, name)
            handle = os.open(path, flags, 0o600)
        mode = stat.S_IMODE(os.fstat(handle).st_mode)
        if mode & 0o077:
            with contextlib.suppress(PermissionError):
                os.fchmod(handle, 0o600)
                log.warning("%s was open to others (mode %03o): it is 0600 now", path, mode)
        return handle

    @contextlib.contextmanager
    def _opened(self, name: str, flags: int) -> Iterator[int]:
        handle = self.open(name, flags)
        try:
            yield handle
        finally:
            os.close(handle)

    def read(self, name: str) -> bytes | None:
        """All of it; None where there is none."""
        try:
            with self._opened(name, os.O_RDONLY) as handle, open(handle, "rb", closefd=False) as file:
                return file.read()
        except FileNotFoundError:
            return None

    def set_aside(self, name: str, why: str) -> None:
        """Keep it under the name `name.why`."""
        with contextlib.suppress(FileNotFoundError):
            os.replace(self.folder / name, self.folder / f"{name}.{why}")

    def replace(self, name: str, data: bytes, *, sync: bool) -> None:
        """Another content, whole or not at all. Raises OSError, and leaves what there was."""
        part = f"{name}.part"
        try:
            with self._opened(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC) as handle:
                _write(handle, data)
                if sync:
                    os.fsync(handle)
            os.replace(self.folder / part, self.folder / name)
        except OSError:
            with contextlib.suppress(OSError):
                os.unlink(self.folder / part)
            raise
        if sync:
            self._sync()

    def overwrite(self, name: str, data: bytes) -> None:
        """Another content in the place of the old one, which must be as long: needs no room. Raises OSError."""
        with self._opened(name, os.O_WRONLY) as handle:
            if os.fstat(handle).st_size < len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.pwrite(handle, data.ljust(os.fstat(handle).st_size), 0)
            os.fsync(handle)

    def _sync(self) -> None:
        handle = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


class Notes:
    """What is noted in the file `name`, one note after the other, each at a multiple of eight bytes. room: bytes that
    are reserved. A note ends with a byte that is not 0; the rest of the file holds 0."""

    def __init__(self, files: Files, name: str, room: int) -> None:
        self._files, self._name, self._room = files, name, room
        self._handle = -1
        self._end = 0

    def read(self) -> bytes:
        """All notes; behind them there may be bytes of 0."""
        data = self._files.read(self._name) or b""
        return data[: _whole(len(data.rstrip(b"\0")))]

    def reserve(self) -> None:
        """Open the file, and make room in it. Raises OSError where there is none, and it is the smaller then."""
        if self._handle >= 0:
            return
        self._end = len(self.read())
        self._handle = self._files.open(self._name, os.O_WRONLY | os.O_CREAT)
        if os.fstat(self._handle).st_size < self._room:
            os.posix_fallocate(self._handle, 0, self._room)

    def append(self, note: bytes) -> None:
        """One more note: safe from a kill when this returns. Raises OSError."""
        with contextlib.suppress(OSError):
            self.reserve()
        if self._handle < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        try:
            _write(self._handle, note, self._end)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._handle, self._end)
            raise
        self._end = _whole(self._end + len(note))

    def clear(self) -> None:
        """None is there any more. Raises OSError."""
        if self._handle < 0 and not self.read():
            return
        with contextlib.suppress(OSError):
            self.reserve()
        if self._end and self._handle >= 0:
            _write(self._handle, bytes(self._end), 0)
            if self._end > self._room:
                os.ftruncate(self._handle, self._room)
            self._end = 0

    def close(self) -> None:
        """Let the file go."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1


def _whole(size: int) -> int:
    return -(-size // WORD) * WORD


def _write(handle: int, data: bytes, at: int = 0) -> None:
    """All of `data` at the place `at`: a short write says that there is no room."""
    view = memoryview(data)
    while len(view):
        written = os.pwrite(handle, view, at)
        if not written:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        view, at = view[written:], at + written
