"""The hulls that are drawn, read back from a recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion_service.geodesy import axis_turn
from schemas import Enu, Message, Truth
from tests.helpers import missions
from tests.recording.contents import entities, record, rows, static

NAN = np.nan
SHIP = (36.0, 10.0, 0.5)


def corners(strip: Any) -> np.ndarray[Any, Any]:
    """East and north of a strip's points."""
    return np.array(strip)[:, :2] * (1.0, -1.0)


def told(second: float, ids: list[int], places: list[tuple[float, float]], extent: Any, **more: Any) -> Any:
    said = missions.tracks("radar", second, ids, places, **more)
    return replace(said, extent=np.array(extent), shape="box")


def test_a_box_is_drawn_about_its_track_and_nothing_about_one_of_unknown_size(tmp_path: Path) -> None:
    said: list[Message] = [missions.info("radar", period=1.0)]
    said += [told(0, [1, 2], [(100, 50), (900, 50)], [SHIP, (NAN, NAN, NAN)])]
    said += [told(1, [2], [(901, 50)], [(7.0, 2.5, 0.0)], complete=False)]
    said += [missions.tracks("radar", 2, [1, 2], [(102, 50), (902, 50)])]
    record(tmp_path / "a.rrd", *said)
    drawn = rows(tmp_path / "a.rrd", "/picture/local/radar/hull")
    assert [len(row["LineStrips2D:strips"]) for row in drawn] == [1, 2, 0]
    (strip,) = drawn[0]["LineStrips2D:strips"]
    points = corners(strip)
    assert len(points) == 5
    np.testing.assert_allclose(points[0], points[-1])
    np.testing.assert_allclose(points[:4].mean(axis=0), [100, 50], atol=1e-3)
    edges = np.diff(points, axis=0)
    np.testing.assert_allclose(sorted(np.hypot(*edges.T)), [10, 10, 36, 36], atol=1e-3)
    longest = edges[np.hypot(*edges.T).argmax()]
    assert np.mod(np.arctan2(longest[1], longest[0]), np.pi) == pytest.approx(0.5, abs=1e-3)
    assert len(drawn[0]["GeoLineStrings:line_strings"][0]) == 5
    assert static(tmp_path / "a.rrd", "/picture/local/radar/hull")["LineStrips2D:radii"]


def test_what_tells_no_extent_has_no_entity(tmp_path: Path) -> None:
    record(tmp_path / "a.rrd", missions.info("radar", period=1.0), missions.tracks("radar", 0, [1], [(0, 0)]))
    assert not [path for path in entities(tmp_path / "a.rrd") if "hull" in path]


def test_truth_is_drawn_about_the_centre_of_its_hull_in_the_frame_of_the_chart(tmp_path: Path) -> None:
    first = missions.tracks("radar", 0, [1], [(0, 0)])
    assert isinstance(first.frame, Enu)
    frame = Enu(first.frame.lat, first.frame.lon + 0.5, first.frame.alt)
    truth = Truth(
        source="sea", epoch=1, seq=0, sent=first.time, time=first.time, space=("x", "y"), frame=frame,
        ids=np.array([5, 3], dtype=np.uint64), means=np.array([[0.0, 0.0], [500.0, 0.0]]),
        extent=np.array([[30.0, 8.0, 0.0], [12.0, 4.0, 1.0]]), extent_offset=np.array([[10.0, 1.0], [NAN, NAN]]),
    )  # fmt: skip
    record(tmp_path / "a.rrd", missions.info("radar", period=1.0), first, truth)
    (drawn,) = rows(tmp_path / "a.rrd", "/picture/truth/sea/hull")
    (points,) = rows(tmp_path / "a.rrd", "/picture/truth/sea")
    places = np.array(points["Points2D:positions"]) * (1.0, -1.0)
    rings = [corners(strip) for strip in drawn["LineStrips2D:strips"]]
    order = [points["Points2D:labels"].index(name) for name in ("target 5", "target 3")]
    turn = float(axis_turn(places.T, ("x", "y"), frame, first.frame)[0])
    offset = np.array([np.cos(turn) * 10 - np.sin(turn), np.sin(turn) * 10 + np.cos(turn)])
    np.testing.assert_allclose(rings[order[0]][:-1].mean(axis=0), places[order[0]] - offset, atol=0.1)
    np.testing.assert_allclose(rings[order[1]][:-1].mean(axis=0), places[order[1]], atol=0.1)
