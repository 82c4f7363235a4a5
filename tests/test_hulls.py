"""Hulls: the nearest point against a dense sampling of the hull, and what a shift or a turn leaves alone."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion_service.hulls import centres, drawable, outlines, to_hulls

Floats = NDArray[np.float64]


def sampled(extent: Floats, box: bool, count: int = 400) -> Floats:
    """Points of one hull about the origin, edges included."""
    u, v = np.meshgrid(np.linspace(-0.5, 0.5, count), np.linspace(-0.5, 0.5, count))
    if not box:
        radius, angle = np.meshgrid(np.linspace(0, 0.5, count // 2), np.linspace(0, 2 * np.pi, 2 * count))
        u, v = radius * np.cos(angle), radius * np.sin(angle)
    length, width, heading = extent
    x, y = u.ravel() * length, v.ravel() * width
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([c * x - s * y, s * x + c * y], axis=1)


@pytest.mark.parametrize("box", [True, False])
def test_the_nearest_point_is_that_of_a_dense_sampling(box: bool) -> None:
    seed = 6
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    extent, place = np.array([[36.0, 9.6, 0.7]]), np.array([[100.0, -40.0]])
    points = place + rng.normal(size=(60, 2)) * 20
    root = rng.normal(size=(60, 2, 2))
    covariances = root @ root.swapaxes(1, 2) + 0.1 * np.eye(2)
    polygons = np.repeat(outlines(place, extent, box), 60, axis=0)
    distance, least = to_hulls(points, polygons, covariances)
    gaps = points[:, None] - (sampled(extent[0], box) + place)[None]
    np.testing.assert_allclose(distance, np.sqrt((gaps**2).sum(axis=2).min(axis=1)), atol=0.15)
    precision = np.linalg.inv(covariances)
    expected = np.einsum("bpi,bij,bpj->bp", gaps, precision, gaps).min(axis=1)
    np.testing.assert_allclose(np.sqrt(least), np.sqrt(expected), atol=0.15 * np.sqrt(precision.max()))
    assert 3 <= (distance == 0).sum() <= 57
    np.testing.assert_array_equal(distance == 0, least == 0)


def test_a_turn_and_a_shift_of_all_change_nothing() -> None:
    rng = np.random.default_rng(2)
    extent, place = np.tile([20.0, 6.0, 0.3], (30, 1)), rng.normal(size=(30, 2)) * 50
    points, covariances = place + rng.normal(size=(30, 2)) * 12, np.tile(np.diag([4.0, 9.0]), (30, 1, 1))
    turn, shift = 1.1, np.array([1000.0, -2000.0])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    for box in (True, False):
        one = to_hulls(points, outlines(place, extent, box), covariances)
        turned = outlines(place @ rotation.T + shift, extent + np.array([0, 0, turn]), box)
        other = to_hulls(points @ rotation.T + shift, turned, rotation @ covariances @ rotation.T)
        np.testing.assert_allclose(one, other, atol=1e-9)
        half = to_hulls(points, outlines(place, extent + np.array([0, 0, np.pi]), box), covariances)
        np.testing.assert_allclose(one, half, atol=1e-9)


def test_an_offset_is_along_the_heading_and_to_the_left() -> None:
    extent = np.array([[30.0, 8.0, np.pi / 2]] * 3)
    offset = np.array([[10.0, 2.0], [np.nan, np.nan], [1e4, 0.0]])
    found = centres(np.zeros((3, 2)), extent, offset)
    np.testing.assert_allclose(found, [[2.0, -10.0], [0.0, 0.0], [0.0, 0.0]], atol=1e-9)
    assert centres(found, extent, None) is found


def test_nothing() -> None:
    none = np.zeros((0, 2))
    for box in (True, False):
        distance, least = to_hulls(none, outlines(none, np.zeros((0, 3)), box), np.zeros((0, 2, 2)))
        assert distance.shape == least.shape == (0,)
    assert drawable(np.array([[5.0, 2.0, 0.0], [5.0, np.nan, 0.0], [5.0, 6.0, 0.0]])).tolist() == [True, False, False]
