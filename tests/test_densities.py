"""Moments of mixtures against samples and by hand."""

from __future__ import annotations

import numpy as np

from fusion_service.densities import moments


def test_moments_are_those_of_samples() -> None:
    rng = np.random.default_rng(4)
    weights = np.array([0.2, 0.8])
    means = np.array([[0.0, 1.0], [3.0, -1.0]])
    covariances = np.array([[[2.0, 0.5], [0.5, 1.0]], [[1.0, -0.3], [-0.3, 0.5]]])
    mean, covariance = moments(means, covariances, weights, np.array([2], dtype=np.uint16))
    size = 400_000
    which = rng.choice(2, size=size, p=weights)
    samples = means[which] + np.einsum("bij,bj->bi", np.linalg.cholesky(covariances)[which], rng.normal(size=(size, 2)))
    np.testing.assert_allclose(mean[0], samples.mean(axis=0), atol=0.02)  # standard error below 0.003
    np.testing.assert_allclose(covariance[0], np.cov(samples.T), atol=0.05)  # and 0.01


def test_each_track_is_its_own_and_a_bad_one_spoils_no_other() -> None:
    rng = np.random.default_rng(5)
    counts = np.array([1, 3, 2], dtype=np.uint16)
    means = rng.normal(size=(6, 2))
    covariances = np.tile(np.eye(2), (6, 1, 1))
    weights = np.array([1.0, 0.2, 0.3, 0.5, 0.4, 0.6])
    mean, covariance = moments(means, covariances, weights, counts)
    np.testing.assert_allclose(mean[0], means[0])
    np.testing.assert_allclose(mean[1], weights[1:4] @ means[1:4])
    means[1] = np.nan
    again, _ = moments(means, covariances, weights, counts)
    assert np.isnan(again[1]).all()
    np.testing.assert_array_equal(again[[0, 2]], mean[[0, 2]])
    assert covariance.shape == (3, 2, 2)


def test_gaussians_pass() -> None:
    means, covariances = np.zeros((3, 2)), np.tile(np.eye(2), (3, 1, 1))
    assert moments(means, covariances, None, None) == (means, covariances)
