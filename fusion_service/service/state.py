"""What survives the process: id generations and the checkpoint, in one folder that one service holds.

A global id is (generation, counter), 32 bits each. Every start takes a new generation and writes it to disk
before any id of it is used: that reserves the block of 2^32 counters under it, and no id is ever given
twice, whatever is killed when. Ids that end between two checkpoints are noted in a file beside it (`ended`), so that
none comes back with an older checkpoint, and those that begin with the local tracks that they are for (`born`), so that
they come back. A generation is also never below the seconds since 2020, so that a lost folder
does no harm while the clock is right.

A full disk keeps nobody out: the number of the generation is written over the old one, notes have room reserved, and
`trouble` says what is not on disk. The folder and its files are their owner's alone, and no link is followed (`files`).
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre import Order
from fusion_service.errors import FusionError
from fusion_service.service.files import FULL, Files, Notes, opened_folder
from fusion_service.service.held import HeldOrders
from fusion_service.service.syncing import Syncing
from fusion_service.service.terms import NODES, generation_after

__all__ = ["State", "StateError", "open_state"]

YEAR_2020 = 1_577_836_800
SYNC_PERIOD = 5.0
MOST_GENERATION = 2**32 - 1
ROOM_ENDED, ROOM_BORN = 64 * 1024, 256 * 1024
"""Bytes reserved for notes between two checkpoints; where that is not enough the files grow."""

log = logging.getLogger(__name__)


class StateError(FusionError):
    """The folder cannot be used, and why, in one line."""


def _by_clock() -> int:
    return max(1, int(time.time()) - YEAR_2020)


class State:
    """Ids and checkpoint in `folder`; None keeps nothing and numbers generations by the clock.

    trouble: why something is not on disk that should be, in a sentence; empty where all is.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._files = None if folder is None else Files(folder)
        self._ended = None if self._files is None else Notes(self._files, "ended", ROOM_ENDED)
        self._born = None if self._files is None else Notes(self._files, "born", ROOM_BORN)
        self.held = HeldOrders(folder)
        """Orders that were answered and are in no checkpoint."""
        self._synced = 0.0
        self._syncing = Syncing()
        self._last = 0
        self._unwritten = ""
        self._unsaved = ""
        self._heritage: tuple[bytes | None, NDArray[np.uint64]] | None = None
        self._inherits = False
        self._inherited = b""
        self.node = self._kept_node() or 0
        """This process' own among those that give ids under one centre's name (see `terms`)."""
        self.epoch_above = 0
        """Runs of the centre begin after this, ns."""

    def _kept_node(self) -> int | None:
        try:
            return int(self._files.read("node") or b"") % NODES if self._files is not None else None
        except (OSError, ValueError):
            return None

    @property
    def has_node(self) -> bool:
        """Whether it was settled once, beside another process."""
        return self._kept_node() is not None

    def keep_node(self, node: int) -> None:
        """From now on this process gives ids as `node`, over restarts too."""
        self.node = node
        if self._files is not None:
            self._files.replace("node", f"{node}\n".encode(), sync=True)

    def inherit(
        self,
        checkpoint: bytes | None,
        ended: NDArray[np.uint64],
        generation: int,
        epoch: int,
        orders: Sequence[Order] = (),
        born: bytes = b"",
    ) -> None:
        """A service begins next that goes on where another one was: with this checkpoint instead of the own, without
        the tracks that have `ended` since, with the orders that it does not know, and what was noted of tracks that
        have begun, and above that one's generation and epoch."""
        self.held.inherit(orders)
        if checkpoint is not None:
            self._heritage, self._inherits, self._inherited = (checkpoint, ended), True, born
        self._last, self.epoch_above = max(self._last, generation), max(self.epoch_above, epoch)

    @property
    def inherits(self) -> bool:
        """Whether the service that begins goes on where another one was."""
        return self._inherits

    @property
    def trouble(self) -> str:
        """See the class."""
        unsafe = self._syncing.trouble and f"the checkpoint in {self._folder} may not outlive a power cut: "
        return self._unsaved or self._unwritten or (unsafe and unsafe + self._syncing.trouble)

    def new_generation(self, above: int = 0) -> int:
        """A generation that was never taken before, and is above that one, on disk when this returns; where the disk is
        full, in the place of the last one, or, said as `trouble`, by the clock alone. Raises OSError if it cannot be
        written for another reason; the next one after the last of this process is then safe only as long as it
        lives."""
        last = self._last
        if self._folder is not None:
            last = max(last, self._recorded(above))
        self._last = generation_after(max(last, min(above, MOST_GENERATION - 1)), self.node, _by_clock())
        self._inherits = False
        if self._files is not None:
            self._record(self._files, f"{self._last:>10}\n".encode())
        return self._last

    def _recorded(self, above: int) -> int:
        """The number on disk, 0 where there is none; what is no number, or was overtaken by `above`, is mended."""
        assert self._files is not None
        data = self._files.read("generation")
        path = self._files.folder / "generation"
        try:
            last = int((data or b"0").decode("ascii"))
        except ValueError:
            last = -1
        if not 0 <= last < MOST_GENERATION:
            self._files.set_aside("generation", "refused")
            log.warning("%s held no generation (it is generation.refused now): ids go on above all known ones", path)
            return 0
        if last < above and not self._inherits:
            log.warning("%s held %d, below the checkpoint's %d: ids go on above that", path, last, above)
        return last

    def _record(self, files: Files, data: bytes) -> None:
        self._unwritten = ""
        try:
            files.replace("generation", data, sync=True)
        except OSError as error:
            if error.errno not in FULL:
                raise
            where = f"{files.folder} is on a full disk ({os.strerror(error.errno or 0)})"
            try:
                files.overwrite("generation", data)
                self._unwritten = f"{where}: ids are safe, but what is saved is old: make room"
            except OSError:
                self._unwritten = f"{where}, with no room for a number: ids are safe while the clock is: make room"
                time.sleep(
                    min(max(self._last // NODES + 1 + YEAR_2020 - time.time(), 0.0), 2.0)
                )  # the next start has another
            log.error("%s", self._unwritten)
            return
        for notes in (self._ended, self._born):
            try:
                if notes is not None:
                    notes.reserve()
            except OSError as error:
                self._unwritten = f"no room could be reserved in {files.folder}: {error.strerror}"
                log.error("%s", self._unwritten)

    @property
    def folder(self) -> Path | None:
        """Where it is; None: nothing is kept."""
        return self._folder

    def load(self) -> bytes | None:
        """The last checkpoint, or the one inherited, if there is one."""
        if self._heritage is not None:
            return self._heritage[0]
        return None if self._files is None else self._files.read("checkpoint")

    def set_aside(self, why: str = "refused") -> None:
        """Keep a checkpoint that cannot be used, under another name: `checkpoint.{why}`."""
        if self._files is not None:
            self._files.set_aside("checkpoint", why)

    def save(self, blob: bytes) -> None:
        """Replace the checkpoint at once: whole or not at all after kill -9; brought to the disk every few seconds, on
        another thread. Raises OSError, which `trouble` tells until it is saved again."""
        if self._files is not None and self._born is not None and self._ended is not None:
            try:
                self._files.replace("checkpoint", blob, sync=False)
                self._born.clear()  # before what has ended, which must not begin again
                self._ended.clear()
            except OSError as error:
                self._unsaved = f"the checkpoint cannot be saved in {self._files.folder}: {error.strerror}"
                raise
            self._unsaved = self._unwritten = ""
            if (now := time.monotonic()) - self._synced > SYNC_PERIOD and not self._syncing.busy:
                self._synced = now
                self._syncing.begin(self._files.folder / "checkpoint")

    def ended(self) -> NDArray[np.uint64]:
        """The ids that have ended since the last checkpoint was made."""
        if self._heritage is not None:
            (_, ended), self._heritage = self._heritage, None
            return ended
        data = b"" if self._ended is None else self._ended.read()
        ids = np.frombuffer(data[: len(data) // 8 * 8], dtype="<u8").astype(np.uint64)
        return ids[ids > 0]

    def note_ended(self, ids: NDArray[np.uint64]) -> None:
        """These have ended, which will be published: after kill -9 they are among `ended`. Raises OSError."""
        if self._ended is not None and len(ids):
            self._ended.append(ids.astype("<u8").tobytes())

    def born(self) -> bytes:
        """What was noted of tracks that have begun since the last checkpoint was made, one note after the other."""
        if self._inherits:
            return self._inherited
        return b"" if self._born is None else self._born.read()

    def note_born(self, note: bytes) -> None:
        """Tracks have begun, which will be published: after kill -9 the note is in `born`. It must end with a byte that
        is not 0. Raises OSError."""
        if self._born is not None and note:
            self._born.append(note)

    def close(self) -> None:
        """Let the files go."""
        self._syncing.close()
        for notes in (self._ended, self._born):
            if notes is not None:
                notes.close()


@contextlib.contextmanager
def open_state(folder: str | None) -> Iterator[State]:
    """The state in `folder` (made if need be), held against a second service. Raises `StateError` if it cannot be."""
    if folder is None:
        yield State(None)
        return
    path = Path(folder)
    try:
        opened_folder(path)
        lock = _lock(path)
    except OSError as error:
        raise StateError(f"the state folder {path} cannot be used: {error.strerror}") from None
    state = State(path)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise StateError(f"another service uses the state folder {path}: stop it or set service.state") from None
        yield state
    finally:
        state.close()
        os.close(lock)


def _lock(path: Path) -> int:
    """What is locked: the file `lock`, or on a disk with no room for one the folder itself."""
    try:
        return Files(path).open("lock", os.O_RDWR | os.O_CREAT)
    except OSError as error:
        if error.errno not in FULL:
            raise
        return os.open(path, os.O_RDONLY | os.O_DIRECTORY)
