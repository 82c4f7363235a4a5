"""Coverage against other ways to tell inside from outside."""

from __future__ import annotations

import numpy as np
import pytest

import schemas
from fusion_service.coverage import covers
from fusion_service.geodesy import geodetic_to_enu

HERE = schemas.Enu(59.0, -55.0)
MOTION = schemas.Motion("cv", 1.0)


def sensor(
    coverage: schemas.Coverage | None, frame: schemas.Frame = HERE, at: tuple[float, float] = (0.0, 0.0)
) -> schemas.SensorInfo:
    return schemas.SensorInfo(
        source="s", epoch=1, seq=0, sent=0, frame=frame, position=(*at, 0.0), period=1.0, motion=MOTION,
        coverage=coverage,
    )  # fmt: skip


def places(count: int = 500, reach: float = 1500.0, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-reach, reach, (2, count))


def test_a_disk_about_the_sensor() -> None:
    xy = places()
    got = covers(sensor(schemas.Disk(1000.0, inner=200.0), at=(100.0, -50.0)), xy, HERE)
    distance = np.abs((xy[0] - 100) + 1j * (xy[1] + 50))
    np.testing.assert_array_equal(got, (distance >= 200) & (distance <= 1000))
    assert 50 < got.sum() < 450


@pytest.mark.parametrize("azimuth", [0.0, 3.0, -3.0, 6.0])
def test_a_sector_is_clockwise_from_north(azimuth: float) -> None:
    xy = places()
    got = covers(sensor(schemas.Sector(1400.0, azimuth, 1.0)), xy, HERE)
    axis = np.array([np.sin(azimuth), np.cos(azimuth)])
    distance = np.linalg.norm(xy, axis=0)
    np.testing.assert_array_equal(got, (axis @ xy >= distance * np.cos(0.5)) & (distance <= 1400))
    assert got.any()


def test_a_polygon_by_the_angles_its_corners_are_seen_under() -> None:
    points = ((-900.0, -800.0), (1000.0, -900.0), (200.0, 0.0), (1100.0, 950.0), (-800.0, 700.0))
    xy = places()
    got = covers(sensor(schemas.Polygon(points)), xy, HERE)
    for k in range(xy.shape[1]):
        corners = np.array(points) - xy[:, k]
        after = np.roll(corners, -1, axis=0)
        cross = corners[:, 0] * after[:, 1] - corners[:, 1] * after[:, 0]
        turns = np.arctan2(cross, (corners * after).sum(axis=1)).sum() / (2 * np.pi)
        assert got[k] == (round(turns) != 0)
    assert got.any()
    assert not got.all()


def test_in_a_frame_of_its_own() -> None:
    there = schemas.Enu(57.5, -57.6)
    x, y, _ = (float(v) for v in geodetic_to_enu(57.6, -57.6, 0.0, HERE))
    north_of_it = np.array([[x], [y]])
    assert covers(sensor(schemas.Disk(12_000.0), there), north_of_it, HERE).all()
    assert not covers(sensor(schemas.Disk(10_000.0), there), north_of_it, HERE).any()


def test_nothing_without_a_word_or_a_way() -> None:
    assert not covers(sensor(None), places(5), HERE).any()
    assert not covers(sensor(schemas.Disk(1e6), schemas.Local("dock")), places(5), HERE).any()
