"""A recording's tracks as one flat table, CSV or Parquet, whose columns `schemas.flat` describes; or as a map, GeoJSON
or KML (`export_maps`).

A mixture is exported by its moments. A table is written as the recording is read, so its size does not matter.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from fusion_service.errors import ReviewError
from fusion_service.labels import Labels
from fusion_service.recording import read
from fusion_service.review.export_maps import geojson_map, kml_map
from fusion_service.review.export_rows import AS, Exportable, rows_of
from fusion_service.review.export_tables import csv_table, parquet_table
from fusion_service.review.outputs import check_page
from schemas import GlobalTracks, LocalTracks, MessageError, Truth, Wholes, decode
from schemas.flat import track_columns

__all__ = ["Exported", "export"]

FORMATS = {".csv": csv_table, ".parquet": parquet_table, ".geojson": geojson_map, ".kml": kml_map}
"""Each a context that takes rows, by the end of the file's name."""


class Exported(NamedTuple):
    """rows and times written; left_out: messages that were not, by reason."""

    rows: int
    times: int
    left_out: Counter[str]


def export(
    path: Path, out: Path, what: str = "global", centre: str | None = None, stop: Callable[[], bool] = lambda: False
) -> Exported:
    """Write the tracks of recording `path` to `out`, a new .csv, .parquet, .geojson or .kml file.

    what: "global" (of `centre`, which must be named where there are several), "truth", or the name of a source.
    Raises `ReviewError` for a recording that has none of these and for `out` in no folder, and what `read` raises;
    FileExistsError for `out`.
    """
    if out.suffix not in FORMATS:
        raise ReviewError(f"{out}: tracks are exported to a .csv, .parquet, .geojson or .kml file")
    if out.exists():
        raise FileExistsError(f"{out} exists already: name another file, or move it away")
    check_page(out)
    labels = Labels()
    left_out: Counter[str] = Counter()
    found = _chosen(path, what, centre, left_out)
    first = next(found, None)
    if first is None:
        there = ", ".join(sorted(left_out)) or "none at all"
        raise ReviewError(f"{path} has no tracks of {centre or what!r}; there are: {there}")
    rows = times = 0
    part = out.with_name(f".{out.name}")
    try:
        with FORMATS[out.suffix](part, track_columns(first.space)) as write:
            for message in _with(first, found):
                if stop():
                    break
                if message.space != first.space:
                    left_out["another state space"] += 1
                    continue
                if isinstance(message, GlobalTracks):
                    labels.see(message)
                table = list(rows_of(message, labels))
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
    wholes = Wholes()
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
            whole = wholes.of(message) if isinstance(message, GlobalTracks) else message
            if whole is None:
                left_out["changes to a picture that is not there"] += 1
            else:
                yield whole
        else:
            left_out[f"{AS[type(message)]} tracks of {message.source}"] += 1
