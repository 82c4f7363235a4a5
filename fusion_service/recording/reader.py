"""The messages of a recording, as they came.

A recorder that was killed leaves a file without its index, perhaps with half a record at its end. Rerun opens the
first kind as it is, the second only once it is cut after its last whole record, which `repair` does; `read` does it
on a copy. What was flushed is never lost.

The file (RRF2) is a header of 12 bytes, then records: kind and length (u64 each, little-endian), payload.
"""

from __future__ import annotations

import heapq
import logging
import os
import shutil
import struct
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fusion_service.errors import ReviewError
from fusion_service.recording.columns import import_rerun
from schemas import Message, MessageError, decode

__all__ = ["RawMessage", "messages", "read", "repair"]

log = logging.getLogger(__name__)

MAGIC, HEADER, RECORD, END = b"RRF2", 12, struct.Struct("<QQ"), 0


class RawMessage(NamedTuple):
    """A message as it came: the arrival number (from 0), the receive time (ns UTC), its key and its bytes."""

    arrival: int
    received: int
    key: str
    data: bytes


def read(path: str | Path) -> Iterator[RawMessage]:
    """Every recorded message in the order of arrival, decodable or not.

    Reads as it goes: what is held is the part of the file that is not yet in order, about one flush interval.
    Raises `FileNotFoundError`, and `ReviewError` for a file that is no recording.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no recording at {path}")
    with tempfile.TemporaryDirectory(prefix="rrd-") as folder:
        waiting: list[RawMessage] = []
        following = 0
        for chunk in _open_whole(path, Path(folder)).stream().filter(content="/raw/**"):
            for message in _rows(chunk):
                heapq.heappush(waiting, message)
            while waiting and waiting[0].arrival == following:
                yield heapq.heappop(waiting)
                following += 1
        while waiting:  # after a gap: the part of the last flush that a torn file has lost
            yield heapq.heappop(waiting)


def messages(path: str | Path) -> list[Message]:
    """Every message that decodes, in the order of arrival; the others are counted by reason in one warning."""
    good: list[Message] = []
    bad: Counter[str] = Counter()
    for raw in read(path):
        try:
            good.append(decode(raw.data))
        except MessageError as error:
            bad[error.reason] += 1
    if bad:
        log.warning("%s: %d messages do not decode (%s)", path, bad.total(), _counts(bad))
    return good


def _counts(counter: Counter[str]) -> str:
    return ", ".join(f"{reason} {count}" for reason, count in sorted(counter.items()))


def _open_whole(path: Path, folder: Path) -> Any:
    """A reader of `path`, or if that is torn, of its whole part in `folder`."""
    try:
        return _open(path)
    except _TornError as error:
        log.warning("%s: reading the whole part", error)
        copy = folder / path.name
        shutil.copyfile(path, copy)
        repair(copy)
        return _open(copy)


def repair(path: str | Path) -> int:
    """Cut a torn recording, in place, after its last whole record, so that viewers open it. Returns the bytes cut,
    0 for a file that opens. `ReviewError` for a file that is no recording."""
    path = Path(path)
    try:
        _open(path)
        return 0
    except _TornError:
        size = path.stat().st_size
        os.truncate(path, _whole(path))
        _open(path)
        return size - path.stat().st_size


class _TornError(Exception):
    """A recording that ends within a record."""


def _open(path: Path) -> Any:
    """A reader of `path`."""
    import_rerun()
    from rerun.chunk import RrdReader

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "RRD file has no footer")
        try:
            reader = RrdReader(path)
            if reader.recordings():
                return reader
        except RuntimeError as error:
            if 0 < _whole(path) < path.stat().st_size:
                raise _TornError(f"{path} is torn ({error})") from None
    raise ReviewError(f"{path} is not a recording")


def _whole(path: Path) -> int:
    """The length of `path` up to the end of its last whole record, 0 for another kind of file."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(HEADER)[:4] != MAGIC:
            return 0
        whole = HEADER
        while whole + RECORD.size <= size:
            file.seek(whole)
            kind, length = RECORD.unpack(file.read(RECORD.size))
            if kind == END or whole + RECORD.size + length > size:
                break
            whole += RECORD.size + length
    return whole


def _rows(chunk: Any) -> Iterator[RawMessage]:
    columns = chunk.to_record_batch()
    received = columns.column("received").to_numpy(zero_copy_only=False).astype(np.int64).tolist()
    arrivals, keys, blobs = (
        columns.column(name).to_pylist() for name in ("arrival", "RawMessage:key", "RawMessage:msg")
    )
    for arrival, time, key, blob in zip(arrivals, received, keys, blobs, strict=True):
        yield RawMessage(arrival, time, key[0], blob[0])
