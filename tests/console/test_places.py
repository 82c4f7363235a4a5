from __future__ import annotations

import math

import numpy as np
import pymap3d
import pytest

from fusion_service.console.pictures import Pictures
from fusion_service.console.places import frame_words, places, source_place
from schemas import Disk, Ecef, Enu, Frame, Local, Motion, Polygon, Sector, SensorInfo
from tests.console.scenes import HARBOUR, picture

EAST = np.array([1000.0, 20000.0, -7000.0])
NORTH = np.array([500.0, -30000.0, 0.0])


def spread(frame: Enu) -> np.ndarray:
    """Three states about a frame: means (3, 4)."""
    return np.stack([EAST, NORTH, np.array([3.0, 0.0, -1.0]), np.array([4.0, -2.0, 0.0])], axis=1)


def test_a_picture_in_enu_lies_where_an_independent_library_has_it() -> None:
    found = places(picture(3, means=spread(HARBOUR)))
    _, _, up = pymap3d.geodetic2enu(*pymap3d.enu2geodetic(EAST, NORTH, 0.0, 59.0, 10.5, 0.0)[:2], 0.0, 59.0, 10.5, 0.0)
    lat, lon, _ = pymap3d.enu2geodetic(EAST, NORTH, up, 59.0, 10.5, 0.0)
    np.testing.assert_allclose(found.x, lon, atol=1e-6)
    np.testing.assert_allclose(found.y, lat, atol=1e-6)
    assert np.isnan(found.height).all()
    np.testing.assert_allclose(found.major, 20.0, rtol=1e-4)
    np.testing.assert_allclose(found.minor, 10.0, rtol=1e-4)
    # the axes of an ENU frame are turned against north elsewhere by the convergence of the meridians
    np.testing.assert_allclose(found.turn, -np.radians(lon - 10.5) * np.sin(np.radians(59.0)), atol=2e-4)
    np.testing.assert_allclose(np.hypot(found.vx, found.vy), [5.0, 2.0, 1.0], rtol=1e-3)


def test_a_picture_in_ecef_is_the_same_one() -> None:
    flat = picture(3, means=spread(HARBOUR))
    lat, lon, _ = pymap3d.enu2geodetic(EAST, NORTH, 0.0, 59.0, 10.5, 0.0)
    x, y, z = pymap3d.geodetic2ecef(lat, lon, np.full(3, 100.0))
    vx, vy, vz = pymap3d.enu2uvw(flat.means[:, 2], flat.means[:, 3], 0.0, lat, lon)
    covariances = np.zeros((3, 6, 6))
    for k in range(3):
        turn = np.array([np.array(pymap3d.enu2uvw(*axis, lat[k], lon[k])) for axis in np.eye(3)]).T
        covariances[k, :3, :3] = turn @ np.diag([400.0, 100.0, 9.0]) @ turn.T
        covariances[k, 3:, 3:] = np.eye(3)
    found = places(
        picture(
            3, frame=Ecef(), space=("x", "y", "z", "vx", "vy", "vz"), covariances=covariances,
            means=np.stack([x, y, z, vx, vy, vz], axis=1),
        )
    )  # fmt: skip
    np.testing.assert_allclose(found.x, lon, atol=1e-9)
    np.testing.assert_allclose(found.y, lat, atol=1e-9)
    np.testing.assert_allclose(found.height, 100.0, atol=1e-5)
    np.testing.assert_allclose(found.major, 20.0, rtol=1e-9)
    np.testing.assert_allclose(found.minor, 10.0, rtol=1e-9)
    np.testing.assert_allclose(found.turn, 0.0, atol=1e-6)
    np.testing.assert_allclose(np.stack([found.vx, found.vy], 1), flat.means[:, 2:], atol=1e-9)


def test_a_local_frame_is_shown_as_it_is() -> None:
    turned = np.array([[250.0, 150.0], [150.0, 250.0]])
    covariances = np.zeros((3, 4, 4))
    covariances[:, :2, :2] = turned
    covariances[:, 2:, 2:] = np.eye(2)
    found = places(picture(3, frame=Local("hall"), covariances=covariances))
    assert found.x.tolist() == [0.0, 100.0, 200.0]
    np.testing.assert_allclose([found.major[0], found.minor[0], found.turn[0]], [20.0, 10.0, math.pi / 4])


def test_what_a_density_does_not_say_is_not_shown() -> None:
    covariances = np.tile(np.diag([400.0, 100.0, 1e8, 1e8, 1e12]), (2, 1, 1))
    space = ("x", "y", "vx", "vy", "z")
    found = places(picture(2, space=space, means=np.full((2, 5), 30000.0), covariances=covariances))
    assert np.isnan(found.vx).all()
    assert np.isnan(found.height).all()
    assert found.major[0] == pytest.approx(20.0, rel=1e-3)
    spoilt = np.full((2, 4), np.nan)
    assert not places(picture(2, means=spoilt)).sound.any()
    assert len(places(picture(0)).x) == 0
    assert not places(picture(1, frame=Ecef())).sound.any()


