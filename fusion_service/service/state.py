"""What survives the process: id generations and the checkpoint, in one folder that one service holds.

A global id is (generation, counter), 32 bits each. Every start takes a new generation and writes it to disk
before any id of it is used: that reserves the block of 2^32 counters under it, and no id is ever given
twice, whatever is killed when. Ids that end between two checkpoints are noted in a file beside it, so that none comes
back with an older checkpoint. A generation is also never below the seconds since 2020, so that a lost folder
does no harm while the clock is right.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion_service.errors import FusionError
from fusion_service.service.terms import NODES, generation_after

__all__ = ["State", "StateError", "open_state"]

YEAR_2020 = 1_577_836_800
SYNC_PERIOD = 5.0


class StateError(FusionError):
    """The folder cannot be used, and why, in one line."""


def _by_clock() -> int:
    return max(1, int(time.time()) - YEAR_2020)


class State:
    """Ids and checkpoint in `folder`; None keeps nothing and numbers generations by the clock."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._synced = 0.0
        self._last = 0
        self._heritage: tuple[bytes | None, NDArray[np.uint64]] | None = None
        self.node = self._kept_node() or 0
        """This process' own among those that give ids under one centre's name (see `terms`)."""
        self.epoch_above = 0
        """Runs of the centre begin after this, ns."""

    def _kept_node(self) -> int | None:
        try:
            return int((self._folder / "node").read_text()) % NODES if self._folder is not None else None
        except (OSError, ValueError):
            return None

    @property
    def has_node(self) -> bool:
        """Whether it was settled once, beside another process."""
        return self._kept_node() is not None

    def keep_node(self, node: int) -> None:
        """From now on this process gives ids as `node`, over restarts too."""
        self.node = node
        if self._folder is not None:
            self._write("node", f"{node}\n".encode(), sync=True)

    def inherit(self, checkpoint: bytes | None, ended: NDArray[np.uint64], generation: int, epoch: int) -> None:
        """A service begins next that goes on where another one was: with this checkpoint instead of the own, without
        the tracks that have `ended` since, and above that one's generation and epoch."""
        if checkpoint is not None:
            self._heritage = checkpoint, ended
        self._last, self.epoch_above = max(self._last, generation), max(self.epoch_above, epoch)

    def new_generation(self) -> int:
        """A generation that was never taken before, on disk when this returns. Raises `StateError` or
        OSError if it cannot be; the next one after the last of this process is then safe only as long as it lives."""
        last = self._last
        if self._folder is not None:
            path = self._folder / "generation"
            try:
                last = int(path.read_text()) if path.exists() else 0
            except ValueError:
                raise StateError(f"{path} does not hold a number: delete it to go on with the clock's") from None
        self._last = generation_after(max(last, self._last), self.node, _by_clock())
        if self._folder is not None:
            if not self._last < 2**32:
                raise StateError(f"{self._folder / 'generation'} is used up: delete it to go on with the clock's")
            self._write("generation", f"{self._last}\n".encode(), sync=True)
        return self._last

    @property
    def folder(self) -> Path | None:
        """Where it is; None: nothing is kept."""
        return self._folder

    def load(self) -> bytes | None:
        """The last checkpoint, or the one inherited, if there is one."""
        if self._heritage is not None:
            return self._heritage[0]
        if self._folder is None or not (self._folder / "checkpoint").exists():
            return None
        return (self._folder / "checkpoint").read_bytes()

    def set_aside(self) -> None:
        """Keep a checkpoint that cannot be used, under another name."""
        if self._folder is not None:
            with contextlib.suppress(FileNotFoundError):
                os.replace(self._folder / "checkpoint", self._folder / "checkpoint.refused")

    def save(self, blob: bytes) -> None:
        """Replace the checkpoint at once: whole or not at all after kill -9; synced to disk every few seconds."""
        if self._folder is not None:
            now = time.monotonic()
            sync = now - self._synced > SYNC_PERIOD
            self._synced = now if sync else self._synced
            self._write("checkpoint", blob, sync=sync)
            with contextlib.suppress(FileNotFoundError):
                os.truncate(self._folder / "ended", 0)

    def ended(self) -> NDArray[np.uint64]:
        """The ids that have ended since the last checkpoint was made."""
        if self._heritage is not None:
            (_, ended), self._heritage = self._heritage, None
            return ended
        if self._folder is None or not (self._folder / "ended").exists():
            return np.zeros(0, dtype=np.uint64)
        data = (self._folder / "ended").read_bytes()
        return np.frombuffer(data[: len(data) // 8 * 8], dtype="<u8").astype(np.uint64)

    def note_ended(self, ids: NDArray[np.uint64]) -> None:
        """These have ended, which will be published: after kill -9 they are among `ended`."""
        if self._folder is not None and len(ids):
            with open(self._folder / "ended", "ab") as file:
                file.write(ids.astype("<u8").tobytes())

    def _write(self, name: str, data: bytes, *, sync: bool) -> None:
        assert self._folder is not None
        part = self._folder / f"{name}.part"
        with open(part, "wb") as file:
            file.write(data)
            if sync:
                file.flush()
                os.fsync(file.fileno())
        os.replace(part, self._folder / name)
        if sync:
            handle = os.open(self._folder, os.O_RDONLY)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)


@contextlib.contextmanager
def open_state(folder: str | None) -> Iterator[State]:
    """The state in `folder` (made if need be), held against a second service. Raises `StateError` if it cannot be."""
    if folder is None:
        yield State(None)
        return
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        lock = open(path / "lock", "w")  # noqa: SIM115 (held until the end)
    except OSError as error:
        raise StateError(f"the state folder {path} cannot be used: {error.strerror}") from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise StateError(f"another service uses the state folder {path}: stop it or set service.state") from None
        yield State(path)
