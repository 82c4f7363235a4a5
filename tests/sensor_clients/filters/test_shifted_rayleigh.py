"""The shifted Rayleigh filter against quadrature and grid posteriors."""

from __future__ import annotations

import numpy as np
import pytest

from sensor_clients.filters import kalman
from sensor_clients.filters.kalman import Estimate
from sensor_clients.filters.shifted_rayleigh import FAR, shifted_rayleigh, update
from studies.study import Floats


@pytest.mark.parametrize("z", [-60.0, FAR - 0.01, FAR + 0.01, -8.0, -1.0, 0.0, 0.5, 3.0, 30.0, 300.0])
def test_moments_are_those_of_the_density(z: float) -> None:
    reach = 12.0 if z > -3 else 40.0 / abs(z)
    t = np.linspace(max(0.0, z - 12.0), max(z, 0.0) + reach, 400_001)
    top = 0.5 * (z + np.sqrt(z * z + 4))  # where log t - (t - z)^2 / 2 is largest
    density = t * np.exp(0.5 * ((top - z) ** 2 - (t - z) ** 2))
    mass, first, second = (np.trapezoid(density * (t - top) ** k, t) for k in range(3))
    mean, variance = shifted_rayleigh(np.array([z]))
    assert mean[0] == pytest.approx(top + first / mass, rel=1e-6)
    assert variance[0] == pytest.approx(second / mass - (first / mass) ** 2, rel=1e-4)


PRIORS = [
    ((800.0, 500.0), ((300.0**2, 0.4 * 300 * 200), (0.4 * 300 * 200, 200.0**2))),
    ((200.0, -100.0), ((300.0**2, 0.0), (0.0, 250.0**2))),  # the sensor is well inside
]


def grid(mean: Floats, P: Floats, around: float = 6.0) -> tuple[Floats, Floats]:
    """Places (2, G) and the prior's density on them, not normalised."""
    axes = [np.linspace(m - around * s, m + around * s, 601) for m, s in zip(mean, np.sqrt(np.diag(P)), strict=True)]
    x = np.stack([one.ravel() for one in np.meshgrid(*axes)])
    d = x - mean[:, None]
    return x, np.exp(-0.5 * np.einsum("ig,ij,jg->g", d, np.linalg.inv(P), d))


def moments(x: Floats, weight: Floats) -> tuple[Floats, Floats]:
    w = weight / weight.sum()
    mean = x @ w
    d = x - mean[:, None]
    return mean, (d * w) @ d.T


@pytest.mark.parametrize(("mean", "P"), PRIORS)
@pytest.mark.parametrize("bearing", [0.9, -2.0])
def test_one_bearing_gives_the_exact_moments_of_its_model(mean: Floats, P: Floats, bearing: float) -> None:
    """The likelihood of a direction, the integral over the range rho of rho N(rho b; p, s^2 I), s^2 = sigma^2 E|p|^2,
    done in closed form along b, and the posterior on a grid of places; also for a bearing the prior does not expect."""
    mean, P, sigma = np.array(mean), np.array(P), 0.2
    x, prior = grid(mean, P)
    s = sigma * np.sqrt(mean @ mean + np.trace(P))
    b = np.array([np.sin(bearing), np.cos(bearing)])
    along, across = (b @ x) / s, (b[0] * x[1] - b[1] * x[0]) / s
    rho = np.linspace(0.0, 12.0, 2001)
    table = np.linspace(-12.0, along.max() + 1, 3000)
    mass = np.array([np.trapezoid((r := np.maximum(t, 0) + rho) * np.exp(-0.5 * (r - t) ** 2), r) for t in table])
    mass += np.array(
        [np.trapezoid((r := t * rho / 12.0) * np.exp(-0.5 * (r - t) ** 2), r) if t > 0 else 0 for t in table]
    )
    likelihood = np.interp(along, table, mass) * np.exp(-0.5 * across**2)
    exact_mean, exact_P = moments(x, prior * likelihood)
    ours = update(Estimate(mean[:, None], P[..., None]), np.zeros((2, 1, 1)), np.array([[bearing]]), sigma)
    spread = np.sqrt(np.diag(exact_P))
    np.testing.assert_allclose(ours.mean[:, 0] / spread, exact_mean / spread, atol=2e-3)
    np.testing.assert_allclose(ours.covariance[..., 0], exact_P, atol=4e-3 * spread.max() ** 2)