def info(frame: Frame, position: tuple[float, float, float], coverage: Disk | Sector | Polygon | None) -> SensorInfo:
    return SensorInfo(
        source="r1", epoch=1, seq=0, sent=0, frame=frame, position=position, period=1.0, motion=Motion("cv", 1.0),
        coverage=coverage,
    )  # fmt: skip


@pytest.mark.parametrize("coverage", [Disk(5000.0), Sector(5000.0, 0.5, 1.0, 100.0)])
def test_a_coverage_is_outlined_about_the_sensor(coverage: Disk | Sector) -> None:
    found = source_place(info(HARBOUR, (1000.0, 2000.0, 10.0), coverage))
    assert found is not None
    lon, lat = np.array(found["outline"]).T
    east, north, _ = pymap3d.geodetic2enu(lat, lon, 0.0, found["place"][1], found["place"][0], 0.0)
    far = np.hypot(east, north)
    assert far.max() == pytest.approx(5000.0, rel=1e-3)
    if isinstance(coverage, Sector):
        outer = far > 1000.0
        azimuth = np.arctan2(east[outer], north[outer])
        np.testing.assert_allclose([azimuth.min(), azimuth.max()], [0.0, 1.0], atol=2e-3)
        assert far.min() == pytest.approx(100.0, rel=1e-2)


def test_places_of_sources_in_all_frames() -> None:
    at = tuple(float(value) for value in pymap3d.geodetic2ecef(59.0, 10.5, 20.0))
    found = source_place(info(Ecef(), (at[0], at[1], at[2]), Disk(1000.0)))
    assert found is not None
    np.testing.assert_allclose(found["place"], [10.5, 59.0], atol=1e-9)
    corners = ((0.0, 0.0), (10.0, 0.0), (0.0, 10.0))
    hall = source_place(info(Local("hall"), (1.0, 2.0, 0.0), Polygon(corners)))
    assert hall == {"local": "hall", "place": [1.0, 2.0], "outline": [list(corner) for corner in corners]}
    assert source_place(info(Ecef(), (0.0, 0.0, 0.0), None)) is None
    far = source_place(info(HARBOUR, (0.0, 0.0, 0.0), Disk(1e8)))
    assert far is not None
    assert far["outline"] == []


def test_what_is_near_is_near_on_both_sides_of_the_antimeridian() -> None:
    fiji = Enu(-17.0, 179.98)
    lat, lon, _ = pymap3d.enu2geodetic(EAST, NORTH, 0.0, fiji.lat, fiji.lon, 0.0)
    assert lon.min() < 0 < lon.max()
    x, y, z = pymap3d.geodetic2ecef(lat, lon, np.zeros(3))
    state = np.stack([x, y, z, *np.zeros((3, 3))], axis=1)
    space, covariances = ("x", "y", "z", "vx", "vy", "vz"), np.tile(np.eye(6), (3, 1, 1))
    pictures = Pictures()
    for step, shown in enumerate(
        (
            picture(3, means=spread(fiji), frame=fiji),
            picture(3, step=2, frame=Ecef(), space=space, means=state, covariances=covariances),
            picture(3, step=3, means=spread(fiji), frame=Enu(-17.0, -179.99)),
        )
    ):
        assert pictures.take(shown, float(step))
        assert pictures.places is not None
        assert np.ptp(pictures.places.x) < 1.0
        assert np.abs(pictures.places.x - fiji.lon).max() < 1.0
        if step < 2:
            np.testing.assert_allclose(np.cos(np.radians(pictures.places.x - lon)), 1.0, atol=1e-12)
    outline = source_place(info(Enu(-17.0, -179.99), (0.0, 0.0, 0.0), Disk(8000.0)))
    assert outline is not None
    assert np.ptp([corner[0] for corner in outline["outline"]]) < 1.0


def test_at_a_pole_the_picture_is_flat() -> None:
    pole = Enu(-89.99, 12.0)
    found = places(picture(3, means=spread(pole), frame=pole))
    np.testing.assert_array_equal(np.stack([found.x, found.y]), np.stack([EAST, NORTH]))
    words = frame_words(pole)
    assert words == {"kind": "local", "name": "east and north of -89.99, 12"}
    beside = source_place(info(pole, (10.0, 20.0, 0.0), None))
    assert beside == {"local": words["name"], "place": [10.0, 20.0], "outline": []}
    x, y, z = pymap3d.geodetic2ecef(89.9, 0.0, 0.0)
    far = np.array([[x, y, z]])
    top = places(picture(1, frame=Ecef(), space=("x", "y", "z"), means=far, covariances=np.eye(3)[None]))
    assert not top.sound.any(), "a map by Mercator has no room for it"
