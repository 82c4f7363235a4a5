"""A recording's tracks as one flat table, CSV or Parquet; `schemas.flat` says what its columns are.

A mixture is exported by its moments. The table is written as the recording is read, so its size does not matter.
"""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.densities import moments
from fusion_service.errors import ReviewError
from fusion_service.extras import install_hint
from fusion_service.geodesy import ecef_to_geodetic, enu_to_geodetic
from fusion_service.recording import read
from schemas import (
    COMPONENTS,
    STATUSES,
    Ecef,
    Enu,
    GlobalTracks,
    Height,
    LocalTracks,
    MessageError,
    Truth,
    decode,
    pack_lower,
)
from schemas.flat import frame_text, lower, track_columns

__all__ = ["Exported", "export"]

Exportable = GlobalTracks | LocalTracks | Truth
TableRow = dict[str, Any]
Write = Callable[[list[TableRow]], None]
AS = {GlobalTracks: "global", LocalTracks: "local", Truth: "truth"}
ROWS = 20_000
SETTLED = 8
"""Steps after which a place at a given altitude, up to 1,000 km from the origin, is known to a millimetre."""
"""Rows of a row group of a Parquet file."""
INTEGERS, SIGNED = ("track_id", "epoch"), ("time_ns", "updated_ns")
TEXTS = ("time", "source", "kind", "status", "sources", "lineage", "frame")


class Exported(NamedTuple):
    """rows and times written; left_out: messages that were not, by reason."""

    rows: int
    times: int
    left_out: Counter[str]


def export(
    path: Path, out: Path, what: str = "global", centre: str | None = None, stop: Callable[[], bool] = lambda: False
) -> Exported:
    """Write the tracks of recording `path` to `out`, a new .csv or .parquet file.

    what: "global" (of `centre`, which must be named where there are several), "truth", or the name of a source.
    Raises `ReviewError` for a recording that has none of these, and what `read` raises; FileExistsError for `out`.
    """
    if out.suffix not in (".csv", ".parquet"):
        raise ReviewError(f"{out}: tracks are exported to a .csv or a .parquet file")
    left_out: Counter[str] = Counter()
    found = _chosen(path, what, centre, left_out)
    first = next(found, None)
    if first is None:
        there = ", ".join(sorted(left_out)) or "none at all"
        raise ReviewError(f"{path} has no tracks of {centre or what!r}; there are: {there}")
    if out.exists():
        raise FileExistsError(f"{out} exists already: name another file, or move it away")
    rows = times = 0
    part = out.with_name(f".{out.name}")
    try:
        with (_parquet if out.suffix == ".parquet" else _csv)(part, track_columns(first.space)) as write:
            for message in _with(first, found):
                if stop():
                    break
                if message.space != first.space:
                    left_out["another state space"] += 1
                    continue
                table = list(_rows(message))
                write(table)
                rows, times = rows + len(table), times + 1
        part.replace(out)
    finally:
        part.unlink(missing_ok=True)
    return Exported(rows, times, left_out)


def _with(first: Exportable, rest: Iterator[Exportable]) -> Iterator[Exportable]:
    yield first
    yield from rest


def _chosen(path: Path, what: str, centre: str | None, left_out: Counter[str]) -> Iterator[Exportable]:
    """The messages asked for; tracks of others are counted by whose they are."""
    kind: type[Exportable] = {"global": GlobalTracks, "truth": Truth}.get(what, LocalTracks)
    name = centre if what == "global" else None if what == "truth" else what
    for raw in read(path):
        try:
            message = decode(raw.data)
        except MessageError as error:
            left_out[f"that do not decode ({error.reason})"] += 1
            continue
        if not isinstance(message, GlobalTracks | LocalTracks | Truth):
            continue
        if isinstance(message, kind) and name in (None, message.source):
            if what == "global":
                name = message.source
            yield message
        else:
            left_out[f"{AS[type(message)]} tracks of {message.source}"] += 1


