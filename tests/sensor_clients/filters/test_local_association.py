"""Association probabilities against enumeration of the joint events; the PDA update against the mixture itself."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from fusion_service import linalg
from sensor_clients.filters import Position, RangeAzimuth, associate, likelihood, predict_measurement, update
from sensor_clients.filters.measurement import Floats


def enumerate_events(
    densities: Floats, existence: Floats, detection: Floats, intensity: Floats
) -> tuple[Floats, Floats, Floats]:
    """Existence (T,), joint P(return j is of track i) (T, M), P(return of no track) (M,): all events summed.

    A track does not exist (1-r), exists unseen r(1-p), or made return j, r p l_ij / lambda_j; no return twice."""
    T, M = densities.shape
    exists, taken, unused, total = np.zeros(T), np.zeros((T, M)), np.zeros(M), 0.0
    for choice in itertools.product(range(-2, M), repeat=T):
        used = [j for j in choice if j >= 0]
        if len(set(used)) < len(used):
            continue
        weight = 1.0
        for i, j in enumerate(choice):
            if j == -2:
                weight *= 1 - existence[i]
            elif j == -1:
                weight *= existence[i] * (1 - detection[i])
            else:
                weight *= existence[i] * detection[i] * densities[i, j] / intensity[j]
        total += weight
        for i, j in enumerate(choice):
            exists[i] += weight * (j > -2)
            if j >= 0:
                taken[i, j] += weight
        unused += weight * np.array([j not in used for j in range(M)])
    return exists / total, taken / total, unused / total


@pytest.mark.parametrize(
    "pattern",
    [
        [[1, 1, 1]],
        [[1], [1], [1]],
        [[1, 1, 0], [0, 1, 1]],
        [[1, 0, 0], [1, 1, 0], [0, 1, 1]],
        [[1, 1], [0, 0]],
    ],
    ids=["one-track", "one-return", "shared", "chain", "unseen"],
)
@pytest.mark.parametrize("seed", range(3))
def test_marginals_are_exact_on_trees(pattern: list[list[int]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    gated = np.array(pattern, dtype=float)
    T, M = gated.shape
    densities = gated * rng.uniform(0.01, 2.0, size=gated.shape)
    existence, detection = rng.uniform(0.05, 1.0, size=(T,)), rng.uniform(0.1, 0.99, size=(T,))
    intensity = rng.uniform(0.01, 0.5, size=(M,))
    found = associate(densities, existence, detection, intensity, tolerance=1e-12)
    exists, taken, unused = enumerate_events(densities, existence, detection, intensity)
    np.testing.assert_allclose(found.existence, exists, atol=1e-9)
    np.testing.assert_allclose(found.weights * found.existence[:, None], taken, atol=1e-9)
    np.testing.assert_allclose(found.unused, unused, atol=1e-9)
    np.testing.assert_allclose(found.weights.sum(axis=1) + found.missed, 1.0, atol=1e-9)


def test_marginals_are_close_where_all_compete() -> None:
    rng = np.random.default_rng(7)
    worst = 0.0
    for _ in range(50):
        densities = rng.uniform(0.01, 2.0, (3, 3))
        existence = rng.uniform(0.3, 1.0, size=(3,))
        detection = rng.uniform(0.3, 1.0, size=(3,))
        intensity = rng.uniform(0.05, 0.5, size=(3,))
        found = associate(densities, existence, detection, intensity)
        exists, taken, _ = enumerate_events(densities, existence, detection, intensity)
        worst = max(
            worst,
            np.abs(found.existence - exists).max(),
            np.abs(found.weights * found.existence[:, None] - taken).max(),
        )
    # Loopy belief propagation is approximate here (Williams and Lau 2014, fig. 5: errors of a few hundredths).
    assert worst < 0.1


def test_existence_is_calibrated() -> None:
    """Targets that exist with probability .4, seen with .7 among Poisson clutter: the mean posterior existence
    given what was seen equals the share that exists, for all and for the high and low ones apart."""
    rng = np.random.default_rng(11)
    runs, r, p, side, clutter = 6_000, 0.4, 0.7, 10.0, 2.0
    model = Position(1.0, 1.0)
    truth, claimed = rng.random(runs) < r, np.empty(runs)
    for run in range(runs):
        places = [rng.uniform(-side / 2, side / 2, (2, rng.poisson(clutter)))]
        if truth[run] and rng.random() < p:
            places.append(rng.normal(size=(2, 1)) * math.sqrt(2.0))
        z = np.concatenate(places, axis=1)
        prediction = predict_measurement(model, np.zeros((4, 1)), np.eye(4)[..., None], z)
        intensity = np.full(z.shape[1], clutter / side**2)
        claimed[run] = associate(likelihood(prediction, 50.0), np.array([r]), np.array([p]), intensity).existence[0]
    for group in (claimed > -1, claimed > 0.6, claimed < 0.3):
        error = math.sqrt(0.25 / group.sum())
        assert abs(truth[group].mean() - claimed[group].mean()) < 4 * error


def test_density_integrates_to_one_over_the_gate() -> None:
    rng = np.random.default_rng(5)
    means = rng.normal(size=(4, 2)) * 3
    covariances = np.stack([np.eye(4) * 2 + 1, np.diag([1.0, 9.0, 1, 1])], axis=-1)
    axis = np.linspace(-30, 30, 601)
    grid = np.stack(np.meshgrid(axis, axis)).reshape(2, -1)
    density = likelihood(predict_measurement(Position(1.0, 1.0), means, covariances, grid), gate=9.0)
    np.testing.assert_allclose(density.sum(axis=1) * 0.1**2, 1.0, atol=5e-3)
    assert np.isclose((density[0] > 0).sum() * 0.1**2, 9.0 * math.pi * math.sqrt(15.0), rtol=0.02)


@pytest.mark.parametrize("cubature", [True, False])
def test_update_has_the_moments_of_the_mixture(cubature: bool) -> None:
    """Each hypothesis updated by itself (missed: not at all), then the mixture's mean and covariance."""
    rng = np.random.default_rng(6)
    T, M = 3, 4
    model = RangeAzimuth(50.0, 0.01)
    means = np.stack([rng.uniform(5e3, 9e3, T), rng.uniform(-3e3, 3e3, T), *rng.normal(size=(2, T))])
    root = rng.normal(size=(4, 4, T)) * np.array([100, 100, 5, 5])[:, None, None]
    covariances = np.einsum("ijt,kjt->ikt", root, root) + np.diag([1e3, 1e3, 1, 1])[..., None]
    z = model.observe(means[:2, :1]) + rng.normal(size=(2, M)) * [[80.0], [0.02]]
    weights = rng.dirichlet(np.ones(M + 1), T)
    prediction = predict_measurement(model, means, covariances, z, cubature)
    x, P = update(means, covariances, prediction, weights[:, 1:], weights[:, 0])
    for t in range(T):
        K, S = prediction.gain[..., t], prediction.covariance[..., t]
        points = [means[:, t]] + [means[:, t] + K @ prediction.innovations[:, t, j] for j in range(M)]
        spreads = [covariances[..., t]] + [covariances[..., t] - K @ S @ K.T] * M
        mean = sum(w * m for w, m in zip(weights[t], points, strict=True))
        second = sum(w * (C + np.outer(m, m)) for w, m, C in zip(weights[t], points, spreads, strict=True))
        np.testing.assert_allclose(x[:, t], mean, rtol=1e-12)
        np.testing.assert_allclose(P[..., t], second - np.outer(mean, mean), rtol=1e-6, atol=1e-4)
    assert linalg.is_positive_definite(P).all()


def test_nothing_to_associate() -> None:
    none = associate(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.ones(2))
    assert none.unused.tolist() == [1.0, 1.0]
    unseen = associate(np.zeros((1, 0)), np.array([0.5]), np.array([0.9]), np.zeros(0))
    np.testing.assert_allclose(unseen.existence, 0.5 * 0.1 / (1 - 0.45))
    np.testing.assert_allclose(unseen.missed, 1.0)
