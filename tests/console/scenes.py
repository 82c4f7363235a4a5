"""Messages of a centre for tests of the console, its binary messages read, and requests to its web server."""

from __future__ import annotations

import http.client
import json
from typing import Any

import numpy as np

from schemas import Enu, Frame, GlobalTracks, Status, StepLog
from schemas.messages import BROKEN, EXCHANGED, GATE_FAILED, KEPT, LINKED, NO_SOURCE, Decisions

SECOND = 10**9
HARBOUR = Enu(59.0, 10.5)
FIRST = (7 << 32) + 1
"""The least of the ids."""
OF_LOCALS = (LINKED, KEPT, BROKEN, GATE_FAILED, EXCHANGED)
KINDS = {"u1": np.uint8, "u4": np.uint32, "f4": np.float32, "f8": np.float64}


def picture(count: int = 3, step: int = 1, frame: Frame = HARBOUR, name: str = "centre", **more: Any) -> GlobalTracks:
    """Tracks 100 m apart on a line to the east, 5 m/s to the north, 20 m by 10 m, from two sources each."""
    means = np.zeros((count, 4))
    means[:, 0] = 100.0 * np.arange(count)
    means[:, 3] = 5.0
    k = 2 * count
    given: dict[str, Any] = {
        "source": name, "epoch": 1, "seq": step, "sent": step * SECOND, "time": step * SECOND, "step": step,
        "rule": "ci", "space": ("x", "y", "vx", "vy"), "frame": frame,
        "ids": np.arange(FIRST, FIRST + count, dtype=np.uint64), "status": np.arange(count, dtype=np.uint8) % 3,
        "existence": np.full(count, 0.9), "means": means,
        "covariances": np.tile(np.diag([400.0, 100.0, 1.0, 1.0]), (count, 1, 1)),
        "updated": np.full(count, step * SECOND, dtype=np.int64), "sources": ("r1", "r2"),
        "contributor_counts": np.full(count, 2, dtype=np.uint16),
        "contributor_source": np.tile([0, 1], count).astype(np.uint16),
        "contributor_epoch": np.full(k, 2**63, dtype=np.uint64), "contributor_id": np.arange(k, dtype=np.uint64),
        "contributor_influence": np.tile([0.25, 0.75], count),
    }  # fmt: skip
    return GlobalTracks(**{**given, **more})


def step_log(rows: list[tuple[int, int, int, float]], step: int = 1, **more: Any) -> StepLog:
    """Decisions (kind, track, other, value), each about local track 0 of r1 where its kind is about one."""
    kinds, tracks, others, values = zip(*rows, strict=True) if rows else ((), (), (), ())
    count = len(rows)
    decisions = Decisions(
        np.array(kinds, dtype=np.uint8),
        np.array(tracks, dtype=np.uint64),
        np.array([0 if kind in OF_LOCALS else NO_SOURCE for kind in kinds], dtype=np.uint16),
        np.full(count, 2**63, dtype=np.uint64),
        np.zeros(count, dtype=np.uint64),
        np.array(others, dtype=np.uint64),
        np.array(values, dtype=np.float64),
    )
    given: dict[str, Any] = {
        "source": "centre", "epoch": 1, "seq": step, "sent": step * SECOND, "step": step, "time": step * SECOND,
        "config_hash": "", "version": "", "taken": (), "refused": (), "dropped": (), "events": (), "sources": ("r1",),
        "decisions": decisions,
    }  # fmt: skip
    return StepLog(**{**given, **more})


def status(sent: int = SECOND, sources: dict[str, dict[str, Any]] | None = None, name: str = "centre") -> Status:
    return Status(
        source=name, epoch=1, seq=1, sent=sent, time=sent, step=1, uptime=1.0, rates={}, queue={}, refused={},
        dropped={}, sources=sources or {}, tracks={}, step_time={},
    )  # fmt: skip


def unpacked(data: bytes) -> dict[str, Any]:
    """A binary message as the page reads it: the header, with its columns by name."""
    length = int.from_bytes(data[:4], "little")
    header: dict[str, Any] = json.loads(data[4 : 4 + length])
    assert (4 + length) % 8 == 0
    for name, kind, count, offset in header["columns"]:
        assert offset % 8 == 0
        header[name] = np.frombuffer(data, KINDS[kind], count, 4 + length + offset)
    return header


def ask(
    port: int, path: str, method: str = "GET", body: bytes | None = None, **headers: str
) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body; of the headers given, `_` is read as `-`."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        connection.request(method, path, body, {name.replace("_", "-"): value for name, value in headers.items()})
        answer = connection.getresponse()
        return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
    finally:
        connection.close()
