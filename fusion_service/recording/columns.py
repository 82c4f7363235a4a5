"""Rows that wait for one `send_columns` per entity.

A row logged alone costs Rerun 75-90 us, a row of a column about one: every message of a tick adds its rows
here, and `ColumnWriter.send` writes them, one chunk for each entity, into the recording.

What is static, and what stands at each place of the picture, is remembered, so that a new part of a recording can
begin with it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.extras import install_hint

__all__ = [
    "ColumnWriter",
    "Lines",
    "Mirror",
    "Points",
    "Row",
    "Stamp",
    "documents",
    "entity",
    "import_rerun",
    "raw",
    "texts",
    "weight",
]

log = logging.getLogger(__name__)

ROW = 500
"""Bytes of a row besides its arrays, about."""

Classes = NDArray[np.uint16]


def import_rerun() -> Any:
    """The `rerun` package, imported when first needed (1.8 s). `ImportError` says how to get it."""
    try:
        import rerun
    except ImportError as error:
        raise ImportError(f"recording needs rerun-sdk ({error}): {install_hint('record')}") from error
    return rerun


@lru_cache(maxsize=4096)
def entity(*parts: str) -> str:
    """The entity path of `parts`, each escaped."""
    path: str = import_rerun().new_entity_path(list(parts))
    return path


class Stamp(NamedTuple):
    """Where a row stands: receive time and mission time in ns UTC, arrival number of a raw message."""

    received: int
    time: int | None = None
    arrival: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """T points of one row: plane (T, 2) as Rerun draws it, east and -north in m; geo (T, 2) latitude and longitude
    in degrees, None in a frame without a place on Earth; classes (T,) of the entity's annotation context."""

    plane: Floats
    geo: Floats | None
    labels: list[str] | None = None
    classes: Classes | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """S line strips of one row, one after the other: plane (P, 2) and geo (P, 2) as in `Points`; lengths (S,);
    classes (S,) on the plane, widths (S,) in points of the screen, None for the entity's own."""

    plane: Floats
    geo: Floats | None
    lengths: NDArray[np.int64]
    classes: Classes | None = None
    widths: Floats | None = None


Build = Callable[[Any, Sequence[Any]], list[Any]]


class Row(NamedTuple):
    """`content`, what `build` takes, for the entity `path`."""

    path: str
    build: Build
    stamp: Stamp
    content: Any


class Mirror(Protocol):
    """Who is shown every row and everything static as well."""

    def row(self, row: Row) -> None:
        """A row was added."""

    def static(self, path: str, batches: dict[str, Any]) -> None:
        """The component `batches` of the entity `path`, by name, hold at all times."""


class ColumnWriter:
    """Rows by entity, written to `stream` (a `rerun.RecordingStream`) by `send`, and shown to `mirror` at once."""

    def __init__(self, stream: Any, mirror: Mirror | None = None) -> None:
        self._rr = import_rerun()
        self._stream = stream
        self._mirror = mirror
        self._rows: dict[tuple[str, Build, bool, bool], list[tuple[Stamp, Any]]] = {}
        self._standing: dict[tuple[str, Build], Row] = {}
        self._statics: dict[str, dict[str, Any]] = {}
        self.waiting = 0
        """Rows, and about their bytes, that are not written yet."""
        self.bytes_waiting = 0
        self.sent = 0
        self.failed = 0

    def add(self, path: str, build: Build, stamp: Stamp, content: Any, *, stands: bool = False) -> None:
        """One row of `content` (what `build` takes) for the entity `path`. stands: it holds until the next one, in a
        new part of the recording too."""
        key = (path, build, stamp.time is None, stamp.arrival is None)
        self._rows.setdefault(key, []).append((stamp, content))
        self.waiting += 1
        self.bytes_waiting += weight(content)
        if stands or self._mirror is not None:
            row = Row(path, build, stamp, content)
            if stands:
                self._standing[path, build] = row
            if self._mirror is not None:
                self._mirror.row(row)

    def points(self, path: str, stamp: Stamp, content: Points) -> None:
        """A row of points, which stands until the next."""
        self.add(path, _points, stamp, content, stands=True)

    def lines(self, path: str, stamp: Stamp, content: Lines, *, stands: bool = True) -> None:
        """A row of line strips."""
        self.add(path, _lines, stamp, content, stands=stands)

    def scalar(self, path: str, stamp: Stamp, value: float) -> None:
        """A point of a time series; NaN breaks the line."""
        self.add(path, scalars, stamp, value)

    def static(self, path: str, *archetypes: Any, keep: bool = True) -> None:
        """What holds at all times; the last one said counts. keep: in the parts of the recording to come too."""
        batches = {
            str(batch.component_descriptor()): batch for one in archetypes for batch in one.as_component_batches()
        }
        if keep:
            self._statics.setdefault(path, {}).update(batches)
        self._stream.log(path, list(batches.values()), static=True)
        if self._mirror is not None:
            self._mirror.static(path, batches)

    def restart(self, stream: Any, at: Stamp) -> None:
        """Go on in `stream`: with what is static, and with what stands, at the time `at` or its own later one. Rows
        that wait are to be sent before."""
        self._stream = stream
        for path, batches in self._statics.items():
            stream.log(path, list(batches.values()), static=True)
        for path, build, stamp, content in self._standing.values():
            now = at if stamp.time is None or at.time is None or stamp.time <= at.time else at._replace(time=stamp.time)
            key = (path, build, now.time is None, True)
            self._rows.setdefault(key, []).append((now, content))
            self.waiting += 1

    def send(self) -> None:
        """Write every row that waits, each entity's in the order they were added."""
        rr, rows, self._rows = self._rr, self._rows, {}
        self.waiting = self.bytes_waiting = 0
        for (path, build, timeless, uncounted), added in rows.items():
            stamps = [stamp for stamp, _ in added]
            indexes = [_timestamps(rr, "received", [stamp.received for stamp in stamps])]
            if not timeless:
                indexes.append(_timestamps(rr, "time", [stamp.time for stamp in stamps]))
            if not uncounted:
                indexes.append(rr.TimeColumn("arrival", sequence=[stamp.arrival for stamp in stamps]))
            try:
                self._stream.send_columns(path, indexes, build(rr, [content for _, content in added]), strict=True)
            except Exception:
                self.failed += len(added)
                log.exception("%d rows of %s cannot be written", len(added), path)
            else:
                self.sent += len(added)


