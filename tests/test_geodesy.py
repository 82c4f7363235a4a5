"""Against pymap3d, finite differences and Monte Carlo; bit-for-bit independence of the batch."""

import math

import numpy as np
import pymap3d
import pytest

from fusion_service.arrays import Floats
from fusion_service.geodesy import (
    FrameError,
    ecef_to_geodetic,
    enu_to_geodetic,
    geodetic_to_ecef,
    geodetic_to_enu,
    transform,
)
from schemas import Ecef, Enu, Frame, Height, Local

SEED = 20250702
RNG = np.random.default_rng(SEED)
SPACE_2D = ("x", "vx", "y", "vy")
SPACE_3D = ("vz", "x", "ay", "vx", "y", "az", "vy", "z", "ax", "turn_rate")
OSLO, BERGEN, SVALBARD = Enu(59.9, 10.7, 30.0), Enu(60.4, 5.3, 250.0), Enu(78.2, 15.6, 400.0)
FRAMES: list[Frame] = [OSLO, BERGEN, SVALBARD, Enu(-90.0, 0.0, 0.0), Enu(-33.0, 179.9, 10.0), Ecef()]


def covariance(rng: np.random.Generator, sigmas: Floats) -> Floats:
    a = rng.normal(size=(len(sigmas), len(sigmas)))
    p = a @ a.T + np.eye(len(sigmas))
    s = sigmas / np.sqrt(np.diag(p))
    return np.asarray(p * np.outer(s, s))


def places(size: int) -> tuple[Floats, Floats, Floats]:
    """Latitudes, longitudes (degrees) and altitudes (m) over all the Earth, poles and date line among them."""
    lat, lon, alt = RNG.uniform(-90, 90, size), RNG.uniform(-180, 180, size), RNG.uniform(-1e4, 1e6, size)
    lat[:3], lon[3], lon[4] = (90.0, -90.0, 0.0), 180.0, -180.0
    return lat, lon, alt


def test_positions_against_pymap3d() -> None:
    lat, lon, alt = places(2000)
    x, y, z = geodetic_to_ecef(lat, lon, alt)
    np.testing.assert_allclose((x, y, z), pymap3d.geodetic2ecef(lat, lon, alt), atol=5e-9, rtol=0)
    for origin in (f for f in FRAMES if isinstance(f, Enu)):
        at = (origin.lat, origin.lon, origin.alt)
        enu = geodetic_to_enu(lat, lon, alt, origin)
        np.testing.assert_allclose(enu, pymap3d.geodetic2enu(lat, lon, alt, *at), atol=1e-8, rtol=0)
        back = np.array(geodetic_to_ecef(*enu_to_geodetic(*enu, origin)))
        np.testing.assert_allclose(back, (x, y, z), atol=2e-8, rtol=0)


@pytest.mark.parametrize("high", [1e4, 1e6, 4e7])
def test_geodetic_inverts_ecef(high: float) -> None:
    lat, lon, alt = places(2000)
    alt = np.abs(alt) / 1e6 * high
    found = ecef_to_geodetic(*geodetic_to_ecef(lat, lon, alt))
    np.testing.assert_allclose(found[2], alt, atol=2e-8, rtol=0)
    np.testing.assert_allclose(found[0], lat, atol=1e-13, rtol=4e-16 * 4)
    turn = np.exp(1j * np.radians(found[1] - lon))
    np.testing.assert_allclose(np.where(np.abs(lat) == 90, 1.0, turn), 1.0, atol=1e-14)