def test_two_bearings_are_near_the_exact_posterior_of_normal_errors() -> None:
    """Two sensors 4 and 5 km away, 2 deg, a prior of 300 m: the mean within a quarter of the exact posterior's
    spread, the spread within 20 % each time (the noise across is that at the range the prior expects), and on average
    within 0.05 and 3 %."""
    rng = np.random.default_rng(4)
    sigma, mean, P = np.radians(2.0), np.zeros(2), np.diag([300.0**2, 250.0**2])
    sensors = np.array([[-4000.0, 500.0], [-300.0, 5000.0]])  # (2, d)
    x, prior = grid(mean, P)
    ratios, away = [], []
    for _ in range(40):
        place = rng.normal(size=2) * np.sqrt(np.diag(P))
        z = np.arctan2(*(place[:, None] - sensors)) + sigma * rng.normal(size=2)
        off = (z[:, None] - np.arctan2(*(x[:, None] - sensors[..., None])) + np.pi) % (2 * np.pi) - np.pi
        exact_mean, exact_P = moments(x, prior * np.exp(-0.5 * (off**2).sum(axis=0) / sigma**2))
        ours = update(Estimate(mean[:, None], P[..., None]), sensors[..., None], z[:, None], sigma)
        spread = np.sqrt(np.diag(exact_P))
        away.append((ours.mean[:, 0] - exact_mean) / spread)
        ratios.append(np.sqrt(np.diag(ours.covariance[..., 0])) / spread)
    assert np.abs(away).max() < 0.25
    assert np.abs(np.mean(away, axis=0)).max() < 0.05
    np.testing.assert_allclose(ratios, 1.0, atol=0.2)
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1.0, atol=0.03)


def test_far_away_it_is_the_linear_update_and_the_rest_of_the_state_follows() -> None:
    rng = np.random.default_rng(5)
    A = rng.normal(size=(4, 4))
    P = (A @ A.T) * np.outer([10, 10, 1, 1], [10, 10, 1, 1])
    x, sensor, sigma = np.array([20.0, -30.0, 3.0, 1.0]), np.array([-60e3, -80e3]), 1e-3
    d = x[:2] - sensor
    z = np.arctan2(*d) + 5e-4
    H = np.array([[d[1], -d[0], 0, 0]]) / (d @ d)
    state = Estimate(x[:, None], P[..., None])
    linear = kalman.update(state, H, np.array([[sigma**2]]), np.array([[5e-4 + (H @ x)[0]]]))
    ours = update(state, sensor[:, None, None], np.array([[z]]), sigma)
    spread = np.sqrt(np.diag(P))
    np.testing.assert_allclose(ours.mean[:, 0] / spread, linear.mean[:, 0] / spread, atol=2e-3)
    np.testing.assert_allclose(
        ours.covariance[..., 0] / np.outer(spread, spread),
        linear.covariance[..., 0] / np.outer(spread, spread),
        atol=2e-3,
    )
    follow = P[2:, :2] @ np.linalg.inv(P[:2, :2])  # the velocity is known from the place alone, as before
    np.testing.assert_allclose(ours.mean[2:, 0] - x[2:], follow @ (ours.mean[:2, 0] - x[:2]), rtol=1e-7, atol=1e-9)


def test_an_element_does_not_depend_on_its_batch_and_a_whole_turn_changes_nothing() -> None:
    rng = np.random.default_rng(6)
    A = rng.normal(size=(3, 3, 50))
    state = Estimate(rng.normal(size=(3, 50)), np.einsum("ikb,jkb->ijb", A, A))
    sensors, bearings = 5 * rng.normal(size=(2, 3, 50)), rng.uniform(-3, 3, size=(3, 50))
    whole = update(state, sensors, bearings, 0.1)
    part = update(
        Estimate(state.mean[:, 7:9], state.covariance[..., 7:9]), sensors[..., 7:9], bearings[:, 7:9] + 2 * np.pi, 0.1
    )
    np.testing.assert_allclose(part.mean, whole.mean[:, 7:9], rtol=1e-9, atol=1e-12)
    assert np.all(np.linalg.eigvalsh(np.moveaxis(whole.covariance, -1, 0)) > 0)
    assert np.all(np.linalg.eigvalsh(np.moveaxis(state.covariance - whole.covariance, -1, 0)) > -1.0)
