"""A message as a line for people, and a payload as it is on the wire."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from typing import Any

import msgpack
import numpy as np

from fusion_service.hints.inspecting import Inspected
from schemas import GlobalTracks, LocalIntensity, LocalTracks, Message, SensorInfo, Status, StepLog, Truth

__all__ = ["raw_line", "shown"]

STATES = ("tentative", "confirmed", "coasting")
LONGEST = 100_000


def shown(key: str, data: bytes, found: Inspected, received: int, tracks: int = 0) -> list[str]:
    """A line, one for each of the first `tracks` tracks, and one for each thing that is wrong."""
    clock = datetime.fromtimestamp(received / 1e9, UTC).strftime("%H:%M:%S.%f")[:-3]
    if found.message is None:
        lines = [f"{clock} {key}  {len(data)} bytes that cannot be read"]
    else:
        lines = [f"{clock} {key}  {_summary(found.message, received)}"]
        lines += _tracks(found.message, tracks)
    return lines + [f"    WRONG ({one.reason}) {one.said}" for one in found.findings]


def raw_line(key: str, data: bytes) -> str:
    """The key and the map in a payload as JSON: bytes in hex; of what is no MessagePack its bytes."""
    try:
        value = msgpack.unpackb(data, strict_map_key=False) if len(data) <= LONGEST else data[:LONGEST]
    except (ValueError, TypeError, RecursionError):
        value = data
    return json.dumps({"key": key, "bytes": len(data), "payload": value}, default=_plain)


def _plain(value: Any) -> Any:
    return value.hex() if isinstance(value, bytes) else str(value)


def _summary(message: Message, received: int) -> str:
    age = (received - getattr(message, "time", message.sent)) / 1e9
    old = f"{age:.3f} s old" if abs(age) < 86400 else f"{age / 86400:.0f} days old"
    head = f"{message.type} {message.source} seq {message.seq} {message.origin} {old}"
    if isinstance(message, (LocalTracks, Truth)):
        return f"{head}: {len(message.ids)} of {' '.join(message.space)} in {_frame(message.frame)}"
    if isinstance(message, LocalIntensity):
        return f"{head}: {len(message.weights)} components, {float(np.sum(message.weights)):.2f} objects"
    if isinstance(message, GlobalTracks):
        counts = np.bincount(message.status, minlength=3).tolist()
        told = ", ".join(f"{count} {name}" for count, name in zip(counts, STATES, strict=False) if count) or "no tracks"
        return f"{head}: step {message.step}{' (delta)' * bool(message.delta)}, {told}, {len(message.ended)} ended"
    if isinstance(message, SensorInfo):
        where = ", ".join(f"{one:g}" for one in message.position)
        seen = "no coverage" if message.coverage is None else message.coverage.kind
        return (
            f"{head}: at {where} in {_frame(message.frame)}, every {message.period:g} s, {message.motion.kind}, {seen}"
        )
    if isinstance(message, StepLog):
        sizes = (len(message.taken), len(message.refused), len(message.dropped), len(message.decisions.kind))
        return (
            f"{head}: step {message.step}, {sizes[0]} taken, {sizes[1]} refused, {sizes[2]} dropped, {sizes[3]} decided"
        )
    if isinstance(message, Status):
        return f"{head}: step {message.step}, {len(message.sources)} sources, up {message.uptime:.0f} s"
    return head


def _frame(frame: Any) -> str:
    if frame.kind == "enu":
        return f"enu {frame.lat:.4f} {frame.lon:.4f}"
    return f"{frame.kind} {getattr(frame, 'name', '')}".strip()


def _tracks(message: Message, most: int) -> list[str]:
    if not isinstance(message, (LocalTracks, GlobalTracks, Truth)) or not most:
        return []
    counts = getattr(message, "counts", None)
    firsts = np.arange(len(message.ids)) if counts is None else np.cumsum(counts.astype(np.intp)) - counts
    lines = []
    for place, first in zip(message.ids.tolist()[:most], firsts.tolist(), strict=False):
        mean = message.means[first]
        covariances = getattr(message, "covariances", None)
        sigma = None if covariances is None else np.diag(covariances[first])
        parts = [
            f"{name} {value:.6g}"
            + ("" if sigma is None else f" ± {math.sqrt(sigma[k]):.3g}" if sigma[k] >= 0 else " ± ?")
            for k, (name, value) in enumerate(zip(message.space, mean.tolist(), strict=True))
        ]
        lines.append(f"    {place}: {', '.join(parts)}")
    return lines
