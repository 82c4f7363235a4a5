"""Rows of tracks as a map in a file: GeoJSON (RFC 7946) or KML 2.2 with Google's gx:Track.

GeoJSON: a Point for each row, with `what` = "fix" and its time, and after them a LineString for each track, `what` =
"path", in parts where it crosses the date line. KML: a folder for each source, in it a gx:Track for each track with a
time, status, existence and sigma for each place. Ids are texts. What no row says is left out. Both need tracks with a
place on Earth.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, TextIO
from xml.sax.saxutils import escape, quoteattr

from fusion_service.errors import ReviewError
from fusion_service.review.export_rows import TableRow
from fusion_service.review.export_tables import Write

__all__ = ["geojson_map", "kml_map"]

PROPERTIES = (
    "time",
    "time_ns",
    "source",
    "kind",
    "label",
    "status",
    "existence",
    "number",
    "callsign",
    "identity",
    "class",
    "sigma",
    "extent_length",
    "extent_width",
    "extent_heading",
    "sources",
)
"""Of a fix, beside `id`; of a path those that do not change."""
LASTING = ("source", "kind", "label", "number", "callsign", "identity", "class")
MOST_IN_PATHS = 2_000_000
"""Fixes that are held for the lines of a GeoJSON, and for a KML."""
DIGITS = 8
"""Of degrees: a millimetre."""


@dataclass(slots=True)
class _Path:
    """One track: what was said last, and its places over time."""

    said: TableRow
    times: list[str] = field(default_factory=list)
    places: list[tuple[float, float, float]] = field(default_factory=list)
    status: list[str] = field(default_factory=list)
    existence: list[float | None] = field(default_factory=list)
    sigma: list[float | None] = field(default_factory=list)


class _Paths:
    """The tracks of a map, in the order in which they came; full: more fixes than are held."""

    def __init__(self) -> None:
        self.known: dict[tuple[str, int, int], _Path] = {}
        self.fixes = 0

    @property
    def full(self) -> bool:
        return self.fixes > MOST_IN_PATHS

    def add(self, row: TableRow, place: tuple[float, float, float]) -> None:
        self.fixes += 1
        if self.full:
            return
        run = 0 if row["kind"] == "global" else row["epoch"]
        path = self.known.setdefault((row["source"], run, row["track_id"]), _Path(row))
        path.said = path.said | {name: row[name] for name in LASTING if row[name] is not None}
        path.times.append(row["time"])
        path.places.append(place)
        path.status.append(row["status"] or "")
        path.existence.append(row["existence"])
        path.sigma.append(row["sigma"])


def _place(path: Path, row: TableRow) -> tuple[float, float, float] | None:
    """Longitude, latitude, altitude; None for what is no place. `ReviewError` in a frame that is nowhere."""
    if row["latitude"] is None:
        raise ReviewError(
            f"{path.suffix} needs places on Earth, and these tracks are in the frame {row['frame']!r}: take .csv"
        )
    place = (row["longitude"], row["latitude"], row["altitude"])
    if not all(map(math.isfinite, place)):
        return None
    lon, lat, alt = place
    return round(lon, DIGITS), round(lat, DIGITS), round(alt, 3)


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextmanager
def geojson_map(path: Path, names: tuple[str, ...]) -> Iterator[Write]:
    """Takes rows, and writes them to a new file as features."""
    paths = _Paths()
    with path.open("w", encoding="utf-8") as file:
        file.write('{"type":"FeatureCollection","features":[')
        first = True

        def put(geometry: dict[str, Any], properties: dict[str, Any]) -> None:
            nonlocal first
            said = {name: value for name, value in properties.items() if value not in (None, "")}
            feature = {"type": "Feature", "geometry": geometry, "properties": said}
            file.write(("\n" if first else ",\n") + json.dumps(feature, ensure_ascii=False, allow_nan=False))
            first = False

        def write(rows: list[TableRow]) -> None:
            for row in rows:
                place = _place(path, row)
                if place is None:
                    continue
                paths.add(row, place)
                said = {name: _plain(row[name]) for name in PROPERTIES} | {"time_ns": str(row["time_ns"])}
                put({"type": "Point", "coordinates": place}, {"what": "fix", "id": str(row["track_id"])} | said)

        yield write
        for one in paths.known.values() if not paths.full else ():
            if len(one.places) > 1:
                known = {"what": "path", "id": str(one.said["track_id"])} | {name: one.said[name] for name in LASTING}
                put(_line(one.places), known | {"begin": one.times[0], "end": one.times[-1], "fixes": len(one.places)})
        file.write("\n]}\n")


def _line(places: list[tuple[float, float, float]]) -> dict[str, Any]:
    """A line, cut where it crosses the date line."""
    parts: list[list[tuple[float, float, float]]] = [[places[0]]]
    for before, here in pairwise(places):
        if abs(here[0] - before[0]) <= 180:
            parts[-1].append(here)
            continue
        edge = math.copysign(180.0, before[0])
        width = here[0] + 2 * edge - before[0]
        share = (edge - before[0]) / width if width else 0.0
        lat, alt = (before[k] + share * (here[k] - before[k]) for k in (1, 2))
        parts[-1].append((edge, round(lat, DIGITS), round(alt, 3)))
        parts.append([(-edge, round(lat, DIGITS), round(alt, 3)), here])
    if len(parts) == 1:
        return {"type": "LineString", "coordinates": parts[0]}
    return {"type": "MultiLineString", "coordinates": parts}


HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">
<Document>
<name>{name}</name>
<Style id="track"><IconStyle><scale>0.6</scale></IconStyle>
<LineStyle><color>ff3e3eff</color><width>2</width></LineStyle></Style>
<Schema id="fixes">
<gx:SimpleArrayField name="status" type="string"><displayName>status</displayName></gx:SimpleArrayField>
<gx:SimpleArrayField name="existence" type="float"><displayName>existence</displayName></gx:SimpleArrayField>
<gx:SimpleArrayField name="sigma" type="float"><displayName>sigma, m</displayName></gx:SimpleArrayField>
</Schema>
"""


