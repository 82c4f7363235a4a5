"""The messages of a recording, as they came.

A recorder that was killed leaves a file without its index, perhaps with half a record at its end. Rerun reads
the first kind as it is; the second is copied up to its last whole record by `rerun rrd merge
--continue-on-error`, and the copy is read. What was flushed is never lost.
"""

from __future__ import annotations

import heapq
import importlib.util
import logging
import subprocess
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fusion_service.recording.columns import import_rerun
from schemas import Message, MessageError, decode

__all__ = ["RawMessage", "messages", "read"]

log = logging.getLogger(__name__)


class RawMessage(NamedTuple):
    """A message as it came: the arrival number (from 0), the receive time (ns UTC), its key and its bytes."""

    arrival: int
    received: int
    key: str
    data: bytes


def read(path: str | Path) -> Iterator[RawMessage]:
    """Every recorded message in the order of arrival, decodable or not.

    Reads as it goes: what is held is the part of the file that is not yet in order, about one flush interval.
    Raises `FileNotFoundError`, and `ValueError` for a file that is no recording.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no recording at {path}")
    with tempfile.TemporaryDirectory(prefix="rrd-") as folder:
        waiting: list[RawMessage] = []
        following = 0
        for chunk in _open(path, Path(folder)).stream().filter(content="/raw/**"):
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


def _open(path: Path, folder: Path) -> Any:
    """A reader of `path`, or of its repaired copy in `folder`."""
    import_rerun()
    from rerun.chunk import RrdReader

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "RRD file has no footer")
        try:
            reader = RrdReader(path)
            if reader.recordings():
                return reader
        except RuntimeError as error:
            log.warning("%s is torn, reading a repaired copy (%s)", path, error)
            repaired = _repair(path, folder / path.name)
            if repaired is not None and (reader := RrdReader(repaired)).recordings():
                return reader
    raise ValueError(f"{path} is not a recording")


def _repair(path: Path, target: Path) -> Path | None:
    spec = importlib.util.find_spec("rerun_cli")
    binary = Path(str(spec.origin)).with_name("rerun") if spec else Path("rerun")
    command: list[str | Path] = [binary, "rrd", "merge", "--continue-on-error", path, "-o", target]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode or not target.is_file():
        log.warning("no repair of %s: %s", path, done.stderr.strip().splitlines()[-1:])
        return None
    return target


def _rows(chunk: Any) -> Iterator[RawMessage]:
    columns = chunk.to_record_batch()
    received = columns.column("received").to_numpy(zero_copy_only=False).astype(np.int64).tolist()
    arrivals, keys, blobs = (
        columns.column(name).to_pylist() for name in ("arrival", "RawMessage:key", "RawMessage:msg")
    )
    for arrival, time, key, blob in zip(arrivals, received, keys, blobs, strict=True):
        yield RawMessage(arrival, time, key[0], blob[0])
