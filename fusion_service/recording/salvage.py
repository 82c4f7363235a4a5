"""What is left of a recording that is damaged in the middle.

The file (RRF2) is a header, then records: kind and length (u64 each, little-endian), payload. Where a record does not
lead to another, the next one is looked for byte by byte; of those found, each that Rerun does not decode is left out,
found by halving. The index at the end points at places that may have moved and is left out too; so is what a record
says that a damage left readable: its messages have digests in the step logs.
"""

from __future__ import annotations

import mmap
import struct
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from fusion_service.recording.columns import import_rerun

__all__ = ["HEADER", "MAGIC", "NOTHING_YET", "RECORD", "Lost", "decodes", "nothing_yet", "salvage", "whole_part"]

NOTHING_YET = "nothing has been recorded in it yet: its recorder has just begun, or ended at once"
MAGIC, HEADER, RECORD = b"RRF2", 12, struct.Struct("<QQ")
END, STORE, CHUNK, ACTIVATION = 0, 1, 2, 3
TRAILER = 32
"""Bytes after the index, which is the payload of END."""
TOGETHER = 64
"""Records that are tried at once."""


class Lost(NamedTuple):
    """What was left out: records that do not decode, and bytes in all."""

    records: int = 0
    bytes: int = 0

    def __str__(self) -> str:
        return f"{self.bytes:,} bytes left out, in which {self.records} records that do not decode"


class _Span(NamedTuple):
    begin: int
    end: int


def decodes(path: Path) -> bool:
    """Whether Rerun reads every record of a file."""
    import_rerun()
    from rerun.chunk import RrdReader

    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "RRD file has no footer")
            for chunk in RrdReader(path).stream():
                chunk.to_record_batch()
    except Exception:  # of whatever kind: the file is hostile, and Rerun promises none
        return False
    except BaseException as error:  # a panic of its Rust core is no `Exception`
        if type(error).__name__ != "PanicException":
            raise
        return False
    return True


def whole_part(path: Path) -> tuple[int, bool]:
    """The length of a file up to the end of its last record that follows all others, and whether more records come
    after that: then it is damaged, else torn where it is longer. 0 for another kind of file."""
    size = path.stat().st_size
    if size <= HEADER:
        return 0, False
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if data[: len(MAGIC)] != MAGIC:
            return 0, False
        at = HEADER
        while (end := _end(data, at, size)) > 0:
            at = end
        if _closes(data, at, size):
            return size, False
        return at, at < size and _next(data, at + 1, size) < size


def nothing_yet(path: Path) -> bool:
    """Whether a file is the very beginning of a recording, of which no record is whole: its recorder has just begun, or
    was ended at once."""
    with path.open("rb") as file:
        head = file.read(len(MAGIC))
    return MAGIC.startswith(head) and whole_part(path) in ((0, False), (HEADER, False))


def salvage(path: Path, target: Path) -> Lost:
    """Write what decodes of `path` to `target`. A file of which nothing does becomes a header."""
    size = path.stat().st_size
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        spans = list(_spans(data, size))
        with target.open("wb") as out, tempfile.TemporaryDirectory(prefix="rrd-") as folder:
            head = data[:HEADER]
            out.write(head)
            stores = [span for span in spans if _kind(data, span.begin) == STORE]
            lead = next((span for span in stores if _good(data, head, [span], Path(folder))), None)
            kept = count = 0
            for begin in range(0, len(spans), TOGETHER) if lead else ():
                for span in _kept(data, head, lead, spans[begin : begin + TOGETHER], Path(folder)):
                    kept += out.write(data[span.begin : span.end])
                    count += 1
        return Lost(len(spans) - count, size - len(head) - kept)


def _kind(data: mmap.mmap, at: int) -> int:
    return int(RECORD.unpack(data[at : at + RECORD.size])[0])


def _end(data: mmap.mmap, at: int, size: int) -> int:
    """Where the record that may begin here ends, -1: none does."""
    if at + RECORD.size > size:
        return -1
    kind, length = RECORD.unpack(data[at : at + RECORD.size])
    end = at + RECORD.size + length
    return end if kind in (STORE, CHUNK, ACTIVATION) and end <= size else -1


def _leads(data: mmap.mmap, at: int, size: int) -> bool:
    """Whether another record, the index, or the end of the file is here."""
    return at == size or _end(data, at, size) > 0 or _closes(data, at, size)


def _closes(data: mmap.mmap, at: int, size: int) -> bool:
    """Whether the index is here, and then the file ends."""
    if at + RECORD.size > size or _kind(data, at) != END:
        return False
    return at + RECORD.size + int(RECORD.unpack(data[at : at + RECORD.size])[1]) + TRAILER == size


def _spans(data: mmap.mmap, size: int) -> Iterator[_Span]:
    """The records that may be in the file, those beside a damage included."""
    at = HEADER
    while at < size:
        end = _end(data, at, size)
        if end > 0:
            yield _Span(at, end)
        at = end if end > 0 and _leads(data, end, size) else _next(data, at + 1, size)


def _next(data: mmap.mmap, begin: int, size: int) -> int:
    """The next place from which a record leads to another."""
    mark = CHUNK.to_bytes(8, "little")
    at = data.find(mark, begin)
    while at >= 0:
        end = _end(data, at, size)
        if end > 0 and _leads(data, end, size):
            return at
        at = data.find(mark, at + 1)
    return size


def _kept(data: mmap.mmap, head: bytes, lead: _Span | None, spans: Sequence[_Span], folder: Path) -> Iterator[_Span]:
    if not spans:
        return
    tried = spans if lead is None or spans[0] == lead else [lead, *spans]
    if _good(data, head, tried, folder):
        yield from spans
    elif len(spans) > 1:
        half = len(spans) // 2
        yield from _kept(data, head, lead, spans[:half], folder)
        yield from _kept(data, head, lead, spans[half:], folder)


def _good(data: mmap.mmap, head: bytes, spans: Sequence[_Span], folder: Path) -> bool:
    path = folder / "tried.rrd"
    with path.open("wb") as file:
        file.write(head)
        for span in spans:
            file.write(data[span.begin : span.end])
    return decodes(path)