def test_geodetic_shapes() -> None:
    np.testing.assert_array_equal(ecef_to_geodetic(6378137.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    assert geodetic_to_ecef(np.zeros((2, 1)), np.zeros(3), 0.0)[0].shape == (2, 3)
    assert np.isnan(ecef_to_geodetic(0.0, 0.0, 0.0)[0])


@pytest.mark.parametrize("target", FRAMES)
@pytest.mark.parametrize("source", FRAMES)
def test_with_z_a_state_moves_as_its_trajectory_does(source: Frame, target: Frame) -> None:
    """Positions by pymap3d; velocity and acceleration from three positions on the parabola of the state."""
    lat, lon, alt = np.array([61.0, 77.0, 59.0]), np.array([7.0, 20.0, 10.0]), np.array([0.0, 9000.0, 100.0])

    def to(frame: Frame, xyz: Floats) -> Floats:
        return np.array(pymap3d.ecef2enu(*xyz, frame.lat, frame.lon, frame.alt) if isinstance(frame, Enu) else xyz)

    def ecef(frame: Frame, xyz: Floats) -> Floats:
        return np.array(pymap3d.enu2ecef(*xyz, frame.lat, frame.lon, frame.alt) if isinstance(frame, Enu) else xyz)

    p = to(source, np.array(pymap3d.geodetic2ecef(lat, lon, alt)))
    v, a = RNG.normal(size=(3, 3)) * 300, RNG.normal(size=(3, 3)) * 30
    parts = dict(zip(("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az"), (*p, *v, *a), strict=True))
    parts["turn_rate"] = np.array([0.1, -0.2, 0.0])
    means = np.stack([parts[name] for name in SPACE_3D], axis=-1)
    got, _ = transform(means, np.tile(np.eye(10), (3, 1, 1)), SPACE_3D, source, target)
    found = dict(zip(SPACE_3D, got.T, strict=True))
    before, now, after = (to(target, ecef(source, p + t * v + t * t / 2 * a)) for t in (-10.0, 0.0, 10.0))
    np.testing.assert_allclose([found[k] for k in "xyz"], now, atol=2e-8, rtol=0)
    np.testing.assert_allclose([found[k] for k in ("vx", "vy", "vz")], (after - before) / 20, atol=1e-8, rtol=0)
    np.testing.assert_allclose([found[k] for k in ("ax", "ay", "az")], (after - 2 * now + before) / 100, atol=1e-8)
    np.testing.assert_array_equal(found["turn_rate"], parts["turn_rate"])


def test_with_z_covariances_against_monte_carlo() -> None:
    """Each entry of the sample covariance of N draws is off by about sqrt((P_ij^2 + P_ii P_jj) / N)."""
    size, n = 40_000, len(SPACE_3D)
    mean = RNG.normal(size=n) * 1e4
    cov = covariance(RNG, RNG.uniform(1, 100, n))
    draws = mean + RNG.standard_normal((size, n)) @ np.linalg.cholesky(cov).T
    moved, spread = transform(mean, cov, SPACE_3D, OSLO, SVALBARD)
    clouds, _ = transform(draws, np.broadcast_to(cov, (size, n, n)), SPACE_3D, OSLO, SVALBARD)
    sample = np.cov(clouds.T)
    d = np.diag(spread)
    error = np.sqrt((spread**2 + np.outer(d, d)) / size)
    assert np.all(np.abs(sample - spread) < 5 * error), f"seed {SEED}"
    assert np.all(np.abs(clouds.mean(axis=0) - moved) < 5 * np.sqrt(d / size))
    np.testing.assert_array_equal(spread, spread.T)


@pytest.mark.parametrize("height", [Height(), Height(3000.0), Height(-20.0)])
@pytest.mark.parametrize("far", [1.0, 8.0])
def test_without_z_places_stay_on_the_height_surface(height: Height, far: float) -> None:
    """pymap3d gives x, y in both frames of places on the surface, more than 300 km and 2,000 km away."""
    lat, lon = 59.9 - far * RNG.uniform(-1, 2.5, 500), 10.7 + far * RNG.uniform(-5, 1, 500)
    at = np.full(500, height.value)
    e, n, _ = pymap3d.geodetic2enu(lat, lon, at, OSLO.lat, OSLO.lon, OSLO.alt)
    assert np.hypot(e, n).max() > 3e5 * min(far, 7.0)
    means = np.stack([e, np.zeros(500), n, np.zeros(500)], axis=-1)
    moved, _ = transform(means, np.tile(np.eye(4), (500, 1, 1)), SPACE_2D, OSLO, BERGEN, height)
    want = pymap3d.geodetic2enu(lat, lon, at, BERGEN.lat, BERGEN.lon, BERGEN.alt)[:2]
    np.testing.assert_allclose((moved[:, 0], moved[:, 2]), want, atol=2e-8, rtol=0)


def test_without_z_the_jacobian_is_the_derivative_of_the_map() -> None:
    """Finite differences of the position; velocity and acceleration turn with the same matrix."""
    space = ("ay", "y", "vx", "x", "ax", "vy", "turn_rate")
    n = len(space)
    means = RNG.normal(size=(50, n))
    means[:, 1], means[:, 3] = RNG.uniform(-2e5, 2e5, (2, 50))
    covs = np.stack([covariance(RNG, RNG.uniform(0.1, 30, n)) for _ in range(50)])
    moved, spread = transform(means, covs, space, OSLO, SVALBARD, Height(500.0))

    def place(dx: float, dy: float) -> Floats:
        offset = np.zeros(n)
        offset[[3, 1]] = dx, dy
        return transform(means + offset, covs, space, OSLO, SVALBARD, Height(500.0))[0][:, [3, 1]]

    h = 10.0
    columns = [(place(h, 0) - place(-h, 0)) / (2 * h), (place(0, h) - place(0, -h)) / (2 * h)]
    J = np.stack(columns, axis=-1)
    for x, y in ((2, 5), (4, 0)):
        np.testing.assert_allclose(moved[:, [x, y]], np.einsum("bij,bj->bi", J, means[:, [x, y]]), atol=1e-7)
    full = np.tile(np.eye(n), (50, 1, 1))
    for pair in ((3, 1), (2, 5), (4, 0)):
        full[np.ix_(range(50), pair, pair)] = J
    np.testing.assert_allclose(spread, full @ covs @ full.swapaxes(1, 2), rtol=1e-7, atol=1e-5)
    assert np.ptp(J[:, 0, 0]) > 1e-3, "the places should be far enough apart for J to differ"


def test_without_z_the_height_counts_by_its_derivative() -> None:
    """sigma adds g g' to the position, g the central difference by the height; far away, where g has 4 figures."""
    mean, cov, sigma = np.array([[9e5, 0.0, -7e5, 0.0]]), np.eye(4)[None], 30.0
    moved = [transform(mean, cov, SPACE_2D, OSLO, BERGEN, Height(1000.0 + h))[0][0, [0, 2]] for h in (-50.0, 50.0)]
    g = sigma * (moved[1] - moved[0]) / 100.0
    spreads = [transform(mean, cov, SPACE_2D, OSLO, BERGEN, Height(1000.0, s))[1][0] for s in (sigma, 0.0)]
    added = np.zeros((4, 4))
    added[::2, ::2] = np.outer(g, g)
    np.testing.assert_allclose(spreads[0] - spreads[1], added, rtol=1e-4, atol=1e-12)
    assert added[0, 0] > 1.0


def test_without_z_velocity_is_that_of_the_moving_place() -> None:
    mean = np.array([1.2e5, 250.0, -8e4, -100.0])
    step = np.array([250.0, 0.0, -100.0, 0.0]) * 0.5
    states = np.stack([mean - step, mean, mean + step])
    moved, _ = transform(states, np.tile(np.eye(4), (3, 1, 1)), SPACE_2D, OSLO, BERGEN)
    np.testing.assert_allclose(moved[1, [1, 3]], moved[2, [0, 2]] - moved[0, [0, 2]], atol=1e-6)


def test_without_z_covariance_against_monte_carlo_with_unknown_height() -> None:
    """Draws of x, y and the height, each moved at its own height; entry-wise error as above, 5 sigma."""
    size, sigma = 3000, 400.0
    mean, cov = np.array([2e5, 200.0, 1e5, -90.0]), covariance(RNG, np.array([80.0, 5.0, 50.0, 4.0]))
    moved, spread = transform(mean, cov, SPACE_2D, OSLO, SVALBARD, Height(2000.0, sigma))
    _, without = transform(mean, cov, SPACE_2D, OSLO, SVALBARD, Height(2000.0))
    draws = mean + RNG.standard_normal((size, 4)) @ np.linalg.cholesky(cov).T
    heights = 2000.0 + sigma * RNG.standard_normal(size)
    cloud = np.stack(
        [transform(d, cov, SPACE_2D, OSLO, SVALBARD, Height(float(h)))[0] for d, h in zip(draws, heights, strict=True)]
    )
    d = np.diag(spread)
    error = np.sqrt((spread**2 + np.outer(d, d)) / size)
    assert np.all(np.abs(np.cov(cloud.T) - spread) < 5 * error), f"seed {SEED}"
    assert np.all(np.abs(cloud.mean(axis=0) - moved) < 5 * np.sqrt(d / size))
    assert spread[2, 2] - without[2, 2] > 10 * error[2, 2], "the height should matter in this example"
    np.testing.assert_array_equal(spread[1::2], without[1::2])


@pytest.mark.parametrize(("space", "source", "target"), [(SPACE_2D, OSLO, BERGEN), (SPACE_3D, BERGEN, Ecef())])
def test_there_and_back(space: tuple[str, ...], source: Frame, target: Frame) -> None:
    n = len(space)
    means = RNG.normal(size=(5, 4, n)) * 5e4
    covs = np.broadcast_to(covariance(RNG, np.full(n, 20.0)), (5, 4, n, n))
    there = transform(means, covs, space, source, target, Height(100.0))
    back = transform(*there, space, target, source, Height(100.0))
    assert back[0].shape == means.shape
    assert back[1].shape == covs.shape
    np.testing.assert_allclose(back[0], means, atol=1e-8, rtol=1e-9)
    np.testing.assert_allclose(back[1], covs, atol=1e-6)


@pytest.mark.parametrize("space", [SPACE_2D, SPACE_3D])
def test_bits_do_not_depend_on_the_batch(space: tuple[str, ...]) -> None:
    n, size = len(space), 133
    means = RNG.normal(size=(size, n)) * 1e5
    covs = np.stack([covariance(RNG, RNG.uniform(1, 50, n)) for _ in range(size)])
    moved, spread = transform(means, covs, space, OSLO, BERGEN, Height(10.0, 5.0))
    for k in (0, 1, 64, size - 1):
        one, cov = transform(means[k], covs[k], space, OSLO, BERGEN, Height(10.0, 5.0))
        np.testing.assert_array_equal(one, moved[k])
        np.testing.assert_array_equal(cov, spread[k])
    part, _ = transform(means[5:99:3], covs[5:99:3], space, OSLO, BERGEN, Height(10.0, 5.0))
    np.testing.assert_array_equal(part, moved[5:99:3])
    none, empty = transform(means[:0], covs[:0], space, OSLO, BERGEN)
    assert none.shape == (0, n)
    assert empty.shape == (0, n, n)


def test_equal_frames_return_the_arguments() -> None:
    mean, cov = np.zeros(4), np.eye(4)
    for frame in (OSLO, Local("harbour"), Ecef()):
        assert transform(mean, cov, SPACE_2D, frame, frame) == (mean, cov)


def test_a_place_over_the_horizon_is_nan_and_spoils_no_other() -> None:
    means = np.array([[1e3, 0.0, 0.0, 0.0], [1e7, 0.0, 0.0, 0.0], [1e12, 1.0, -1e12, 1.0]])
    moved, spread = transform(means, np.tile(np.eye(4), (3, 1, 1)), SPACE_2D, OSLO, BERGEN)
    assert np.isfinite(moved[0]).all()
    assert np.isnan(moved[1:]).all()
    assert np.isnan(spread[1:]).all()


def test_three_dimensional_position_with_horizontal_velocity() -> None:
    """vz counts as zero: the same as with vz = 0, and its variance 0, written out."""
    short, full = ("x", "vx", "y", "vy", "z"), ("x", "vx", "y", "vy", "z", "vz")
    mean, cov = RNG.normal(size=5) * 100, covariance(RNG, np.full(5, 3.0))
    padded = np.zeros((6, 6))
    padded[:5, :5] = cov
    got = transform(mean, cov, short, OSLO, BERGEN)
    want = transform(np.append(mean, 0.0), padded, full, OSLO, BERGEN)
    np.testing.assert_allclose(got[0], want[0][:5], rtol=1e-14)
    np.testing.assert_allclose(got[1], want[1][:5, :5], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("space", "source", "target", "says"),
    [
        (SPACE_2D, Local("a"), Local("b"), "the local frame 'a' has no known relation to the local frame 'b'"),
        (SPACE_2D, OSLO, Local("b"), "the local frame 'b' has no known relation to ENU about 59.9 10.7 30"),
        (SPACE_2D, OSLO, Ecef(), "needs z"),
        (("x", "y", "z", "vx"), Ecef(), OSLO, "all of vx vy vz or none, not vx"),
        (("x", "y", "vz"), OSLO, BERGEN, "vz cannot be moved"),
    ],
)
def test_frames_without_relation(space: tuple[str, ...], source: Frame, target: Frame, says: str) -> None:
    n = len(space)
    with pytest.raises(FrameError, match=says):
        transform(np.zeros(n), np.eye(n), space, source, target)


def test_a_degree_of_latitude() -> None:
    """One minute of latitude at 45 degrees is a nautical mile within 2 m (1852.2 m on WGS84)."""
    _, north, _ = geodetic_to_enu(45 + 1 / 120, 7.0, 0.0, Enu(45 - 1 / 120, 7.0, 0.0))
    assert math.isclose(float(north), 1852.2, abs_tol=0.1)
