"""Tracks from a table, CSV or Parquet, as `fusion-service export` writes it; `schemas.flat` says its columns.

Each source in the table is a sensor here; its rows of one time are one scan, all the tracks there were. What the table
does not say is not made up: no sensor info is published, so that a centre uses its own defaults of period and motion.
Rows of `kind` truth are the truth. A track without a covariance cannot be published and is refused with its line.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.errors import DataError
from fusion_service.extras import install_hint
from schemas import check_name, unpack_lower
from schemas.flat import frame_of, lower, space_of
from sensor_clients.events import Event, Scenario

__all__ = ["SUFFIXES", "lineage", "load"]

Floats = NDArray[np.float64]
SUFFIXES = (".csv", ".parquet")


class _Table(NamedTuple):
    """R rows: texts (R,); time, updated (ns, -1: not said), track, existence (R,); state (R, n); packed (R, p)."""

    space: tuple[str, ...]
    source: list[str]
    kind: list[str]
    frame: list[str]
    lineage: list[str]
    time: NDArray[np.int64]
    track: NDArray[np.uint64]
    updated: NDArray[np.int64]
    existence: Floats
    state: Floats
    packed: Floats


def load(path: Path) -> Scenario:
    """The tracks of `path` as a scenario. Raises FileNotFoundError, ImportError for Parquet
    without pyarrow, and `DataError`, which says what is wrong, and where."""
    table = _read(path)
    if not len(table.time):
        raise DataError(f"{path}: no rows")
    order = np.argsort(table.time, kind="stable")
    names = np.array(table.source)
    truth = np.array(table.kind) == "truth"
    try:
        sensors = {
            check_name(name): partial(_tracks, table, order[(names == name)[order] & ~truth[order]])
            for name in dict.fromkeys(names[~truth].tolist())
        }
    except ValueError as error:
        raise DataError(f"{path}: {error}") from None
    bad = np.flatnonzero(~truth & ~np.isfinite(table.packed).all(axis=1))
    if len(bad):
        raise DataError(f"{path}: row {bad[0] + 2} has no covariance")
    first, last = int(table.time[order[0]]), int(table.time[order[-1]])
    return Scenario(
        name=path.stem,
        summary=f"tracks of {path.name}",
        start=first,
        duration=(last - first) / 1e9,
        origin="replay",
        parameters=(),
        sensors=sensors,
        truth=partial(_truth, table, order[truth[order]]),
    )


def _tracks(table: _Table, rows: NDArray[np.intp], seed: int) -> Iterator[Event]:
    n = len(table.space)
    for scan in _scans(table, rows):
        fields: dict[str, Any] = {
            "space": table.space,
            "frame": frame_of(table.frame[scan[0]]),
            "ids": table.track[scan],
            "means": table.state[scan],
            "covariances": unpack_lower(table.packed[scan], n),
            "complete": True,
        }
        if np.isfinite(table.existence[scan]).all():
            fields["existence"] = table.existence[scan]
        if (table.updated[scan] >= 0).all():
            fields["updated"] = table.updated[scan]
        yield Event(int(table.time[scan[0]]), "tracks", fields)


def _truth(table: _Table, rows: NDArray[np.intp]) -> Iterator[Event]:
    for scan in _scans(table, rows):
        frame = frame_of(table.frame[scan[0]])
        fields = {"space": table.space, "frame": frame, "ids": table.track[scan], "means": table.state[scan]}
        yield Event(int(table.time[scan[0]]), "truth", fields)


def _scans(table: _Table, rows: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """The rows, in the order of time, cut where it changes."""
    return np.split(rows, np.flatnonzero(np.diff(table.time[rows])) + 1) if len(rows) else []


def lineage(path: Path, sensor: str) -> tuple[str, ...] | None:
    """The sources whose data the tracks of `sensor` contain; None where the table says none.
    Raises as `load` does."""
    table = _read(path)
    said = {text for text, name in zip(table.lineage, table.source, strict=True) if name == sensor and text}
    return tuple(sorted({name for text in said for name in text.split()})) or None


def _read(path: Path) -> _Table:
    columns = _parquet(path) if path.suffix == ".parquet" else _csv(path)
    try:
        space = space_of(tuple(columns))
    except ValueError as error:
        raise DataError(f"{path}: {error}") from None

    def numbers(name: str) -> list[float]:
        return [
            math.nan if value in ("", None) else _as(float, value, name, k) for k, value in enumerate(columns[name])
        ]

    def whole(name: str, missing: int | None = None) -> list[int]:
        return [
            missing if value in ("", None) and missing is not None else _as(int, value, name, k)
            for k, value in enumerate(columns[name])
        ]

    def _as(kind: Any, value: Any, name: str, row: int) -> Any:
        try:
            return kind(value)
        except (TypeError, ValueError):
            raise DataError(f"{path}: row {row + 2}: {name} is {value!r}, no number") from None

    covariances = [f"cov_{space[i]}_{space[j]}" for i, j in lower(space)]
    try:
        for text in set(columns["frame"]):
            frame_of(text)
        return _Table(
            space,
            columns["source"],
            columns["kind"],
            columns["frame"],
            columns["lineage"],
            np.array(whole("time_ns"), dtype=np.int64),
            np.array(whole("track_id"), dtype=np.uint64),
            np.array(whole("updated_ns", -1), dtype=np.int64),
            np.array(numbers("existence")),
            np.array([numbers(name) for name in space]).reshape(len(space), -1).T.copy(),
            np.array([numbers(name) for name in covariances]).reshape(len(covariances), -1).T.copy(),
        )
    except OverflowError:
        raise DataError(f"{path}: a time or a track id is too large") from None
    except DataError:
        raise
    except ValueError as error:
        raise DataError(f"{path}: {error}") from None


def _csv(path: Path) -> dict[str, list[Any]]:
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.reader(file)
        try:
            names = next(reader, [])
            rows = list(reader)
        except (UnicodeDecodeError, csv.Error) as error:
            raise DataError(f"{path} is no CSV file ({error})") from None
    for number, row in enumerate(rows, 2):
        if len(row) != len(names):
            raise DataError(f"{path}: row {number} has {len(row)} fields, not {len(names)}")
    return {name: [row[k] for row in rows] for k, name in enumerate(names)}


def _parquet(path: Path) -> dict[str, list[Any]]:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise ImportError(f"Parquet needs pyarrow ({error}): {install_hint('record')}") from None
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}")
    try:
        columns: dict[str, list[Any]] = parquet.read_table(path).to_pydict()
    except pa.ArrowInvalid as error:
        raise DataError(f"{path} is no Parquet file ({error})") from None
    return columns