@contextmanager
def kml_map(path: Path, names: tuple[str, ...]) -> Iterator[Write]:
    """Takes rows, and writes them to a new file when all are there. `ReviewError` where there are too many."""
    paths = _Paths()

    def write(rows: list[TableRow]) -> None:
        for row in rows:
            if (place := _place(path, row)) is not None:
                paths.add(row, place)
        if paths.full:
            raise ReviewError(
                f"more than {MOST_IN_PATHS:,} fixes, which a KML does not hold: take .geojson or .parquet"
            )

    yield write
    with path.open("w", encoding="utf-8") as file:
        file.write(HEAD.format(name=escape(path.stem.removeprefix("."))))
        for source in dict.fromkeys(key[0] for key in paths.known):
            file.write(f"<Folder>\n<name>{_text(source)}</name>\n")
            for (name, _, _), one in paths.known.items():
                if name == source:
                    _placemark(file, one)
            file.write("</Folder>\n")
        file.write("</Document>\n</kml>\n")


def _placemark(file: TextIO, one: _Path) -> None:
    said = one.said
    called = " ".join(filter(None, (said["label"], said["callsign"], said["identity"])))
    file.write(f"<Placemark>\n<name>{_text(called)}</name>\n<styleUrl>#track</styleUrl>\n<ExtendedData>\n")
    data = {"id": str(said["track_id"]), **{name: said[name] for name in LASTING}, "status": one.status[-1]}
    data["sigma"] = one.sigma[-1]
    for name, value in data.items():
        if _plain(value) not in (None, ""):
            file.write(f"<Data name={quoteattr(name)}><value>{_text(str(value))}</value></Data>\n")
    file.write("</ExtendedData>\n<gx:Track>\n")
    file.writelines(f"<when>{time}</when>\n" for time in one.times)
    file.writelines(f"<gx:coord>{lon!r} {lat!r} {alt!r}</gx:coord>\n" for lon, lat, alt in one.places)
    file.write('<ExtendedData>\n<SchemaData schemaUrl="#fixes">\n')
    for name, values in (("status", one.status), ("existence", one.existence), ("sigma", one.sigma)):
        file.write(f'<gx:SimpleArrayData name="{name}">\n')
        for value in values:
            shown = "" if _plain(value) is None else f"{value:.6g}" if isinstance(value, float) else str(value)
            file.write(f"<gx:value>{_text(shown)}</gx:value>\n")
        file.write("</gx:SimpleArrayData>\n")
    file.write("</SchemaData>\n</ExtendedData>\n</gx:Track>\n</Placemark>\n")


def _text(text: str) -> str:
    """As XML 1.0 holds it: without the control characters that it does not."""
    kept = "".join(one if one in "\t\n\r" or (one >= " " and one not in "\ufffe\uffff") else "\ufffd" for one in text)
    return escape(kept.encode("utf-8", "replace").decode())
