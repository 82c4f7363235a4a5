"""Making a torn or damaged recording whole.

A recorder that was killed leaves a file without its index, perhaps with half a record at its end. The end is cut in
place; the index is then written by Rerun's own tool, into a copy that takes the file's place when it holds the same
number of messages. A file without an index opens as well, only more slowly. Of a file that is damaged within, what
decodes takes its place, and the damaged one is kept beside it.
"""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from fusion_service.errors import ReviewError
from fusion_service.recording.parts import nobody_writes, parts
from fusion_service.recording.program import find_program, quiet
from fusion_service.recording.reader import has_index, read, repair
from fusion_service.recording.salvage import Lost, decodes, salvage, whole_part

__all__ = ["Mended", "mend", "mend_all"]

log = logging.getLogger(__name__)

MERGE_TIME = 600.0
DAMAGED = ".damaged"


@dataclass(frozen=True, slots=True)
class Mended:
    """What was done to a recording: bytes `cut` at its end, what was `lost` to a damage within, whether an index was
    written, and why not if it lacks one still."""

    cut: int = 0
    lost: Lost = Lost()
    indexed: bool = False
    why_not: str = ""

    def __str__(self) -> str:
        done = [f"{self.cut} bytes of a torn record cut at its end"] * bool(self.cut)
        done += [f"{self.lost}; the damaged file is kept as *{DAMAGED}"] * bool(self.lost.bytes)
        done += ["index written"] * self.indexed
        done += [f"opens, without an index ({self.why_not})"] * bool(self.why_not)
        return ", ".join(done) or "whole, nothing to be done"


def mend(path: Path, *, index: bool = True) -> Mended:
    """Make one recording whole, in place. index: also write a missing index. `ReviewError` for a file that holds
    nothing, is no recording or is being written."""
    if not path.is_file():
        raise ReviewError(f"no recording at {path}")
    with nobody_writes(path):
        cut = repair(path)
        lost = _salvage(path) if whole_part(path)[1] or not decodes(path) else Lost()
        if has_index(path) or not index:
            return Mended(cut, lost)
        why_not = _index(path)
        return Mended(cut, lost, not why_not, why_not)


def _salvage(path: Path) -> Lost:
    """Put what decodes in place of `path`, which is kept. `ReviewError` where nothing does, or the disk is full."""
    copy = path.with_name(f".{path.name}.salvaged")
    try:
        lost = salvage(path, copy)
        if not decodes(copy):
            raise ReviewError(f"{path}: nothing of it can be read")
        os.replace(path, path.with_name(path.name + DAMAGED))
        os.replace(copy, path)
    except OSError as error:
        raise ReviewError(
            f"{path} is damaged, and what is whole of it could not be written: {error.strerror}"
        ) from error
    finally:
        copy.unlink(missing_ok=True)
    return lost


def mend_all(path: Path, stop: Callable[[], bool]) -> Iterator[tuple[Path, Mended | ReviewError]]:
    """`mend` a file, or each part of a folder, until `stop`; what cannot be mended comes with the reason. Raises
    `ReviewError` for a folder without parts."""
    if path.is_dir():
        todo = parts(path)
        if not todo:
            raise ReviewError(f"no recordings 0001.rrd, ... in {path}")
    else:
        todo = [path]
    for one in todo:
        if stop():
            return
        try:
            yield one, mend(one)
        except ReviewError as error:
            yield one, error


def _index(path: Path) -> str:
    """Write the index of `path`; why that was not possible, empty if it was."""
    binary = find_program()
    if binary is None:
        return "rerun's command line program is not installed"
    if shutil.disk_usage(path.parent).free < 2 * path.stat().st_size:
        return "the disk has no room for a copy"
    with tempfile.TemporaryDirectory(prefix=".repair-", dir=path.parent) as folder:
        copy = Path(folder) / path.name
        command = [str(binary), "rrd", "merge", str(path), "-o", str(copy)]
        try:
            done = subprocess.run(
                command, capture_output=True, env=quiet(Path(folder)), timeout=MERGE_TIME, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            return f"{type(error).__name__}"
        if done.returncode or not copy.is_file() or not has_index(copy) or _count(copy) != _count(path):
            return "rerun could not rewrite it"
        shutil.copystat(path, copy)
        os.replace(copy, path)
    return ""


def _count(path: Path) -> int:
    return sum(1 for _ in read(path))
