"""Where a review command may write, asked before its work: never over what it reads, nor among the parts of a mission.

Pages and tables of numbers are made anew each time; a recording is never written over.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from fusion_service.errors import ReviewError
from fusion_service.recording.parts import number_of

__all__ = ["check_page", "check_recording"]


def check_page(page: str | Path, *read: str | Path) -> None:
    """Raises `ReviewError` where `page` cannot be written, or is one of the files `read` (a folder stands for its
    parts)."""
    page = Path(page)
    if page.is_dir() or not page.parent.is_dir():
        raise ReviewError(f"cannot write {page}: name a file in a folder that exists")
    if page.exists() and any(page.samefile(file) for file in _files(map(Path, read))):
        raise ReviewError(f"{page} is what is read: name another file to write")


def check_recording(out: str | Path, read: str | Path) -> None:
    """Raises `ReviewError` where `out` is there already, as a file or as a folder of parts that would be gone on with,
    or would be a part of the mission `read`."""
    out, read = Path(out), Path(read)
    if out.exists():
        raise ReviewError(f"{out} exists already: name another file, or move it away")
    if read.is_dir() and number_of(out) is not None and out.parent.exists() and out.parent.samefile(read):
        raise ReviewError(f"{out} would be taken for a part of the mission that is read: write it to another folder")


def _files(read: Iterable[Path]) -> Iterable[Path]:
    for path in read:
        yield from path.glob("*.rrd") if path.is_dir() else [path] if path.exists() else []
