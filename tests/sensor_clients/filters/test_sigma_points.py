"""Sigma-point rules against exact Gaussian moments to their degree; the filters built on them against the Kalman
filter, quadrature, and Stone Soup's CKF where it is installed."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from datetime import datetime, timedelta
from functools import partial
from typing import Any

import numpy as np
import pytest

from sensor_clients.filters import kalman, sigma_points
from sensor_clients.filters.kalman import Estimate
from sensor_clients.filters.measurement import Floats
from sensor_clients.filters.sigma_points import Rule

RULES: list[tuple[str, Callable[[int], Rule], int]] = [
    ("CKF", sigma_points.cubature, 3),
    ("UKF", sigma_points.unscented, 3),
    ("UKF kappa 1", partial(sigma_points.unscented, kappa=1.0), 3),
    ("GHF 2", partial(sigma_points.gauss_hermite, order=2), 3),
    ("GHF 3", partial(sigma_points.gauss_hermite, order=3), 5),
    ("GHF 5", partial(sigma_points.gauss_hermite, order=5), 9),
    ("CQKF 1", partial(sigma_points.cubature_quadrature, order=1), 3),
    ("CQKF 2", sigma_points.cubature_quadrature, 3),
    ("CQKF 3", partial(sigma_points.cubature_quadrature, order=3), 3),
]
IDS = [name for name, _, _ in RULES]


def apply(A: np.ndarray[Any, Any], x: Floats) -> Floats:
    """The linear map A (m, n) of points (n, s, B)."""
    return np.asarray(np.einsum("ij,jsb->isb", A, x))


def spd(rng: np.random.Generator, n: int, *batch: int) -> Floats:
    A = rng.standard_normal((n, n, *batch))
    return np.asarray(np.einsum("ik...,jk...->ij...", A, A) + 0.5 * np.eye(n).reshape(n, n, *(1,) * len(batch)))


def moment(powers: tuple[int, ...]) -> float:
    """E prod xi_i^p_i of N(0, I): the product of (p - 1)!! over even p."""
    out = 1.0
    for p in powers:
        out *= 0.0 if p % 2 else float(np.prod(np.arange(p - 1, 0, -2)))
    return out


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize(("name", "make", "degree"), RULES, ids=IDS)
def test_polynomials_to_the_degree_of_a_rule_are_exact(
    name: str, make: Callable[[int], Rule], degree: int, n: int
) -> None:
    rule = make(n)
    assert rule.weights.sum() == pytest.approx(1.0, abs=1e-12)
    for powers in itertools.product(range(degree + 1), repeat=n):
        if sum(powers) <= degree:
            got = rule.weights @ np.prod(rule.points ** np.array(powers)[:, None], axis=0)
            assert got == pytest.approx(moment(powers), abs=1e-9), powers


@pytest.mark.parametrize(("order", "n"), [(1, 3), (2, 3), (3, 5)])
def test_the_radial_rule_of_the_cqkf(order: int, n: int) -> None:
    """Gauss-Laguerre of m points is exact for |xi|^2k to k = 2m - 1: E |xi|^2k = n (n + 2) ... (n + 2k - 2); the next
    one is not, so the bound is sharp."""
    rule = sigma_points.cubature_quadrature(n, order)
    square = (rule.points**2).sum(axis=0)
    exact = [float(np.prod(n + 2 * np.arange(k))) for k in range(2 * order + 1)]
    got = [float(rule.weights @ square**k) for k in range(2 * order + 1)]
    assert got[:-1] == pytest.approx(exact[:-1], rel=1e-10)
    assert got[-1] < 0.99 * exact[-1]


def test_the_ukf_with_kappa_3_minus_n_has_the_fourth_moments_of_each_axis() -> None:
    for n in (1, 2, 5):
        rule = sigma_points.unscented(n)
        assert rule.weights @ rule.points[0] ** 4 == pytest.approx(3.0)


@pytest.mark.parametrize(("name", "make", "degree"), RULES, ids=IDS)
def test_linear_models_give_the_kalman_filter(name: str, make: Callable[[int], Rule], degree: int) -> None:
    """Over several steps with process noise: points that are not drawn anew would miss Q in the update."""
    rng = np.random.default_rng(5)
    n, d, B = 4, 2, 3
    F, H, Q, R = rng.standard_normal((n, n)), rng.standard_normal((d, n)), spd(rng, n), spd(rng, d)
    one = other = Estimate(rng.standard_normal((n, B)), spd(rng, n, B))
    rule = make(n)
    for _ in range(5):
        z = rng.standard_normal((d, B))
        one = kalman.update(kalman.predict(one, F, Q), H, R, z)
        other = sigma_points.predict(rule, lambda x: apply(F, x), other, Q)
        other = sigma_points.update(rule, lambda x: apply(H, x), other, R, z)
    np.testing.assert_allclose(other.mean, one.mean, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(("name", "make", "degree"), RULES, ids=IDS)
def test_shift_and_scale_of_each_component_change_nothing_else(
    name: str, make: Callable[[int], Rule], degree: int
) -> None:
    """y = T x + c with T lower triangular of positive diagonal, which the Cholesky factor, and so every point, follows
    (the rules are not symmetric under rotation, so no more than that can hold)."""
    rng = np.random.default_rng(6)
    n, B = 3, 4
    T = np.tril(rng.standard_normal((n, n)), -1) + np.diag(rng.uniform(0.5, 2.0, n))
    c, back = rng.standard_normal((n, 1, 1)), np.linalg.inv(T)
    Q, R, z = spd(rng, n), spd(rng, 2), rng.standard_normal((2, B))
    state = Estimate(rng.standard_normal((n, B)), spd(rng, n, B))
    there = Estimate(T @ state.mean + c[:, 0], np.einsum("ik,klb,jl->ijb", T, state.covariance, T))

    def f(x: Floats) -> Floats:
        return np.stack([x[0] + np.sin(x[1]), x[1] * x[2], x[2] - 0.1 * x[0] ** 2])

    def h(x: Floats) -> Floats:
        return np.stack([x[0] * x[1], np.cos(x[2])])

    rule = make(n)
    x = sigma_points.update(rule, h, sigma_points.predict(rule, f, state, Q), R, z)
    y = sigma_points.predict(rule, lambda y: apply(T, f(apply(back, y - c))) + c, there, T @ Q @ T.T)
    y = sigma_points.update(rule, lambda y: h(apply(back, y - c)), y, R, z)
    np.testing.assert_allclose(y.mean, T @ x.mean + c[:, 0], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(y.covariance, np.einsum("ik,klb,jl->ijb", T, x.covariance, T), rtol=1e-8, atol=1e-8)


def test_many_gauss_hermite_points_give_the_exact_linear_update() -> None:
    """The moments of a range from a 2-D Gaussian by a fine grid, and the update they make."""
    mean, P, R, z = np.array([3.0, 1.0]), np.array([[0.8, 0.3], [0.3, 0.5]]), 0.2, 3.6
    axis = np.linspace(-7, 7, 1401)
    xi = np.stack(np.meshgrid(axis, axis, indexing="ij")).reshape(2, -1)
    w = np.exp(-0.5 * (xi**2).sum(axis=0))
    w /= w.sum()
    x = mean[:, None] + np.linalg.cholesky(P) @ xi
    r = np.hypot(*x)
    zhat = w @ r
    S = w @ (r - zhat) ** 2 + R
    cross = (x - mean[:, None]) * w @ (r - zhat)
    state = Estimate(mean[:, None], P[..., None])
    got = sigma_points.update(
        sigma_points.gauss_hermite(2, 30), lambda x: np.hypot(x[0], x[1])[None], state, np.eye(1) * R, np.array([[z]])
    )
    np.testing.assert_allclose(got.mean[:, 0], mean + cross / S * (z - zhat), atol=1e-5)
    np.testing.assert_allclose(got.covariance[..., 0], P - np.outer(cross, cross) / S, atol=1e-5)


def test_bearings_wrap() -> None:
    """A target behind the cut of the bearing is updated as the same one turned by half a turn."""

    def h(x: Floats) -> Floats:
        return np.asarray(np.arctan2(x[1], x[0])[None])

    def wrap(a: Floats, b: Floats) -> Floats:
        return np.asarray((a - b + np.pi) % (2 * np.pi) - np.pi)

    rule, P, R = sigma_points.cubature(2), np.diag([0.5, 0.4])[..., None], np.eye(1) * 0.01
    ahead = Estimate(np.array([[5.0], [0.1]]), P)
    behind = Estimate(-ahead.mean, P)
    one = sigma_points.update(rule, h, ahead, R, np.array([[-0.05]]), wrap)
    other = sigma_points.update(rule, h, behind, R, np.array([[np.pi - 0.05]]), wrap)
    np.testing.assert_allclose(other.mean, -one.mean, atol=1e-12)
    np.testing.assert_allclose(other.covariance, one.covariance, atol=1e-12)


def test_the_ckf_is_that_of_stone_soup() -> None:
    """Of two ranges: bearings Stone Soup averages on the circle, which differs in the third order of their spread."""
    pytest.importorskip("stonesoup")
    from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import CubatureKalmanPredictor
    from stonesoup.types.array import StateVector
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import CubatureKalmanUpdater

    def ranges(x: Floats) -> Floats:
        return np.stack([np.hypot(x[0], x[2]), np.hypot(x[0] - 100.0, x[2])])

    class Ranges(NonLinearGaussianMeasurement):  # type: ignore[misc, unused-ignore]
        ndim_meas = 2

        def function(self, state: Any, noise: Any = False, **kwargs: Any) -> Any:
            return StateVector(ranges(np.asarray(state.state_vector, float)[:, 0]))

    q, R = 0.3, np.diag([5.0**2, 8.0**2])
    motion = CombinedLinearGaussianTransitionModel([ConstantVelocity(q), ConstantVelocity(q)])
    sensor = Ranges(ndim_state=4, mapping=(0, 2), noise_covar=R)
    mean, P = np.array([200.0, 3, 150, -2]), np.diag([400.0, 4, 300, 9])
    F = np.kron(np.eye(2), [[1.0, 1], [0, 1]])
    Q: Floats = np.asarray(q * np.kron(np.eye(2), [[1 / 3, 1 / 2], [1 / 2, 1]]), dtype=np.float64)
    begin = datetime(2024, 1, 1)
    theirs, ours = GaussianState(mean[:, None], P, begin), Estimate(mean[:, None], P[..., None])
    rule = sigma_points.cubature(4)
    rng = np.random.default_rng(8)
    for k in range(1, 6):
        z = ranges(mean[:, None]) + np.sqrt(np.diag(R))[:, None] * rng.standard_normal((2, 1))
        predicted = CubatureKalmanPredictor(motion).predict(theirs, timestamp=begin + timedelta(seconds=k))
        seen = Detection(z, timestamp=begin + timedelta(seconds=k), measurement_model=sensor)
        theirs = CubatureKalmanUpdater(sensor).update(SingleHypothesis(predicted, seen))
        ours = sigma_points.predict(rule, lambda x: apply(F, x), ours, Q)
        ours = sigma_points.update(rule, ranges, ours, R, z)
        np.testing.assert_allclose(ours.mean[:, 0], np.asarray(theirs.state_vector, float)[:, 0], rtol=1e-9)
        np.testing.assert_allclose(ours.covariance[..., 0], np.asarray(theirs.covar, float), rtol=1e-7, atol=1e-9)
