"""Tracks as GeoJSON and KML, read back; and what all exports say of a track: its name, its id whole, its extent."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pymap3d
import pytest

from fusion_service.errors import ReviewError
from fusion_service.review.export import export
from fusion_service.review.export_maps import _line
from schemas import Local, Message
from schemas.flat import safe_text, space_of, track_columns
from tests.helpers.missions import FRAME, START, picture, tracks, truth
from tests.recording.contents import record

KML, GX = "{http://www.opengis.net/kml/2.2}", "{http://www.google.com/kml/ext/2.2}"
IDS = (2**60 + 1, 2**60 + 2, 2**61 + 2)
"""Beyond 2^53, of two runs of a service: 1, 2 and 2.2."""
EVIL = '=HYPERLINK("http://x")<&>\x07'
SIGMA = 3.0


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three fused tracks that go east, the second without a word of identity, the first with an extent; one local."""
    said: list[Message] = []
    for second in range(4):
        places = [[100.0 * k + second, 50.0 * k] for k in range(3)]
        extent = np.array([[20.0, 5.0, math.radians(60.0)], [math.nan] * 3, [10.0, 10.0, 0.0]])
        said += [
            picture(
                second,
                IDS,
                places,
                sigma=SIGMA,
                status=np.array([1, 1, 2], dtype=np.uint8),
                identity=(EVIL, None, "mmsi:257"),
                callsign=(None, None, "+tern"),
                number=np.array([0, 7, 0], dtype=np.uint32),
                extent=extent,
            ),
            tracks("radar", second, [427], [[0.0, 1.0]]),
            truth(second, [3], [[0.0, 1.0]]),
        ]
    found = tmp_path_factory.mktemp("maps") / "mission.rrd"
    record(found, *said, draw=False)
    return found


def geodetic(x: float, y: float) -> tuple[float, float]:
    """Longitude and latitude on the ellipsoid, by pymap3d; y and x are small beside the Earth."""
    up = (x * x + y * y) / (2 * 6.378e6)
    lat, lon, _ = pymap3d.enu2geodetic(x, y, -up, FRAME.lat, FRAME.lon, FRAME.alt)
    return float(lon), float(lat)


def test_geojson_holds_every_fix_and_every_path(path: Path, tmp_path: Path) -> None:
    done = export(path, tmp_path / "a.geojson")
    found = json.loads((tmp_path / "a.geojson").read_text())
    assert found["type"] == "FeatureCollection"
    fixes = [one for one in found["features"] if one["properties"]["what"] == "fix"]
    paths = [one for one in found["features"] if one["properties"]["what"] == "path"]
    assert (len(fixes), len(paths), done.rows) == (12, 3, 12)
    last = fixes[-1]
    assert last["geometry"]["type"] == "Point"
    assert last["geometry"]["coordinates"][:2] == pytest.approx(geodetic(203.0, 100.0), abs=1e-7)
    said = last["properties"]
    assert said["id"] == str(IDS[2])
    assert (said["label"], said["status"], said["identity"]) == ("track 2.2", "coasting", "mmsi:257")
    assert said["sigma"] == pytest.approx(SIGMA)
    assert said["time_ns"] == str(START + 3 * 10**9)
    assert [one["properties"]["label"] for one in paths] == ["track 1", "track 2", "track 2.2"]
    line = paths[0]["geometry"]
    assert line["type"] == "LineString"
    assert [place[0] for place in line["coordinates"]] == pytest.approx(
        [geodetic(k, 0.0)[0] for k in range(4)], abs=1e-7
    )


def test_a_path_is_cut_at_the_date_line() -> None:
    for sign in (1.0, -1.0):
        line = _line([(sign * 179.0, 10.0, 0.0), (sign * -179.0, 12.0, 4.0), (sign * -178.0, 12.0, 4.0)])
        assert line["type"] == "MultiLineString"
        first, second = line["coordinates"]
        assert first[-1] == (sign * 180.0, 11.0, 2.0)
        assert second[0] == (sign * -180.0, 11.0, 2.0)
        assert len(second) == 3
    assert _line([(180.0, 1.0, 0.0), (-180.0, 2.0, 0.0)])["coordinates"][0][-1] == (180.0, 1.0, 0.0)


