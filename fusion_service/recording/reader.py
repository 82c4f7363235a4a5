"""The messages of a recording, as they came.

A recorder that was killed leaves a file without its index, perhaps with half a record at its end. Rerun opens the
first kind as it is, the second only once it is cut after its last whole record, which `repair` does; `read` does it
on a copy. What was flushed is never lost.

A mission in parts is read part by part, as one. What a part repeats of an earlier one is left out; a part that is
missing, or a time without a recorder, is logged.

The file (RRF2) is a header of 12 bytes, then records: kind and length (u64 each, little-endian), payload. What is
damaged within is left out, and said (`salvage`).
"""

from __future__ import annotations

import contextlib
import heapq
import logging
import os
import shutil
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from fusion_service.errors import ReviewError
from fusion_service.recording.columns import import_rerun
from fusion_service.recording.parts import number_of, parts
from fusion_service.recording.salvage import HEADER, NOTHING_YET, nothing_yet, salvage, whole_part
from schemas import Message, MessageError, decode

__all__ = ["RawMessage", "Watch", "has_index", "messages", "read", "read_file", "recording_id", "repair", "stored"]

log = logging.getLogger(__name__)


class RawMessage(NamedTuple):
    """A message as it came: the arrival number (from 0, through all parts of a mission), the receive time (ns UTC), its
    key and its bytes."""

    arrival: int
    received: int
    key: str
    data: bytes


class Watch(Protocol):
    """Who is shown what else there is in a file."""

    def seals(self, chunk: Any) -> None:
        """A chunk of what is below /seal."""

    def double(self, message: RawMessage) -> None:
        """A message that is left out, for one with its number was read before."""


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
    for message, _ in read_file(path):
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
            for message, standing in read_file(path, begins):
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


def read_file(
    path: Path, begins: list[str] | None = None, watch: Watch | None = None
) -> Iterator[tuple[RawMessage, bool]]:
    """Each message of one file, with its arrival number there, and whether it is repeated from an earlier part.
    `begins` is told how the part began, as `Recorder` wrote it; `watch` of seals. Raises as `read`."""
    content = ["/raw/**", *["/__properties/part"] * (begins is not None), *["/seal/**"] * (watch is not None)]
    with tempfile.TemporaryDirectory(prefix="rrd-") as folder:
        waiting: list[tuple[RawMessage, bool]] = []
        following = 0
        for chunk, again in _chunks(path, Path(folder), content):
            if watch is not None and chunk.entity_path.startswith("/seal/"):
                watch.seals(chunk)
                continue
            if begins is not None and not chunk.entity_path.startswith("/raw/"):
                batch = chunk.to_record_batch()
                if "begins" in batch.schema.names:
                    begins += [str(cell) for cell in batch.column("begins").to_pylist()]
                continue
            standing = chunk.entity_path.startswith("/raw/standing/")
            for message in _rows(chunk):
                if message.arrival >= following:
                    heapq.heappush(waiting, (message, standing))
                elif watch is not None and not again:
                    watch.double(message)
            while waiting and waiting[0][0].arrival == following:
                yield heapq.heappop(waiting)
                following += 1
        last = -1
        while waiting:  # after a gap: what a torn or damaged file has lost
            one = heapq.heappop(waiting)
            if one[0].arrival != last:
                yield one
            last = one[0].arrival


def _chunks(path: Path, folder: Path, content: list[str]) -> Iterator[tuple[Any, bool]]:
    """The chunks of a file. Of a torn one, those of its whole part; where it is damaged, those of what decodes, with
    those that may have been read already before the damage was met."""
    whole, damaged = whole_part(path)
    copy = folder / path.name
    try:
        if not damaged:
            for chunk in _open(_torn(path, copy, whole), path).stream().filter(content=content):
                yield chunk, False
    except RuntimeError:
        damaged = True
    if damaged:
        lost = salvage(path, copy)
        log.warning("%s is damaged: %s", path, lost)
        for chunk in _open(copy, path).stream().filter(content=content):
            yield chunk, True


def _torn(path: Path, copy: Path, whole: int) -> Path:
    """`path`, or if that is torn, its `whole` part in `copy`."""
    if not 0 < whole < path.stat().st_size:
        return path
    log.warning("%s is torn: reading the whole part", path)
    shutil.copyfile(path, copy)
    os.truncate(copy, whole)
    return copy


def stored(path: Path, content: list[str]) -> Iterator[Any]:
    """The chunks of some entities of a file that opens."""
    yield from _open(path).stream().filter(content=content)


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


def repair(path: str | Path) -> int:
    """Cut a torn recording, in place, after its last whole record, so that viewers open it. Returns the bytes cut,
    0 for a file that is not torn. `ReviewError` for a file that is no recording."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no recording at {path}")
    (whole, damaged), size = whole_part(path), path.stat().st_size
    if damaged:
        return 0
    if 0 < whole < size:
        os.truncate(path, whole)
    with contextlib.suppress(RuntimeError):  # damaged as well
        _open(path)
    return size - path.stat().st_size


def _open(path: Path, named: Path | None = None) -> Any:
    """A reader of `path`, which is `named` in errors. `RuntimeError` where it is damaged."""
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
        except RuntimeError:
            if whole_part(path)[0] > HEADER and not named:
                raise
    if nothing_yet(named or path):
        raise ReviewError(f"{named or path}: {NOTHING_YET}")
    raise ReviewError(f"{named or path} is not a recording, or nothing of it can be read")


def _rows(chunk: Any) -> Iterator[RawMessage]:
    columns = chunk.to_record_batch()
    received = columns.column("received").to_numpy(zero_copy_only=False).astype(np.int64).tolist()
    arrivals, keys, blobs = (
        columns.column(name).to_pylist() for name in ("arrival", "RawMessage:key", "RawMessage:msg")
    )
    for arrival, time, key, blob in zip(arrivals, received, keys, blobs, strict=True):
        yield RawMessage(arrival, time, key[0], blob[0])