def _rows(message: Exportable) -> Iterator[TableRow]:
    n = len(message.space)
    if isinstance(message, Truth):
        means, covariances = message.means, np.full((len(message.means), n, n), np.nan)
    else:
        means, covariances = moments(message.means, message.covariances, message.weights, message.counts)
    packed, places = pack_lower(covariances), _places(message, means)
    names = track_columns(message.space)
    common = {
        "time": datetime.fromtimestamp(message.time // 10**9, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        + f".{message.time % 10**9 // 1000:06d}Z",
        "time_ns": message.time,
        "source": message.source,
        "kind": AS[type(message)],
        "epoch": message.epoch,
        "lineage": " ".join(message.lineage or ()),
        "frame": frame_text(message.frame),
    }
    existence = getattr(message, "existence", None)
    updated = getattr(message, "updated", None)
    behind = _contributors(message)
    covariance_names = [f"cov_{message.space[i]}_{message.space[j]}" for i, j in lower(message.space)]
    for k, track in enumerate(message.ids.tolist()):
        row = dict.fromkeys(names) | common | {"track_id": track, "sources": behind[k] if behind else ""}
        row |= dict(zip(message.space, means[k].tolist(), strict=True))
        if not isinstance(message, Truth):
            row |= dict(zip(covariance_names, packed[k].tolist(), strict=True))
        if isinstance(message, GlobalTracks):
            row["status"] = STATUSES[message.status[k]]
        if existence is not None:
            row["existence"] = float(existence[k])
        if updated is not None:
            row["updated_ns"] = int(updated[k])
        if places is not None:
            row |= dict(zip(("latitude", "longitude", "altitude"), places[:, k].tolist(), strict=True))
        yield row


def _contributors(message: Exportable) -> list[str]:
    if not isinstance(message, GlobalTracks):
        return []
    ends = np.cumsum(message.contributor_counts.astype(int)).tolist()
    names = [message.sources[index] for index in message.contributor_source.tolist()]
    return [" ".join(sorted(set(names[begin:end]))) for begin, end in pairwise([0, *ends])]


def _places(message: Exportable, means: Floats) -> Floats | None:
    """Latitude, longitude (degrees) and altitude (m), (3, T); None in a frame without a place on Earth. A state without
    z lies `height` (0 unless the source says one) above the ellipsoid."""
    xyz = [means[:, message.space.index(name)] if name in message.space else None for name in "xyz"]
    x, y, z = xyz
    assert x is not None
    assert y is not None
    if isinstance(message.frame, Ecef) and z is not None:
        return np.stack(ecef_to_geodetic(x, y, z))
    if not isinstance(message.frame, Enu):
        return None
    if z is not None:
        return np.stack(enu_to_geodetic(x, y, z, message.frame))
    height = getattr(message, "height", None) or Height()
    z = np.zeros_like(x)
    for _ in range(SETTLED):
        z = z - (enu_to_geodetic(x, y, z, message.frame)[2] - height.value)
    return np.stack(enu_to_geodetic(x, y, z, message.frame))


@contextmanager
def _csv(path: Path, names: tuple[str, ...]) -> Iterator[Write]:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, names, lineterminator="\n")
        writer.writeheader()
        yield writer.writerows


@contextmanager
def _parquet(path: Path, names: tuple[str, ...]) -> Iterator[Write]:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise ReviewError(f"Parquet needs pyarrow ({error}): {install_hint('record')}") from None

    def kind(name: str) -> Any:
        if name in INTEGERS:
            return pa.uint64()
        return pa.int64() if name in SIGNED else pa.string() if name in TEXTS else pa.float64()

    units = {b"units": b"SI, radians; latitude and longitude in degrees"}
    schema = pa.schema(
        [pa.field(n, kind(n), metadata={b"unit": COMPONENTS[n].encode()} if n in COMPONENTS else None) for n in names],
        metadata=units,
    )
    waiting: list[TableRow] = []
    with parquet.ParquetWriter(path, schema) as writer:

        def flush() -> None:
            if waiting:
                columns = {name: [row[name] for row in waiting] for name in names}
                writer.write_table(pa.table(columns, schema=schema))
                waiting.clear()

        def write(rows: list[TableRow]) -> None:
            waiting.extend(rows)
            if len(waiting) >= ROWS:
                flush()

        yield write
        flush()
