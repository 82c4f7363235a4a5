"""The SIR filter's parts against exact counts and moments, and the whole against the Kalman filter."""

from __future__ import annotations

import numpy as np
import pytest

from sensor_clients.filters import kalman, particles
from sensor_clients.filters.kalman import Estimate


def test_systematic_resampling_takes_each_particle_floor_or_ceil_of_its_share() -> None:
    rng = np.random.default_rng(1)
    n, Np, B = 2, 30, 40
    W = rng.dirichlet(np.full(Np, 0.3), B).T
    W[5] = 0.0
    W /= W.sum(axis=0)
    points = np.broadcast_to(np.arange(Np)[None, :, None] + np.zeros((n, 1, B)), (n, Np, B))
    for count in (Np, 7, 100):
        chosen = particles.resample(rng, points, W, count)
        assert chosen.shape == (n, count, B)
        copies = np.stack([(chosen[0] == s).sum(axis=0) for s in range(Np)])
        assert (np.abs(copies - count * W) < 1 + 1e-9).all()
        assert not copies[5].any()
        assert (chosen[0] == chosen[1]).all()


@pytest.mark.parametrize("systematic", [True, False])
def test_resampling_is_unbiased(systematic: bool) -> None:
    """The mean number of copies is Np W_s: within 5 standard errors of the mean over the batch."""
    rng = np.random.default_rng(2)
    Np, B = 6, 20_000
    w = np.array([0.02, 0.3, 0.11, 0.0, 0.5, 0.07])
    points = np.broadcast_to(np.arange(Np, dtype=float)[None, :, None], (1, Np, B))
    chosen = particles.resample(rng, points, np.repeat(w[:, None], B, axis=1), systematic=systematic)
    copies = np.stack([(chosen[0] == s).sum(axis=0) for s in range(Np)])
    error = copies.std(axis=1) / np.sqrt(B)
    assert (np.abs(copies.mean(axis=1) - Np * w) <= 5 * error + 1e-12).all()
    if not systematic:
        np.testing.assert_allclose(copies.var(axis=1), Np * w * (1 - w), rtol=0.05)


def test_moments_are_those_of_numpy() -> None:
    rng = np.random.default_rng(3)
    x, W = rng.standard_normal((3, 50, 4)) * 5 + 2, rng.dirichlet(np.ones(50), 4).T
    got = particles.moments(x, W)
    for b in range(4):
        np.testing.assert_allclose(got.mean[:, b], np.average(x[..., b], axis=1, weights=W[:, b]))
        np.testing.assert_allclose(got.covariance[..., b], np.cov(x[..., b], aweights=W[:, b], ddof=0))


def test_what_is_drawn_has_the_moments_it_was_drawn_from() -> None:
    rng = np.random.default_rng(4)
    mean, P = np.array([[1.0], [-2.0]]), np.array([[2.0, 1.2], [1.2, 1.0]])[..., None]
    Np = 400_000
    x = particles.draw(rng, Estimate(mean, P), Np)[..., 0]
    np.testing.assert_allclose(x.mean(axis=1), mean[:, 0], atol=5 * np.sqrt(2 / Np))
    np.testing.assert_allclose(np.cov(x), P[..., 0], atol=5 * 2 * np.sqrt(2 / Np))


def test_weights_and_their_effective_number() -> None:
    logs = np.log(np.array([[0.1, 1.0], [0.3, 1.0], [0.4, 1.0], [0.8, 1.0]])) - 5000.0
    W = particles.weigh(logs)
    np.testing.assert_allclose(W[:, 0], np.array([0.1, 0.3, 0.4, 0.8]) / 1.6)
    assert particles.effective(W)[1] == pytest.approx(4.0)
    assert particles.effective(W)[0] == pytest.approx(1.6**2 / 0.9)


def test_a_union_has_the_moments_of_the_mixture() -> None:
    rng = np.random.default_rng(5)
    sets = [rng.standard_normal((2, 20, 3)) + shift for shift in (0.0, 4.0)]
    W = [rng.dirichlet(np.ones(20), 3).T for _ in range(2)]
    shares = np.array([[0.3, 0.5, 0.9], [0.7, 0.5, 0.1]])
    parts = [particles.moments(x, w) for x, w in zip(sets, W, strict=True)]
    both = particles.moments(*particles.union(sets, W, shares))
    mean = sum(share * part.mean for share, part in zip(shares, parts, strict=True))
    np.testing.assert_allclose(both.mean, mean)
    P = sum(
        share * (part.covariance + (part.mean - mean)[:, None] * (part.mean - mean)[None])
        for share, part in zip(shares, parts, strict=True)
    )
    np.testing.assert_allclose(both.covariance, P)


@pytest.mark.parametrize("systematic", [True, False])
def test_many_particles_give_the_kalman_filter(systematic: bool) -> None:
    """Linear, Gaussian: after five steps the mean over 30 filters of 4,000 particles is the exact posterior mean,
    within 5 standard errors of that mean, and so is the variance."""
    rng = np.random.default_rng(6)
    F, H, Q, R = np.array([[1.0, 1.0], [0.0, 0.9]]), np.array([[1.0, 0.0]]), np.diag([0.3, 0.2]), np.eye(1)
    prior = Estimate(np.zeros((2, 1)), np.eye(2)[..., None])
    B, Np = 30, 4000
    x = particles.draw(rng, Estimate(np.zeros((2, B)), np.repeat(prior.covariance, B, axis=2)), Np)
    exact, W = prior, np.full((Np, B), 1 / Np)
    for z in (0.7, 1.5, 0.2, -1.0, 1.1):
        exact = kalman.update(kalman.predict(exact, F, Q), H, R, np.array([[z]]))
        if z != 0.7:
            x = particles.resample(rng, x, W, systematic=systematic)
        x = np.einsum("ij,jsb->isb", F, x) + np.sqrt(np.diag(Q))[:, None, None] * rng.standard_normal(x.shape)
        W = particles.weigh(-0.5 * (z - x[0]) ** 2 / R[0, 0])
    got = particles.moments(x, W)
    error = got.mean.std(axis=1, ddof=1) / np.sqrt(B)
    assert (np.abs(got.mean.mean(axis=1) - exact.mean[:, 0]) < 5 * error).all()
    for i in range(2):
        spread = got.covariance[i, i].std(ddof=1) / np.sqrt(B)
        # particles understate a variance by some 1 / Np of it
        assert abs(got.covariance[i, i].mean() - exact.covariance[i, i, 0]) < 5 * spread + 2 / Np
