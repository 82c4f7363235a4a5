"""Making a recording of a few messages, and what one holds, read with Rerun itself."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

from fusion_service.recording import Recorder
from schemas import Message, encode, global_key, local_key, truth_key

FIRST = 1_790_000_000 * 10**9
"""Receive time of the first message that `record` hands over, ns; the others follow a nanosecond apart."""


def rows(path: Path, entity: str) -> list[dict[str, Any]]:
    """The rows of `entity` that are not static, by mission time: "time" (ns), and each component's instances under
    its full name, as in "Points2D:positions"."""
    found: list[dict[str, Any]] = []
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "RRD file has no footer")
        reader = RrdReader(path)
    for chunk in reader.stream().filter(content=entity):
        if chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        names = batch.schema.names
        times = batch.column("time").cast("int64").to_pylist() if "time" in names else [None] * batch.num_rows
        columns = {name: batch.column(name).to_pylist() for name in names if ":" in name}
        for index, time in enumerate(times):
            found.append({"time": time} | {name: column[index] for name, column in columns.items()})
    return sorted(found, key=lambda row: (row["time"] is None, row["time"]))


def row(path: Path, entity: str, time: int) -> dict[str, Any]:
    """The one row of `entity` at `time`."""
    (found,) = (row for row in rows(path, entity) if row["time"] == time)
    return found


def static(path: Path, entity: str) -> dict[str, Any]:
    """What holds at all times for `entity`: each component's instances, those said last."""
    found: dict[str, Any] = {}
    for chunk in RrdReader(path).stream().filter(content=entity):
        if chunk.is_static:
            batch = chunk.to_record_batch()
            found |= {name: batch.column(name).to_pylist()[-1] for name in batch.schema.names if ":" in name}
    return found


def opacities(path: Path, entity: str) -> dict[int, int]:
    """The alpha, 0 to 255, of each class of `entity`."""
    (context,) = static(path, entity)["AnnotationContext:context"]
    return {item["class_id"]: item["class_description"]["info"]["color"] & 0xFF for item in context}


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(path).stream()}


def key_of(message: Message) -> str:
    return {
        "local_tracks": lambda: local_key(message.source, "tracks"),
        "local_intensity": lambda: local_key(message.source, "intensity"),
        "sensor_info": lambda: local_key(message.source, "info"),
        "global_tracks": lambda: global_key(message.source, "tracks"),
        "truth": lambda: truth_key(message.source),
    }[message.type]()


def record(path: Path, *said: Message, **options: Any) -> Recorder:
    with Recorder(path, **options) as recorder:
        for number, message in enumerate(said):
            recorder.handle(key_of(message), encode(message), FIRST + number)
    return recorder


def texts(path: Path, about: str) -> list[str]:
    return [said["TextLog:text"][0] for said in rows(path, f"/log/{about}")]
