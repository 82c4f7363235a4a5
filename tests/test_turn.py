"""A turn is about the vertical at the place of the track, in every frame: against aircraft flown over the ellipsoid."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fusion_service.arrays import Floats
from fusion_service.geodesy import ecef_to_geodetic, geodetic_to_ecef, transform
from fusion_service.motion import predict, transition
from schemas import Ecef, Enu, Frame, Local, Motion

SPACE = ("x", "turn_rate", "y", "z", "vx", "vy", "vz")
TURN = Motion("ct", 0.0)
A, E2, RADIUS = 6378137.0, 0.0066943799901413165, 6.37e6


def flown(lat: float, lon: float, alt: float, speed: float, course: float, rate: float, seconds: float) -> Floats:
    """Latitude, longitude (deg), altitude and course (rad from north) of an aircraft that keeps its height and its
    rate of turn (rad/s, anticlockwise, against the geodesic straight on)."""

    def slope(_: float, s: Floats) -> list[float]:
        phi, _lam, psi = s
        root = np.sqrt(1 - E2 * np.sin(phi) ** 2)
        meridian, normal = A * (1 - E2) / root**3 + alt, A / root + alt
        east = speed * np.sin(psi) / normal
        return [speed * np.cos(psi) / meridian, east / np.cos(phi), east * np.tan(phi) - rate]

    start = [np.radians(lat), np.radians(lon), course]
    phi, lam, psi = solve_ivp(slope, (0.0, seconds), start, rtol=1e-12, atol=1e-14).y[:, -1]
    return np.array([np.degrees(phi), np.degrees(lam), alt, psi])


def state(lat: float, lon: float, alt: float, speed: float, course: float, rate: float, frame: Frame) -> Floats:
    """It in `frame`, (n, 1)."""
    here = {"vx": speed * np.sin(course), "vy": speed * np.cos(course), "turn_rate": rate}
    local = np.array([[here.get(name, 0.0) for name in SPACE]])
    return transform(local, np.eye(7)[None], SPACE, Enu(lat, lon, alt), frame)[0].T


FLIGHTS = [
    (59.0, -55.0, 10_000.0, 250.0, 0.7, np.radians(3.0), 60.0),
    (-33.0, 151.0, 3_000.0, 120.0, 2.9, -np.radians(3.0), 120.0),
    (0.5, 100.0, 11_000.0, 240.0, 4.0, np.radians(1.0), 60.0),
    (78.0, 15.0, 8_000.0, 200.0, 1.6, -np.radians(1.5), 90.0),
]


@pytest.mark.parametrize("flight", FLIGHTS)
def test_an_aircraft_that_turns_at_constant_height_in_ecef(flight: tuple[float, ...]) -> None:
    """Off by what the tangent plane leaves the ground, and no more: d^2 / 2R, d the greatest distance flown from it."""
    lat, lon, alt, speed, course, rate, seconds = flight
    x = state(lat, lon, alt, speed, course, rate, Ecef())
    got, _ = predict(TURN, SPACE, x, np.eye(7)[:, :, None], np.array([seconds]), Ecef())
    want = flown(*flight)
    place = got[[SPACE.index(name) for name in "xyz"], 0]
    reach = min(speed * seconds, 2 * speed / abs(rate))
    bound = reach**2 / (2 * RADIUS) + 1.0
    height = float(ecef_to_geodetic(*place)[2]) - alt
    error = float(np.linalg.norm(place - np.array(geodetic_to_ecef(*want[:3]))))
    flat = predict(TURN, SPACE, x, np.eye(7)[:, :, None], np.array([seconds]))[0][:, 0]
    wrong = float(ecef_to_geodetic(*flat[[SPACE.index(name) for name in "xyz"]])[2]) - alt
    print(f"{flight}: height {height:+.1f} m, error {error:.1f} m, bound {bound:.1f} m; about z {wrong:+.0f} m")
    assert abs(height) < bound
    assert error < 2 * bound
    assert abs(wrong) > 10 * bound, "the test would see a turn about another axis"
    velocity = got[[SPACE.index(name) for name in ("vx", "vy", "vz")], 0]
    there = state(want[0], want[1], alt, speed, want[3], rate, Ecef())
    np.testing.assert_allclose(velocity, there[4:, 0], atol=2 * speed * reach / RADIUS + 0.01)


def test_it_is_the_same_turn_in_every_frame() -> None:
    """Moved and then predicted as predicted and then moved: mean and covariance, in ECEF and in ENU near and far."""
    rng = np.random.default_rng(20250913)
    x = state(59.0, -55.0, 9_000.0, 230.0, 1.1, 0.04, Ecef())
    root = rng.normal(size=(7, 7))
    P = root @ root.T + np.eye(7)
    dt, motion = np.array([45.0]), Motion("ct", 0.6, 1e-4)
    want, spread = predict(motion, SPACE, x, P[..., None], dt, Ecef())
    for frame in (Enu(59.0, -55.0), Enu(57.0, -51.0, 30.0), Enu(-20.0, 30.0)):
        moved, cov = transform(x.T, P[None], SPACE, Ecef(), frame)
        got, got_cov = predict(motion, SPACE, moved.T, np.moveaxis(cov, 0, -1), dt, frame)
        back, back_cov = transform(got.T, np.moveaxis(got_cov, -1, 0), SPACE, frame, Ecef())
        np.testing.assert_allclose(back.T, want, atol=1e-6, rtol=0)
        np.testing.assert_allclose(back_cov[0], spread[..., 0], rtol=1e-8, atol=1e-8 * np.abs(spread).max())


def test_jacobian_against_finite_differences() -> None:
    """All but the turn of the vertical from place to place, of which the page says that it is left out."""
    x = state(59.0, -55.0, 9_000.0, 230.0, 1.1, 0.04, Ecef())
    dt, zero = np.array([30.0]), np.zeros((7, 7, 1))
    F, Q = transition(TURN, SPACE, x, dt, Ecef())
    assert not Q.any()
    for j, name in enumerate(SPACE):
        step = 1e-5 if name == "turn_rate" else 1e-2
        h = np.zeros((7, 1))
        h[j] = step
        ends = [predict(TURN, SPACE, x + k * h, zero, dt, Ecef())[0] for k in (-1, 1)]
        column = ((ends[1] - ends[0]) / (2 * step))[:, 0]
        np.testing.assert_allclose(F[:, j, 0], column, rtol=1e-5, atol=230.0 * 30.0 / RADIUS * 1.5)


def test_where_there_is_no_vertical_it_is_the_plane() -> None:
    """Without a frame, in a local one, and in a space without height, the turn is in x and y."""
    plane = ("x", "y", "vx", "vy", "turn_rate")
    x, dt = np.array([[1.0], [2.0], [30.0], [40.0], [0.1]]), np.array([5.0])
    want = transition(TURN, plane, x, dt)[0]
    for frame in (Local("dock"), Enu(59.0, -55.0)):
        np.testing.assert_array_equal(transition(TURN, plane, x, dt, frame)[0], want)
    assert want[2, 4, 0] != 0
    cv = transition(Motion("cv", 0.0), plane, x, dt)[0]
    np.testing.assert_array_equal(transition(TURN, plane, x, dt, Ecef())[0], cv)


def test_bits_and_the_centre_of_the_earth() -> None:
    rng = np.random.default_rng(3)
    flights = [state(lat, lon, 100.0, 200.0, 1.0, rate, Ecef()) for lat, lon, rate in rng.uniform(-0.9, 0.9, (40, 3))]
    x = np.concatenate([*flights, np.zeros((7, 1))], axis=1)
    P, dt = np.repeat(np.eye(7)[:, :, None], 41, axis=2), rng.uniform(0, 60, 41)
    means, covariances = predict(TURN, SPACE, x, P, dt, Ecef())
    for part in (slice(0, 1), slice(5, 9), slice(1, 40, 3)):
        few = predict(TURN, SPACE, x[:, part], P[:, :, part], dt[part], Ecef())
        assert few[0].tobytes() == means[:, part].tobytes()
        assert few[1].tobytes() == covariances[:, :, part].tobytes()
    assert np.isfinite(means[:, :40]).all()
    assert np.isnan(means[:, 40]).any()