def test_kml_is_a_track_with_times_for_each_track(path: Path, tmp_path: Path) -> None:
    export(path, tmp_path / "a.kml")
    document = ElementTree.parse(tmp_path / "a.kml").getroot()
    assert document.tag == f"{KML}kml"
    marks = document.findall(f".//{KML}Placemark")
    assert [mark.findtext(f"{KML}name") for mark in marks] == [
        'track 1 =HYPERLINK("http://x")<&>\ufffd',
        "track 2",
        "track 2.2 +tern mmsi:257",
    ]
    for row, mark in enumerate(marks):
        (track,) = mark.findall(f"{GX}Track")
        times = [one.text or "" for one in track.findall(f"{KML}when")]
        seconds = [datetime.fromisoformat(time).timestamp() for time in times]
        assert seconds == [START / 1e9 + k for k in range(4)]
        places = [[float(part) for part in (one.text or "").split()] for one in track.findall(f"{GX}coord")]
        for k, place in enumerate(places):
            assert place[:2] == pytest.approx(geodetic(100.0 * row + k, 50.0 * row), abs=1e-7)
        arrays = {
            one.get("name"): [value.text for value in one.findall(f"{GX}value")]
            for one in track.findall(f".//{GX}SimpleArrayData")
        }
        assert arrays["status"] == ["coasting" if row == 2 else "confirmed"] * 4
        assert arrays["sigma"] == [f"{SIGMA:g}"] * 4
        data = {one.get("name"): one.findtext(f"{KML}value") for one in mark.findall(f"{KML}ExtendedData/{KML}Data")}
        assert data["id"] == str(IDS[row])
        assert data.get("number") == ("7" if row == 1 else None)
        order = [child.tag.rpartition("}")[2] for child in mark]
        assert order == ["name", "styleUrl", "ExtendedData", "Track"]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_tables_name_a_track_keep_its_id_and_say_its_extent(path: Path, tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"a{suffix}"
    export(path, out)
    rows: list[dict[str, Any]]
    if suffix == ".csv":
        with out.open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert rows[0]["identity"] == f"'{EVIL}"
        assert rows[2]["callsign"] == "'+tern"
    else:
        from pyarrow import parquet

        rows = parquet.read_table(out).to_pylist()
        assert rows[0]["identity"] == EVIL
    assert [int(row["track_hex"], 16) for row in rows[:3]] == list(IDS)
    assert [int(row["track_id"]) for row in rows[:3]] == list(IDS)
    assert [row["label"] for row in rows[:3]] == ["track 1", "track 2", "track 2.2"]
    assert [row["number"] or None for row in rows[:3]] in ([None, "7", None], [None, 7, None])
    assert float(rows[0]["sigma"]) == pytest.approx(SIGMA)
    size = [float(rows[0][f"extent_{name}"]) for name in ("length", "width", "heading")]
    assert size == pytest.approx([20.0, 5.0, 30.0])  # 60 degrees from east to north are 30 from north to east
    assert rows[1]["extent_length"] in ("", None)
    export(path, tmp_path / f"radar{suffix}", "radar")
    export(path, tmp_path / f"truth{suffix}", "truth")


def test_what_a_spreadsheet_takes_for_a_formula_is_no_formula() -> None:
    for text in ("=1", "+1", "-1", "@a", "\t=1", "\r=1", "\n=1"):
        assert safe_text(text) == f"'{text}"
    assert safe_text("mmsi:257") == "mmsi:257"


def test_an_older_table_without_the_later_columns_is_read() -> None:
    space = ("x", "vx", "y", "vy")
    older = tuple(
        name for name in track_columns(space) if not name.startswith(("label", "track_hex", "sigma", "extent"))
    )
    assert space_of(older) == space


def test_tracks_that_are_nowhere_on_earth_are_no_map(tmp_path: Path) -> None:
    record(tmp_path / "a.rrd", replace(picture(0, [1], [[0.0, 0.0]]), frame=Local("dock")), draw=False)
    for suffix in (".kml", ".geojson"):
        with pytest.raises(ReviewError, match=r"needs places on Earth, .*'local dock': take \.csv"):
            export(tmp_path / "a.rrd", tmp_path / f"a{suffix}")
        assert not (tmp_path / f"a{suffix}").exists()
