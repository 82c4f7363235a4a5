"""Extents in the centre: what they add to association and to covariances, how they are fused, turned and kept."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.centre.extent_fusion import fused_extents
from fusion_service.centre.extents import message_extents, shaped, widened
from fusion_service.centre.lifecycle import empty_picture, newborn
from fusion_service.centre.rows import Rows
from fusion_service.centre.tracks import empty_tracks, unlinked
from fusion_service.geodesy import axis_turn, ecef_to_geodetic, enu_to_geodetic, geodetic_to_ecef, geodetic_to_enu
from tests.centre.worlds import FRAME, SPACE, centre, give, step, tracks

Floats = NDArray[np.float64]
NAN = np.nan
SIGMA = np.array([0.5, 0.5, 0.2, 0.2])
SHIP = (36.25, 9.6, 0.0)
OTHER = schemas.Enu(59.4, -50.0, 20.0)
PLANE = ("x", "y")


def scan(source: str, second: float, places: Any, sigma: Floats = SIGMA, **said: Any) -> schemas.LocalTracks:
    means = np.zeros((len(places), 4))
    means[:, :2] = places
    return tracks(source, second, means, sigma=sigma, **said)


@pytest.mark.parametrize("turn", [0.0, 0.7, 2.0])
@pytest.mark.parametrize(("offset", "joined"), [((16.0, 0.0), True), ((0.0, 16.0), False)])
def test_a_boat_abeam_is_another_and_a_point_of_the_bow_is_not(
    offset: tuple[float, float], joined: bool, turn: float
) -> None:
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    made = centre(("a", "b"))
    for second in range(1, 8):
        give(made, scan("a", second, [[100, 50]], extent=np.array([[*SHIP[:2], turn]]), shape="box"))
        give(made, scan("b", second, [np.array([100, 50]) + rotation @ offset]))
        result = step(made, second)
    assert len(result.tracks.ids) == (1 if joined else 2)


@pytest.mark.parametrize("shape", ["box", "ellipse"])
def test_a_point_of_an_object_has_the_variance_that_drawing_shows(shape: str) -> None:
    seed = 4
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    length, width, heading, draws = 30.0, 8.0, 0.6, 200_000
    unit = rng.uniform(-0.5, 0.5, (draws, 2))
    if shape == "ellipse":
        unit = unit[np.hypot(*unit.T) <= 0.5]
    c, s = np.cos(heading), np.sin(heading)
    points = (unit * [length, width]) @ np.array([[c, s], [-s, c]])
    message = tracks("a", 1, np.zeros((1, 4)), extent=np.array([[length, width, heading]]), shape=shape,
                     reference="antenna")  # fmt: skip
    column = message_extents([message], [np.array([True])], np.zeros((4, 1)), FRAME)
    xx, xy, yy = column[8:11, 0]
    error = 6 * length**2 / 8 / np.sqrt(draws)
    np.testing.assert_allclose([[xx, xy], [xy, yy]], np.cov(points.T), atol=error)


def test_what_is_not_known_makes_nothing_narrower() -> None:
    rows = [(30.0, 8.0, 0.0), (30.0, NAN, 0.0), (30.0, 8.0, NAN), (NAN, 8.0, 0.0), (NAN, NAN, NAN)]
    message = tracks("a", 1, np.zeros((5, 4)), extent=np.array(rows), reference="antenna")
    column = message_extents([message], [np.ones(5, bool)], np.zeros((4, 5)), FRAME)
    assert column[8].tolist()[:3] == [30.0**2 / 16] * 3
    assert column[10].tolist()[:4] == [4.0, 30.0**2 / 16, 30.0**2 / 16, 4.0]
    assert np.isnan(column[8:11, 4]).all()
    assert message_extents([tracks("a", 1, np.zeros((1, 4)))], [np.ones(1, bool)], np.zeros((4, 1)), FRAME).size == 0
    assert message_extents([message], [np.zeros(5, bool)], np.zeros((4, 0)), FRAME).shape[1] == 0


def test_a_heading_turns_with_the_frame_as_two_points_do() -> None:
    """From one origin to another 300 km east: a stick of 10 m by its two ends, through latitude and longitude."""
    rng = np.random.default_rng(8)
    place, heading = rng.uniform(-2e4, 2e4, (2, 20)), rng.uniform(-np.pi, np.pi, 20)
    ends = [place - 5.0 * np.array([np.cos(heading), np.sin(heading)]),
            place + 5.0 * np.array([np.cos(heading), np.sin(heading)])]  # fmt: skip
    geodetic = [enu_to_geodetic(end[0], end[1], np.zeros(20), OTHER) for end in ends]
    (x0, y0, _), (x1, y1, _) = (geodetic_to_enu(*one, FRAME) for one in geodetic)
    found = axis_turn(np.stack([(x0 + x1) / 2, (y0 + y1) / 2]), PLANE, OTHER, FRAME)
    gap = np.angle(np.exp(1j * (heading + found - np.arctan2(y1 - y0, x1 - x0))))
    assert np.abs(found).min() > 0.05, "they are turned"
    assert np.abs(gap).max() < 0.002
    back = axis_turn(place, PLANE, FRAME, OTHER)
    assert np.abs(found + back).max() < 0.005
    assert not axis_turn(place, PLANE, FRAME, FRAME).any()
    assert axis_turn(np.zeros((2, 0)), PLANE, OTHER, FRAME).shape == (0,)


def test_in_an_ecef_frame_a_heading_counts_from_east() -> None:
    place = np.array(np.broadcast_to(geodetic_place(FRAME, 500.0, -300.0), (1, 3))).T
    turn = axis_turn(place, ("x", "y", "z"), OTHER, schemas.Ecef())
    lat, lon, alt = ecef_to_geodetic(*place)
    there = schemas.Enu(float(lat[0]), float(lon[0]), float(alt[0]))
    np.testing.assert_allclose(turn, axis_turn(np.zeros((2, 1)), PLANE, OTHER, there), atol=2e-3)
    np.testing.assert_allclose(axis_turn(np.zeros((2, 1)), PLANE, schemas.Ecef(), there), 0.0, atol=1e-9)


def geodetic_place(frame: schemas.Enu, x: float, y: float) -> Floats:
    return np.array(geodetic_to_ecef(*enu_to_geodetic(x, y, 0.0, frame)))


def test_widened_in_ecef_is_widened_in_the_level_plane() -> None:
    place = geodetic_place(FRAME, 0.0, 0.0)
    table = replace(empty_tracks(3), mean=place[:, None], covariance=np.zeros((3, 3, 1)),
                    part_covariance=np.zeros((3, 3, 0, 1)))  # fmt: skip
    found = widened(table, np.array([[9.0], [2.0], [4.0]]), ("x", "y", "z"), schemas.Ecef()).covariance[..., 0]
    lat, lon = np.radians(FRAME.lat), np.radians(FRAME.lon)
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    axes = np.stack([east, north])
    np.testing.assert_allclose(found, axes.T @ np.array([[9.0, 2.0], [2.0, 4.0]]) @ axes, atol=1e-9)


@pytest.mark.parametrize("memory", ["restart", "recursive", "tracklet"])
def test_an_antenna_somewhere_on_a_ship_stays_in_the_fused_covariance(memory: str) -> None:
    made = centre(("ais", "ais2"), memory=memory)
    for second in range(1, 25):
        for name in ("ais", "ais2"):
            give(made, scan(name, second, [[0, 0]], extent=np.array([SHIP]), shape="box", reference="antenna"))
        result = step(made, second)
    (covariance,) = result.tracks.covariances
    place = np.diag(covariance)[[SPACE.index("x"), SPACE.index("y")]]
    bound = np.array(SHIP[:2]) ** 2 / 12
    assert (place > 0.45 * bound).all(), "of two sources whose antennas are two"
    assert (place < 1.2 * (bound + 1.0)).all()


def test_a_stated_covariance_wins_and_nan_leaves_the_word() -> None:
    made = centre(("a",))
    given = np.array([[[25.0, 5.0], [5.0, 4.0]], [[NAN, NAN], [NAN, NAN]]])
    give(made, scan("a", 1, [[0, 0], [900, 0]], extent=np.array([SHIP, SHIP]), reference="blob",
                    reference_covariances=given))  # fmt: skip
    found = step(made, 1).tracks.covariances[:, :2, :2]
    np.testing.assert_allclose(found[0], given[0] + 0.25 * np.eye(2), rtol=1e-9)
    np.testing.assert_allclose(found[1], np.diag(np.array(SHIP[:2]) ** 2 / 16 + 0.25), rtol=1e-9)


def rows_of(extent: Floats, links: list[int]) -> Rows:
    count = len(links)
    link = unlinked(count) | {"link": np.array(links, dtype=np.uint64)}
    table = replace(
        empty_tracks(4),
        id=np.arange(count, dtype=np.uint64),
        mean=np.zeros((4, count)),
        covariance=np.zeros((4, 4, count)),
        part_covariance=np.zeros((4, 4, 0, count)),
        log_weight=np.zeros((0, count)),
        extent=extent,
        **link,
    )
    some = np.ones(count, dtype=np.bool_)
    zero = np.zeros(count, dtype=np.intp)
    return Rows(zero, zero, table, some, zero, ~some, np.zeros((5, count)), some, {})  # type: ignore[arg-type]


def told(*rows: tuple[float, ...]) -> Floats:
    """Columns of extents: length, width, heading and their standard deviations."""
    column = np.full((11, len(rows)), NAN)
    for k, row in enumerate(rows):
        column[: len(row), k] = row
    column[6:8] = 0.0
    return column


def test_what_is_fused_is_never_surer_than_its_parts_whatever_their_correlation() -> None:
    seed = 11
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    runs, sigma = 20_000, np.array([0.1, 0.25])
    picture = newborn(np.arange(1, runs + 1, dtype=np.uint64), 4, 0)
    for correlation in (0.0, 0.9, 1.0):
        whole = np.array([[1.0, correlation], [correlation, 1.0]]) * np.outer(sigma, sigma)
        errors = rng.multivariate_normal(np.zeros(2), whole, runs, method="eigh")
        headings = (1.5 + errors).T.ravel() + np.pi * rng.integers(-2, 3, 2 * runs)
        rows = np.array([np.full(2 * runs, NAN)] * 11)
        rows[2], rows[5], rows[7] = headings, np.repeat(sigma, runs), 0.0
        made = fused_extents(rows_of(rows, list(range(1, runs + 1)) * 2), picture, 1.0)
        off = np.mod(made.extent[2] - 1.5 + np.pi / 2, np.pi) - np.pi / 2
        stated = made.extent[5, 0]
        assert np.std(off) <= stated * 1.02
        assert np.sqrt(1 / (1 / sigma**2).sum()) < stated <= sigma.max()
    assert np.std(off) == pytest.approx(stated, rel=0.02), "at a correlation of 1 the bound is reached"


def test_fusion_over_sources_and_time() -> None:
    picture = newborn(np.array([1, 2, 3], dtype=np.uint64), 4, 0)
    rows = told((10, 4, 0.1, 1, 0.4, 0.1), (10, 4, 0.1 + np.pi, 1, 0.4, 0.1), (20, NAN, NAN, 2))
    made = fused_extents(rows_of(rows, [1, 1, 2]), picture, 1.0)
    np.testing.assert_allclose(np.exp(made.extent[:2, 0]), [10, 4])
    np.testing.assert_allclose(made.extent[2:6, 0], [0.1, 0.1, 0.1, 0.1], atol=1e-12)
    assert np.exp(made.extent[0, 1]) == pytest.approx(20.0)
    assert np.isnan(made.extent[1:3, 1]).all()
    assert np.isnan(made.extent[:3, 2]).all()
    turned = fused_extents(rows_of(rows[:, [1, 0, 2]], [1, 1, 2]), picture, 1.0)
    np.testing.assert_allclose(turned.extent[:6, 0], made.extent[:6, 0], atol=1e-12)
    quiet = fused_extents(rows_of(np.zeros((0, 0)), []), made, 10.0)
    assert (quiet.extent[:3, 0] == made.extent[:3, 0]).all()
    assert (quiet.extent[3:6, 0] > made.extent[3:6, 0]).all(), "vaguer with time"
    gone = fused_extents(rows_of(np.zeros((0, 0)), []), made, 2000.0)
    assert gone.extent.shape == (0, 3), "and at last not known"
    assert fused_extents(rows_of(np.zeros((0, 0)), []), empty_picture(4), 1.0).extent.size == 0
    blob = rows.copy()
    blob[7] = 3.0
    assert fused_extents(rows_of(blob, [1, 1, 2]), picture, 1.0).extent.size == 0, "a blob says nothing"
    same, now = shaped(rows_of(np.zeros((0, 3)), [1, 1, 2]), picture, SPACE, FRAME)
    assert now is picture
    assert same.tracks.extent.size == 0


def test_the_fused_extent_is_published_in_the_frame_of_the_picture() -> None:
    made = centre(("a", "b"), frame=FRAME)
    turn = float(axis_turn(np.zeros((2, 1)), PLANE, OTHER, FRAME)[0])
    x, y, _ = geodetic_to_enu(FRAME.lat, FRAME.lon, 0.0, OTHER)
    for second in range(1, 6):
        said = {"extent": np.array([[30.0, 10.0, 0.4 - turn]]), "extent_sigma": np.array([[2.0, 1.0, 0.05]])}
        give(made, scan("a", second, [[x, y]], frame=OTHER, shape="box", **said))
        result = step(made, second)
    assert result.tracks.extent is not None
    assert result.tracks.extent_sigma is not None
    np.testing.assert_allclose(result.tracks.extent[0], [30.0, 10.0, 0.4], atol=2e-3)
    assert 0.0 < result.tracks.extent_sigma[0, 2] <= 0.1
    assert result.tracks.shape == "box"
    assert schemas.check_numbers([result.tracks])[0].tolist() == [0]
    frame = {"kind": "enu", "lat": OTHER.lat, "lon": OTHER.lon, "alt": OTHER.alt}
    moved = FusionCentre({"lateness": 3.0, "frame": frame}, made.checkpoint())
    later = step(moved, 6).tracks
    assert later.extent is not None
    np.testing.assert_allclose(later.extent[0, 2], np.mod(0.4 - turn, np.pi), atol=2e-3)


def test_a_track_whose_extent_is_unsound_is_refused_and_no_other() -> None:
    made = centre(("a",))
    bad = [[5.0, 6.0, 0.0], [5.0, 2.0, 0.0], [np.inf, 2.0, 0.0], [0.0, NAN, NAN], [NAN, NAN, NAN]]
    give(made, scan("a", 1, [[1000 * k, 0] for k in range(5)], extent=np.array(bad)))
    result = step(made, 1)
    assert len(result.tracks.ids) == 2
    assert [(one.reason, one.count) for one in result.log.refused] == [("extent", 3)]
    give(made, scan("a", 2, [[0, 0]], extent=np.zeros((2, 3))), scan("a", 3, [[0, 0]], extent=np.zeros(3)))
    assert {one.reason for one in step(made, 3).log.refused} == {"length", "bad-field"}


def test_a_world_without_extents_carries_no_column() -> None:
    made = centre(("a",))
    for second in range(1, 4):
        give(made, scan("a", second, [[0, 0]]))
        result = step(made, second)
    assert result.tracks.extent is None
    assert made._picture.extent.shape == (0, 1)
    assert made._intake.sources["a"].tracks.extent.shape == (0, 1)
