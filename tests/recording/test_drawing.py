"""What is drawn is right, and what cannot be drawn harms nothing."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pymap3d
import pytest
from rerun.chunk import RrdReader
from scipy.stats import chi2

from fusion_service.recording import read
from fusion_service.recording.drawing.geometry import track_moments
from schemas import Ecef, Enu, Local, Message, Polygon, encode, global_key, local_key
from tests.helpers import missions
from tests.recording.contents import opacities, record, row, rows, texts
from tests.recording.mission import LOST, RADARS, START, TARGETS, Sent

SECOND = 10**9


def test_a_recording_brings_its_own_layout(flown: tuple[Path, list[Sent]]) -> None:
    reader = RrdReader(flown[0])
    assert len(reader.recordings()) == 1
    names = ("Map", "Local picture", "Existence", "Status log", "Error per target", "NEES per target")
    told = []
    for layout in reader.blueprints():  # in no order: one from before the truth was heard, and one since
        text = "".join(str(chunk.to_record_batch()) for chunk in reader.stream(store=layout))
        told.append([name for name in names if name in text])
    assert sorted(told, key=len) == [list(names[:4]), list(names)]


def test_places_are_those_of_another_geodesy(flown: tuple[Path, list[Sent]]) -> None:
    path, said = flown
    centre: Any = next(sent.message.frame for sent in said if sent.key == global_key("main", "tracks"))  # type: ignore[union-attr]
    for name, frame in RADARS.items():
        message: Any = next(sent.message for sent in said if sent.key == local_key(name, "tracks"))
        drawn = row(path, f"/picture/local/{name}", message.time)
        x, y = message.means[:, 0], message.means[:, 2]
        up = -(x * x + y * y) / (2 * 6378137.0)  # onto the ellipsoid; within 0.1 m, 15 km away
        lat, lon, _ = pymap3d.enu2geodetic(x, y, up, frame.lat, frame.lon, frame.alt)
        np.testing.assert_allclose(drawn["GeoPoints:positions"], np.stack([lat, lon], axis=1), atol=1e-7)
        east, north, _ = pymap3d.geodetic2enu(lat, lon, 0.0, centre.lat, centre.lon, centre.alt)
        np.testing.assert_allclose(drawn["Points2D:positions"], np.stack([east, -north], axis=1), atol=0.1)


def test_ellipses_hold_95_percent_and_are_dashed_while_a_track_coasts(flown: tuple[Path, list[Sent]]) -> None:
    path, said = flown
    for step in (10, 50):
        message: Any = [sent.message for sent in said if sent.key == global_key("main", "tracks")][step]
        strips = row(path, "/picture/global/main/ellipses", message.time)["LineStrips2D:strips"]
        coasting = message.status == 2
        assert len(strips) == (~coasting).sum() + 8 * coasting.sum()
        order = [*np.flatnonzero(~coasting), *np.repeat(np.flatnonzero(coasting), 8)]
        for strip, track in zip(strips, order, strict=True):
            mean, covariance = message.means[track, ::2], message.covariances[track, ::2, ::2]
            apart = np.array(strip) * (1, -1) - mean
            distance = np.einsum("ki,ij,kj->k", apart, np.linalg.inv(covariance), apart)
            np.testing.assert_allclose(distance, chi2.ppf(0.95, 2), rtol=1e-3)
    assert coasting.any()


def test_labels_trails_and_opacity_of_global_tracks(flown: tuple[Path, list[Sent]]) -> None:
    path, _ = flown
    first, second, third = (START + step * SECOND for step in (2, 3, 4))
    before, now = (row(path, "/picture/global/main", at) for at in (first, second))
    assert now["Points2D:labels"] == [str(n) for n in range(1, TARGETS + 1)]
    shades = opacities(path, "/picture/global/main")
    alphas = [[shades[level] for level in drawn["Points2D:class_ids"]] for drawn in (before, now)]
    assert [len(set(values)) for values in alphas] == [1, 1]
    assert 40 < alphas[0][0] < 150 < 240 < alphas[1][0] <= 255  # tentative ones are faint
    trail = row(path, "/picture/global/main/trail", second)["LineStrips2D:strips"]
    ends = [before["Points2D:positions"], now["Points2D:positions"]]
    np.testing.assert_array_equal(np.array(trail), np.swapaxes(np.array(ends), 0, 1))
    assert row(path, "/picture/global/main/trail", third)["GeoLineStrings:line_strings"]


def test_sensors_and_what_they_see(flown: tuple[Path, list[Sent]]) -> None:
    path, _ = flown
    sensor = rows(path, "/picture/sensors/radar3")[0]
    assert sensor["Points2D:labels"] == ["radar3"]
    np.testing.assert_allclose(
        sensor["GeoPoints:positions"][0], [RADARS["radar3"].lat, RADARS["radar3"].lon], atol=1e-9
    )
    disk = rows(path, "/picture/sensors/radar3/coverage")[0]["LineStrips2D:strips"]
    centre = np.array(sensor["Points2D:positions"][0])
    reach = [np.hypot(*(np.array(strip) - centre).T) for strip in disk]
    np.testing.assert_allclose(reach[0], 9000.0, rtol=1e-3)
    np.testing.assert_allclose(reach[1], 300.0, rtol=1e-2)
    (sector,) = rows(path, "/picture/sensors/radar1/coverage")[0]["LineStrips2D:strips"]
    own = (np.array(sector) - np.array(rows(path, "/picture/sensors/radar1")[0]["Points2D:positions"][0])) * (1, -1)
    azimuth = np.arctan2(own[:, 0], own[:, 1])
    assert 0.2 - 0.01 < azimuth.min() < 0.21 < 2.19 < azimuth.max() < 2.2 + 0.01  # azimuth 1.2, width 2


def test_a_sensor_is_drawn_from_its_arrival_on(tmp_path: Path) -> None:
    """And one that was there before the first track from then on."""
    said: list[Message] = [
        missions.info("a"),
        missions.tracks("a", 0, [1], [(0, 0)]),
        missions.info("b"),
        missions.info("a", period=2.0),
    ]
    moved = missions.info("b", position=(7.0, 0.0, 0.0))
    record(tmp_path / "a.rrd", *said, missions.tracks("a", 5, [1], [(0, 0)]), moved, missions.tracks("a", 9, [], []))
    times = [[item["time"] for item in rows(tmp_path / "a.rrd", f"/picture/sensors/{name}")] for name in "ab"]
    assert times == [[missions.at(0)], [missions.at(0), missions.at(5)]]


def test_a_polygon_is_drawn_where_it_is(tmp_path: Path) -> None:
    corners = ((0.0, 0.0), (100.0, 0.0), (100.0, 50.0))
    info = missions.info("radar", position=(10.0, 20.0, 0.0), coverage=Polygon(corners))
    record(tmp_path / "a.rrd", info, missions.tracks("radar", 0, [1], [(1, 2)]))
    (strip,) = rows(tmp_path / "a.rrd", "/picture/sensors/radar/coverage")[0]["LineStrips2D:strips"]
    assert strip == [[0, 0], [100, 0], [100, -50], [0, 0]]


def test_a_lost_source_is_wiped_from_the_picture_until_it_returns(flown: tuple[Path, list[Sent]]) -> None:
    path, _ = flown
    name, gone, back = LOST
    counts = {
        (drawn["time"] - START) // SECOND: len(drawn["Points2D:positions"])
        for drawn in rows(path, f"/picture/local/{name}")
    }
    empty = [step for step in counts if gone <= step < back]
    assert [counts[step] for step in empty] == [0]
    assert counts[gone - 1] > 0
    assert counts[back] > 0


def test_an_incomplete_message_leaves_the_other_tracks_for_three_periods(tmp_path: Path) -> None:
    said: list[Message] = [missions.info("radar", period=1.0), missions.tracks("radar", 0, [1, 2], [(0, 0), (9, 9)])]
    said += [missions.tracks("radar", s, [1], [(s, 0)], complete=False) for s in (1, 2, 3, 4)]
    said += [missions.tracks("radar", 5, [], [])]
    record(tmp_path / "a.rrd", *said)
    labels = [sorted(drawn["Points2D:labels"]) for drawn in rows(tmp_path / "a.rrd", "/picture/local/radar")]
    assert labels == [["1", "2"]] * 4 + [["1"], []]


def test_a_mixture_is_drawn_by_its_moments() -> None:
    rng = np.random.default_rng(3)
    weights = np.array([0.2, 0.8, 0.5, 0.25, 0.25, 1.0])
    counts = np.array([2, 3, 1], dtype=np.uint16)
    means, roots = rng.normal(0, 10, (6, 4)), rng.normal(0, 1, (6, 4, 4))
    covariances = roots @ roots.transpose(0, 2, 1) + np.eye(4)
    mixed = missions.tracks("a", 0, [1, 2, 3], [], means=means, covariances=covariances, counts=counts, weights=weights)
    mean, covariance = track_moments(mixed)
    for track, part in enumerate((slice(0, 2), slice(2, 5), slice(5, 6))):
        w = weights[part]
        second = np.einsum("c,cij->ij", w, covariances[part] + np.einsum("ci,cj->cij", means[part], means[part]))
        first = w @ means[part]
        np.testing.assert_allclose(mean[track], first)
        np.testing.assert_allclose(covariance[track], second - np.outer(first, first), rtol=1e-9, atol=1e-9)


def test_the_frame_is_that_of_the_first_global_tracks(tmp_path: Path) -> None:
    there = Enu(60.1, 10.0)
    local = missions.tracks("radar", 0, [1], [(0, 0)], frame=there)
    record(tmp_path / "a.rrd", local, missions.picture(0, [1], [(0, 0)]))
    _, y = rows(tmp_path / "a.rrd", "/picture/local/radar")[0]["Points2D:positions"][0]
    assert y == pytest.approx(-pymap3d.geodetic2enu(60.1, 10, 0, 60, 10, 0)[1], abs=0.01)
    record(tmp_path / "b.rrd", local)  # none come: that of the first message
    assert rows(tmp_path / "b.rrd", "/picture/local/radar")[0]["Points2D:positions"] == [[0, 0]]
    record(tmp_path / "c.rrd", local, frame=missions.FRAME)
    drawn = rows(tmp_path / "c.rrd", "/picture/local/radar")[0]["Points2D:positions"]
    assert drawn == [pytest.approx([0.0, y], abs=1e-6)]


def test_ecef_and_local_frames_are_drawn_too(tmp_path: Path) -> None:
    place = np.array([pymap3d.geodetic2ecef(60.0, 10.0, 100.0)])
    ecef = missions.tracks("a", 0, [1], [], means=place, space=("x", "y", "z"), frame=Ecef())
    record(tmp_path / "a.rrd", ecef)
    drawn = rows(tmp_path / "a.rrd", "/picture/local/a")[0]
    assert drawn["GeoPoints:positions"] == [pytest.approx([60.0, 10.0], abs=1e-9)]
    assert drawn["Points2D:positions"] == [pytest.approx([0.0, 0.0], abs=1e-3)]
    record(tmp_path / "b.rrd", missions.tracks("a", 0, [1], [(3, 4)], frame=Local("piren")))
    drawn = rows(tmp_path / "b.rrd", "/picture/local/a")[0]
    assert drawn["Points2D:positions"] == [[3, -4]]
    assert "GeoPoints:positions" not in drawn


# ------------------------------------------------------------------ nothing stops the recorder


def test_what_cannot_be_drawn_is_recorded_counted_and_harms_nothing_else(tmp_path: Path) -> None:
    broken = np.tile(np.eye(4), (3, 1, 1))
    broken[1] = -broken[1]
    centre = missions.picture(0, [1], [(0, 0)])
    indefinite = missions.tracks("a", 0, [1, 2, 3], [(1, 1), (2, 2), (3, 3)], covariances=broken)
    not_finite = missions.tracks("b", 0, [1, 2], [(math.nan, 1), (2, 2)])
    elsewhere = missions.tracks("c", 0, [1], [(1, 1)], frame=Local("nowhere"))
    future = missions.tracks("d", 10 * 365 * 86400, [1], [(1, 1)])
    far = missions.tracks("e", 0, [1, 2], [(1e11, 1), (2, 2)], frame=Enu(60.5, 10.0))
    good = missions.tracks("f", 0, [1], [(1, 1)])
    said: list[Message] = [centre, indefinite, not_finite, elsewhere, future, far, good]
    path = tmp_path / "a.rrd"
    recorder = record(path, *said)
    assert [raw.data for raw in read(path)] == [encode(message) for message in said]
    labels = {name: [d["Points2D:labels"] for d in rows(path, f"/picture/local/{name}")] for name in "abcdef"}
    assert labels == {"a": [["1", "3"]], "b": [["2"]], "c": [], "d": [], "e": [["2"]], "f": [["1"]]}
    assert recorder.undrawn["not-positive-definite"] == 1
    assert recorder.undrawn["not-finite"] == 1
    assert sum("nowhere" in reason for reason in recorder.undrawn) == 1
    newest = max(
        item["time"] for item in rows(path, "/raw/local/d/tracks") + rows(path, "/raw/local/f/tracks") if item["time"]
    )
    assert newest == good.time
    assert any("c: 1 not drawn" in text for text in texts(path, "recorder"))


def test_a_message_that_comes_late_is_drawn_at_its_own_time(tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    record(path, *(missions.tracks("radar", s, [1], [(s, 0)]) for s in (0, 2, 1, 3)))
    drawn = [item["Points2D:positions"][0][0] for item in rows(path, "/picture/local/radar")]
    assert drawn == [0, 1, 2, 3]
    trails = [item["LineStrips2D:strips"] for item in rows(path, "/picture/local/radar/trail")]
    assert trails == [[[[0, 0], [2, 0]]], [[[2, 0], [3, 0]]]]
