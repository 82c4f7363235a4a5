"""Measurement models and the EKF and CKF update against dense solutions, Monte Carlo and rotation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import chi2

from fusion_service import motion
from schemas import Motion
from sensor_clients.filters import STATE, Position, RangeAzimuth, predict_measurement, update
from sensor_clients.filters.measurement import Floats, MeasurementModel

F1 = np.array([[1.0, 0, 2, 0], [0, 1, 0, 2], [0, 0, 1, 0], [0, 0, 0, 1]])


def own_return(
    model: MeasurementModel, means: Floats, covariances: Floats, z: Floats, cubature: bool
) -> tuple[Floats, Floats]:
    """Update each of T tracks with its own return of (2, T)."""
    prediction = predict_measurement(model, means, covariances, z, cubature)
    T = means.shape[1]
    return update(means, covariances, prediction, np.eye(T), np.zeros(T))


@pytest.mark.parametrize("cubature", [True, False])
def test_kalman_filter_is_the_dense_joint_posterior(cubature: bool) -> None:
    rng = np.random.default_rng(1)
    steps, q = 6, 0.7
    model = Position(sigma_range=2.0, sigma_cross=3.0, origin=(1e6, 1e6))
    x0, P0 = np.array([10.0, -5, 1, 2]), np.diag([25.0, 16, 4, 9]) + 1.0
    zs = rng.normal(size=(steps, 2)) * 5 + [10, 0]
    # All positions, stacked, are A x0 + noise: one dense Gaussian conditioning on all returns.
    block = q * np.array([[8 / 3, 0, 2, 0], [0, 8 / 3, 0, 2], [2, 0, 2, 0], [0, 2, 0, 2]])
    mean, P, means, joint = x0, P0, [], np.zeros((4 * steps, 4 * steps))
    for k in range(steps):
        mean, P = F1 @ mean, F1 @ P @ F1.T + block
        means.append(mean)
        cross = P
        for later in range(k, steps):
            joint[4 * later : 4 * later + 4, 4 * k : 4 * k + 4] = cross
            joint[4 * k : 4 * k + 4, 4 * later : 4 * later + 4] = cross.T
            cross = F1 @ cross
    pick = np.kron(np.eye(steps), np.eye(4)[:2])
    R = model.noise(np.zeros((2, 1)))[..., 0]
    S = pick @ joint @ pick.T + np.kron(np.eye(steps), R)
    gain = joint @ pick.T @ np.linalg.inv(S)
    dense_mean = np.concatenate(means) + gain @ (zs.ravel() - pick @ np.concatenate(means))
    dense_P = joint - gain @ pick @ joint

    x, C = x0[:, None], P0[..., None]
    for z in zs:
        x, C = motion.predict(Motion("cv", q), STATE, x, C, np.array([2.0]))
        x, C = own_return(model, x, C, z[:, None], cubature)
    # The noise turns a little with the place; the far origin makes that 1e-5.
    np.testing.assert_allclose(x[:, 0], dense_mean[-4:], atol=1e-3)
    np.testing.assert_allclose(C[..., 0], dense_P[-4:, -4:], atol=1e-3)


def test_place_of_a_range_and_azimuth_has_the_moments_of_monte_carlo() -> None:
    rng = np.random.default_rng(2)
    model = RangeAzimuth(sigma_range=100.0, sigma_azimuth=0.2)
    r, theta = 5e3, 2.5
    draws = np.stack([r - 100.0 * rng.normal(size=400_000), theta - 0.2 * rng.normal(size=400_000)])
    places = np.stack([draws[0] * np.cos(draws[1]), draws[0] * np.sin(draws[1])])
    mean, covariance = model.locate(np.array([[r], [theta]]))
    np.testing.assert_allclose(mean[:, 0], places.mean(axis=1), atol=5 * 1e3 / math.sqrt(400_000))
    np.testing.assert_allclose(covariance[..., 0], np.cov(places), atol=0.01 * 1e6)


def test_cubature_meets_monte_carlo_where_linearisation_does_not() -> None:
    rng = np.random.default_rng(3)
    model = RangeAzimuth(sigma_range=10.0, sigma_azimuth=1e-3)
    mean, P = np.array([3e3, 4e3, 0.0, 0.0]), np.diag([2.5e5, 2.5e5, 1.0, 1.0])
    draws = rng.multivariate_normal(mean, P, size=400_000).T
    seen = model.observe(draws[:2])
    nothing = np.zeros((2, 0))
    ckf = predict_measurement(model, mean[:, None], P[..., None], nothing)
    ekf = predict_measurement(model, mean[:, None], P[..., None], nothing, cubature=False)
    # E[r] = 5000 + 500^2 / (2 * 5000) + ...: the linearised mean misses 25 m, Monte Carlo errs by 0.8 m.
    assert abs(seen[0].mean() - ckf.mean[0, 0]) < 5
    assert abs(seen[0].mean() - ekf.mean[0, 0]) > 20
    expected = np.cov(seen) + np.diag([100.0, 1e-6])
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(ckf.covariance[..., 0] / scale, expected / scale, atol=0.04)


def test_jacobian_is_the_difference_quotient() -> None:
    model = RangeAzimuth(1.0, 1.0)
    place = np.array([[3e3, -2e3], [4e3, 5e3]])
    step = 1e-2
    for axis in range(2):
        shift = np.zeros((2, 1))
        shift[axis] = step
        slope = (model.observe(place + shift) - model.observe(place - shift)) / (2 * step)
        np.testing.assert_allclose(model.jacobian(place)[:, axis], slope, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("cubature", [True, False])
def test_update_turns_with_the_sensor(cubature: bool) -> None:
    """Turning track and return about the sensor turns the result: across azimuth = pi too."""
    model = RangeAzimuth(50.0, 0.01)
    mean, P = np.array([1e4, 10.0, 30.0, -20.0]), np.diag([9e4, 4e4, 100.0, 400.0]) + 50.0
    z = np.array([1.01e4, 0.004])
    x, C = own_return(model, mean[:, None], P[..., None], z[:, None], cubature)
    for angle in (0.7, math.pi - 1e-3, math.pi, -2.0):
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        T = np.zeros((4, 4))
        T[:2, :2] = T[2:, 2:] = turn
        wrapped = (z[1] + angle + math.pi) % (2 * math.pi) - math.pi
        turned = np.array([[z[0]], [wrapped]])
        y, D = own_return(model, (T @ mean)[:, None], (T @ P @ T.T)[..., None], turned, cubature)
        # Cubature points sit on the axes of a factorisation, so they turn only approximately.
        np.testing.assert_allclose(y[:, 0], T @ x[:, 0], rtol=1e-9, atol=0.1 if cubature else 1e-6)
        np.testing.assert_allclose(D[..., 0], T @ C[..., 0] @ T.T, rtol=1e-9, atol=20.0 if cubature else 1e-6)


def test_noise_of_a_position_lies_along_and_across_the_line_of_sight() -> None:
    model = Position(sigma_range=2.0, sigma_cross=3.0, sigma_azimuth=0.01, origin=(100.0, 200.0))
    place = np.array([[100.0 + 300, 100.0 + 400], [200.0 + 400, 200.0 - 300]])
    R = model.noise(place)
    for k in range(2):
        sight = (place[:, k] - model.origin) / 500
        across = np.array([-sight[1], sight[0]])
        np.testing.assert_allclose(sight @ R[..., k] @ sight, 4.0)
        np.testing.assert_allclose(across @ R[..., k] @ across, 9.0 + 25.0)
        np.testing.assert_allclose(across @ R[..., k] @ sight, 0.0, atol=1e-9)


def test_ckf_is_consistent_at_long_range() -> None:
    """NEES over 400 targets drawn from the model itself, 30 scans at 150-300 km, inside its 99.9 % bounds."""
    rng = np.random.default_rng(4)
    B, q, dt = 400, 1.0, 5.0
    model = RangeAzimuth(100.0, 3e-3)
    r, theta = rng.uniform(150e3, 300e3, B), rng.uniform(-math.pi, math.pi, B)
    truth = np.stack([r * np.cos(theta), r * np.sin(theta), *(120 * rng.normal(size=(2, B)))])

    def observe() -> Floats:
        noise = rng.normal(size=(2, B)) * [[100.0], [3e-3]]
        z = model.observe(truth[:2]) + noise
        z[1] = (z[1] + math.pi) % (2 * math.pi) - math.pi
        return z

    place, spread = model.locate(observe())
    x = np.concatenate([place, np.zeros((2, B))])
    P = np.zeros((4, 4, B))
    P[:2, :2], P[2, 2], P[3, 3] = spread, 120.0**2, 120.0**2
    root = np.linalg.cholesky(q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]))
    low, high = chi2.ppf([0.0005, 0.9995], 4 * B) / B
    for scan in range(30):
        noise = np.einsum("ij,jkb->ikb", root, rng.normal(size=(2, 2, B)))
        truth[:2] += dt * truth[2:] + noise[0]
        truth[2:] += noise[1]
        x, P = motion.predict(Motion("cv", q), STATE, x, P, np.full(B, dt))
        x, P = own_return(model, x, P, observe(), cubature=True)
        error = x - truth
        nees = np.einsum("ib,bij,jb->b", error, np.linalg.inv(P.transpose(2, 0, 1)), error).mean()
        assert low < nees < high, f"scan {scan}: {nees}"
