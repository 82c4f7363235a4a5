"""The messages of a recording, as they came.

A recorder that was killed leaves a file without its index, perhaps with half a record at its end. Rerun opens the
first kind as it is, the second only once it is cut after its last whole record, which `repair` does; `read` does it
on a copy. What was flushed is never lost.

A mission in parts is read part by part, as one. What a part repeats of an earlier one is left out; a part that is
missing, or a time without a recorder, is logged.

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
from fusion_service.recording.parts import number_of, parts
from schemas import Message, MessageError, decode

__all__ = ["RawMessage", "has_index", "messages", "read", "recording_id", "repair"]

log = logging.getLogger(__name__)

MAGIC, HEADER, RECORD, END = b"RRF2", 12, struct.Struct("<QQ"), 0


class RawMessage(NamedTuple):
    """A message as it came: the arrival number (from 0, through all parts of a mission), the receive time (ns UTC), its
    key and its bytes."""

    arrival: int
    received: int
    key: str
    data: bytes


def read(path: str | Path) -> Iterator[RawMessage]:
    """Every recorded message of a file, or of a folder of parts, in the order of arrival, decodable or not.

    Reads as it goes: what is held is the part of the file that is not yet in order, about one flush interval.
    Raises `FileNotFoundError`, and `ReviewError` for a file that is no recording.
    """
    path = Path(path)
    if path.is_dir():
        yield from _read_parts(path)
        return
    if not path.is_file():
        raise FileNotFoundError(f"no recording at {path}")
    for message, _ in _read_file(path):
        yield message


def _read_parts(folder: Path) -> Iterator[RawMessage]:
    there = parts(folder)
    if not there:
        raise FileNotFoundError(f"no recordings 0001.rrd, ... in {folder}")
    numbers = [number_of(path) or 0 for path in there]
    if numbers[0] > 1:
        log.warning("%s: begins with part %d, those before are deleted", folder, numbers[0])
    infos: dict[str, bytes] = {}
    arrival, before, last = 0, numbers[0] - 1, 0
    for number, path in zip(numbers, there, strict=True):
        if number > before + 1:
            log.warning("%s: no part %d%s", folder, before + 1, f" to {number - 1}" if number > before + 2 else "")
        before, ended, begun = number, last, 0
        begins: list[str] = []
        try:
            for message, standing in _read_file(path, begins):
                if standing and infos.get(message.key) == message.data:
                    continue
                if message.key.endswith("/info"):
                    infos[message.key] = message.data
                if not standing:
                    begun, last = begun or message.received, message.received
                yield message._replace(arrival=arrival)
                arrival += 1
        except (ReviewError, FileNotFoundError) as error:  # the latter: its recorder has deleted it meanwhile
            log.warning("part left out: %s", error)
        if ended and begun and any("resume" in cell for cell in begins):
            log.warning("%s: %.1f s without a recorder before part %d", folder, (begun - ended) / 1e9, number)


def _read_file(path: Path, begins: list[str] | None = None) -> Iterator[tuple[RawMessage, bool]]:
    """Each message, and whether it is repeated from an earlier part. `begins` is told how the part began, as `Recorder`
    wrote it."""
    content = ["/raw/**"] if begins is None else ["/raw/**", "/__properties/part"]
    with tempfile.TemporaryDirectory(prefix="rrd-") as folder:
        waiting: list[tuple[RawMessage, bool]] = []
        following = 0
        for chunk in _open_whole(path, Path(folder)).stream().filter(content=content):
            if begins is not None and not chunk.entity_path.startswith("/raw/"):
                batch = chunk.to_record_batch()
                if "begins" in batch.schema.names:
                    begins += [str(cell) for cell in batch.column("begins").to_pylist()]
                continue
            standing = chunk.entity_path.startswith("/raw/standing/")
            for message in _rows(chunk):
                heapq.heappush(waiting, (message, standing))
            while waiting and waiting[0][0].arrival == following:
                yield heapq.heappop(waiting)
                following += 1
        while waiting:  # after a gap: the part of the last flush that a torn file has lost
            yield heapq.heappop(waiting)


def recording_id(path: Path) -> str:
    """The id that all parts of a mission share."""
    return str(_open(path).recordings()[0].recording_id)


def has_index(path: Path) -> bool:
    """Whether a recording that opens has its index (a killed recorder's has none)."""
    import_rerun()
    from rerun.chunk import RrdReader

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "RRD file has no footer")
        try:
            RrdReader(path).store()
        except RuntimeError:
            return False
    return True


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
    if not path.is_file():
        raise FileNotFoundError(f"no recording at {path}")
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