def weight(content: Any) -> int:
    """Bytes of a row, about."""
    if isinstance(content, Points):
        return ROW + 2 * content.plane.nbytes + 60 * len(content.labels or ())
    return ROW + 2 * content.plane.nbytes if isinstance(content, Lines) else ROW


def _timestamps(rr: Any, name: str, times: Sequence[int | None]) -> Any:
    return rr.TimeColumn(name, timestamp=np.array(times, dtype=np.int64).astype("datetime64[ns]"))


def raw(rr: Any, rows: Sequence[tuple[str, bytes]]) -> list[Any]:
    """Columns `RawMessage:key` and `RawMessage:msg` of messages as they came; one archetype, so that no tool that
    rearranges the file takes them apart."""
    import pyarrow as pa

    keys, blobs = zip(*rows, strict=True)
    components = {"key": pa.array(keys, pa.string()), "msg": pa.array(blobs, pa.binary())}
    return [*rr.DynamicArchetype.columns(archetype="RawMessage", components=components)]


def scalars(rr: Any, rows: Sequence[float]) -> list[Any]:
    """Points of a time series; NaN breaks the line."""
    return [*rr.Scalars.columns(scalars=np.array(rows, dtype=np.float64))]


def texts(rr: Any, rows: Sequence[tuple[str, str]]) -> list[Any]:
    """Lines of a log: (level, text)."""
    levels, lines = zip(*rows, strict=True)
    return [*rr.TextLog.columns(text=list(lines), level=list(levels))]


def documents(rr: Any, rows: Sequence[str]) -> list[Any]:
    """Documents in Markdown."""
    return [*rr.TextDocument.columns(text=list(rows), media_type=["text/markdown"] * len(rows))]


def _points(rr: Any, rows: Sequence[Points]) -> list[Any]:
    lengths = [len(row.plane) for row in rows]
    plane: dict[str, Any] = {"positions": np.concatenate([row.plane for row in rows])}
    geo: dict[str, Any] = {}
    if rows[0].geo is not None:
        geo["positions"] = np.concatenate([row.geo for row in rows if row.geo is not None])
    if rows[0].labels is not None:
        plane["labels"] = [label for row in rows for label in row.labels or ()]
    if rows[0].classes is not None:
        plane["class_ids"] = geo["class_ids"] = _joined([row.classes for row in rows])
    columns = [*rr.Points2D.columns(**plane)]
    if "positions" in geo:
        columns += rr.GeoPoints.columns(**geo)
    return [column.partition(lengths) for column in columns]


def _lines(rr: Any, rows: Sequence[Lines]) -> list[Any]:
    import pyarrow as pa

    lengths = [len(row.lengths) for row in rows]
    offsets = np.concatenate([[0], *(row.lengths for row in rows)]).cumsum().astype(np.int32)

    def strips(points: Sequence[Floats | None], kind: Any, batch: Any) -> Any:
        flat = pa.array(np.concatenate([part for part in points if part is not None]).ravel(), type=kind)
        pairs = pa.FixedSizeListArray.from_arrays(flat, type=batch([])._ARROW_DATATYPE.value_type)
        return pa.ListArray.from_arrays(pa.array(offsets), pairs, type=batch([])._ARROW_DATATYPE)

    plane = {"strips": strips([row.plane for row in rows], pa.float32(), rr.components.LineStrip2DBatch)}
    geo = {}
    if rows[0].geo is not None:
        geo["line_strings"] = strips([row.geo for row in rows], pa.float64(), rr.components.GeoLineStringBatch)
    if rows[0].classes is not None:
        plane["class_ids"] = _joined([row.classes for row in rows])
    if rows[0].widths is not None:
        plane["radii"] = geo["radii"] = -0.5 * _joined([row.widths for row in rows])  # negative: of the screen
    columns = [*rr.LineStrips2D.columns(**plane)]
    if "line_strings" in geo:
        columns += rr.GeoLineStrings.columns(**geo)
    return [column.partition(lengths) for column in columns]


def _joined(parts: Sequence[NDArray[Any] | None]) -> NDArray[Any]:
    return np.concatenate([part for part in parts if part is not None])
