"""Mixtures as arrays against grids, samples, scipy and by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal, norm

from fusion_service.arrays import Floats
from fusion_service.densities import (
    DensityError,
    Mixture,
    Mixtures,
    draws,
    moments,
    power_product,
    reduce_mixture,
    reduce_mixtures,
    sampled_moments,
)
from tests.helpers.strategies import covariance, dimensions, seeds

GM1 = Mixture([0.7, 0.6, 0.5], [[10.0], [50.0], [90.0]], [[[100.0]], [[100.0]], [[200.0]]])
GM2 = Mixture([0.9, 0.8], [[11.0], [52.0]], [[[100.0]], [[120.0]]])
"""Li-2nd 5.2, Fig. 7."""


def random_mixture(rng: np.random.Generator, C: int, n: int, spread: float = 3.0) -> Mixture:
    P = np.stack([covariance(rng, n, 1.0) for _ in range(C)])
    return Mixture(rng.uniform(0.1, 1.0, C), spread * rng.normal(size=(C, n)), P)


def reference_pdf(m: Mixture, x: Floats) -> Floats:
    parts = zip(m.weights, m.means, m.covariances, strict=True)
    return np.asarray(sum(w * multivariate_normal(mean, P).pdf(x) for w, mean, P in parts))


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
    mixture = Mixture(weights, means, covariances)
    drawn = mixture.draw(100_000, seed=3)
    np.testing.assert_allclose(mixture.moments()[0], drawn.mean(axis=0), atol=0.03)
    np.testing.assert_allclose(mixture.moments()[1], np.cov(drawn.T), atol=0.08)


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


@pytest.mark.parametrize(
    ("weights", "means", "covariances", "complaint"),
    [
        ([1.0], [[0.0]], [[[0.0]]], "positive definite"),
        ([1.0], [[0.0, 0.0]], [[[1.0, 0.5], [0.0, 1.0]]], "symmetric"),
        ([1.0, 1.0], [[0.0]], [[[1.0]]], "expected C, C n, C n n"),
        ([-1.0, 2.0], [[0.0], [1.0]], [[[1.0]], [[1.0]]], "negative"),
        ([0.0], [[0.0]], [[[1.0]]], "positive sum"),
        ([1.0], [[np.nan]], [[[1.0]]], "finite"),
        ([1.0], "here", [[[1.0]]], "numbers"),
        ([], np.zeros((0, 1)), np.zeros((0, 1, 1)), "expected"),
    ],
)
def test_what_is_no_mixture_is_refused(weights: object, means: object, covariances: object, complaint: str) -> None:
    with pytest.raises(DensityError, match=complaint):
        Mixture(weights, means, covariances)  # type: ignore[arg-type]


def test_a_mixture_is_a_checked_copy() -> None:
    weights = np.array([1.0])
    mixture = Mixture(weights, [[0.0]], [[[1.0]]])
    weights[0] = 5.0
    assert mixture.mass == 1.0
    with pytest.raises(ValueError, match="read-only"):
        mixture.weights[0] = 2.0


@given(seeds, dimensions, st.integers(1, 4))
@settings(max_examples=30, deadline=None)
def test_pdf_is_scipys(seed: int, n: int, C: int) -> None:
    rng = np.random.default_rng(seed)
    m = random_mixture(rng, C, n)
    x = 3.0 * rng.normal(size=(2, 5, n))
    np.testing.assert_allclose(m.pdf(x), reference_pdf(m, x), rtol=1e-10)


def test_log_pdf_does_not_underflow() -> None:
    m = Mixture([0.5, 0.5], [[0.0], [1.0]], [[[1.0]], [[1.0]]])
    assert m.log_pdf([101.0]) == pytest.approx(np.log(0.5) + norm.logpdf(100.0), abs=1e-9)


def test_rows_come_back() -> None:
    rng = np.random.default_rng(6)
    mixtures = [random_mixture(rng, C, 3) for C in (2, 1, 4)]
    weights, means, covariances, counts = Mixtures.of(mixtures).rows()
    assert counts.tolist() == [2, 1, 4]
    np.testing.assert_allclose(weights, np.concatenate([m.weights for m in mixtures]), rtol=1e-15)
    np.testing.assert_array_equal(means, np.concatenate([m.means for m in mixtures]))
    np.testing.assert_array_equal(covariances, np.concatenate([m.covariances for m in mixtures]))


@given(seeds, dimensions)
@settings(max_examples=30, deadline=None)
def test_products_are_exact_and_first_order_powers_too_large(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    sources = [random_mixture(rng, C, n, 1.0) for C in (2, 1, 3)]
    batch = [Mixtures.of([m]) for m in sources]
    x = 2.0 * rng.normal(size=(7, n))
    product = power_product(batch, np.ones((3, 1)))[0]
    assert len(product.weights) == 6
    densities = np.stack([reference_pdf(m, x) for m in sources])
    np.testing.assert_allclose(product.pdf(x), densities.prod(axis=0), rtol=1e-8)
    powers = rng.dirichlet(np.ones(3))
    assert (power_product(batch, powers[:, None])[0].pdf(x) >= (densities.T**powers).prod(axis=1) * (1 - 1e-9)).all()
    single = power_product([batch[1], batch[1]], np.array([[0.3], [0.0]]))[0]
    np.testing.assert_allclose(single.pdf(x), densities[1] ** 0.3, rtol=1e-8)
    without = power_product([batch[1], batch[0]], np.array([[1.0], [0.0]]))[0]
    np.testing.assert_allclose(without.pdf(x), densities[1], rtol=1e-8)


def test_li_2nd_figure_7() -> None:
    grid = np.linspace(-200.0, 300.0, 20_001)
    step = grid[1] - grid[0]
    product = power_product([Mixtures.of([GM1]), Mixtures.of([GM2])], np.full((2, 1), 0.5))[0]
    assert product.mass == pytest.approx(1.8964, abs=5e-5)
    exact = np.sqrt(GM1.pdf(grid[:, None]) * GM2.pdf(grid[:, None]))
    assert exact.sum() * step == pytest.approx(1.5634, abs=5e-5)
    assert product.pdf(grid[:, None]).sum() * step == pytest.approx(product.mass, rel=1e-6)


def merge_by_hand(m: Mixture, most: int, method: str) -> list[tuple[float, Floats, Floats]]:
    """Greedy merging, one pair after the other, as a script would do it."""
    parts = [(float(w), x, P) for w, x, P in zip(m.weights / m.mass, m.means, m.covariances, strict=True)]
    while len(parts) > most:
        overall = moments_by_hand(parts)[2]
        best = None
        for i in range(len(parts)):
            for j in range(i + 1, len(parts)):
                a, b = parts[i], parts[j]
                both = moments_by_hand([a, b])
                if method == "runnalls":
                    logs = [np.linalg.slogdet(p[2])[1] for p in (both, a, b)]
                    cost = 0.5 * (both[0] * logs[0] - a[0] * logs[1] - b[0] * logs[2])
                else:
                    d = a[1] - b[1]
                    cost = a[0] * b[0] / (a[0] + b[0]) * (d @ np.linalg.solve(overall, d))
                if best is None or cost < best[0]:
                    best = (cost, i, j, both)
        assert best is not None
        parts = [p for k, p in enumerate(parts) if k not in best[1:3]] + [best[3]]
    return sorted(parts, key=lambda p: -p[0])


def moments_by_hand(parts: list[tuple[float, Floats, Floats]]) -> tuple[float, Floats, Floats]:
    w = sum(p[0] for p in parts)
    mean = np.asarray(sum(p[0] * p[1] for p in parts)) / w
    P = np.asarray(sum(p[0] * (p[2] + np.outer(p[1] - mean, p[1] - mean)) for p in parts)) / w
    return w, mean, P


@given(seeds, st.integers(1, 3), st.integers(1, 7), st.integers(1, 4), st.sampled_from(["runnalls", "salmond"]))
@settings(max_examples=50, deadline=None)
def test_merging_is_greedy_and_keeps_the_moments(seed: int, n: int, C: int, most: int, method: str) -> None:
    m = random_mixture(np.random.default_rng(seed), C, n)
    reduced = reduce_mixture(m, max_components=most, method=method)
    expected = merge_by_hand(m, most, method)
    assert len(reduced.weights) == len(expected)
    np.testing.assert_allclose(reduced.weights, [m.mass * p[0] for p in expected], rtol=1e-9)
    np.testing.assert_allclose(reduced.means, [p[1] for p in expected], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(reduced.covariances, [p[2] for p in expected], rtol=1e-8, atol=1e-8)
    for ours, theirs in zip(reduced.moments(), m.moments(), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("method", ["runnalls", "salmond"])
def test_long_merging_takes_the_same_pairs(method: str) -> None:
    """Many merges, many mixtures at once: a cost that was not brought up to date would show."""
    rng = np.random.default_rng(10)
    mixtures = [random_mixture(rng, 12, 2, 1.0) for _ in range(30)]
    reduced = reduce_mixtures(Mixtures.of(mixtures), max_components=3, method=method)
    for i, m in enumerate(mixtures):
        expected = merge_by_hand(m, 3, method)
        np.testing.assert_allclose(reduced[i].weights, [m.mass * p[0] for p in expected], rtol=1e-9)
        np.testing.assert_allclose(reduced[i].covariances, [p[2] for p in expected], rtol=1e-8, atol=1e-10)


def test_pruning_and_truncating() -> None:
    m = Mixture([0.5, 0.001, 0.3, 0.199], [[0.0], [1.0], [2.0], [3.0]], np.ones((4, 1, 1)))
    assert reduce_mixture(m, prune=0.01).means.ravel().tolist() == [0.0, 2.0, 3.0]
    two = reduce_mixture(m, max_components=2, method="truncate")
    np.testing.assert_allclose(two.weights, [0.625, 0.375])
    assert len(reduce_mixture(Mixture([1.0, 1.0], m.means[:2], m.covariances[:2]), prune=0.9).weights) == 1
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({"method": "best"}, "runnalls"),
        ({"max_components": 0}, "at least 1"),
        ({"prune": 1.0}, "share"),
    )
    for options, complaint in cases:
        with pytest.raises(DensityError, match=complaint):
            reduce_mixture(m, **options)


@pytest.mark.parametrize("method", ["runnalls", "salmond", "truncate"])
def test_an_element_does_not_feel_its_batch(method: str) -> None:
    rng = np.random.default_rng(8)
    mixtures = [random_mixture(rng, C, 4) for C in (6, 1, 9, 3, 9)]
    together = reduce_mixtures(Mixtures.of(mixtures), max_components=3, prune=0.05, method=method)
    for i, m in enumerate(mixtures):
        alone = reduce_mixture(m, max_components=3, prune=0.05, method=method)
        np.testing.assert_array_equal(alone.weights, together[i].weights)
        np.testing.assert_array_equal(alone.means, together[i].means)
        np.testing.assert_array_equal(alone.covariances, together[i].covariances)


def test_a_bad_mixture_spoils_no_other() -> None:
    rng = np.random.default_rng(9)
    batch = Mixtures.of([random_mixture(rng, 5, 2) for _ in range(3)])
    good = reduce_mixtures(batch, max_components=2)
    batch.means[:, 1, 1] = np.nan
    again = reduce_mixtures(batch, max_components=2)
    np.testing.assert_array_equal(good.means[..., [0, 2]], again.means[..., [0, 2]])


def test_sampled_moments_against_a_grid() -> None:
    grid = np.linspace(-12.0, 12.0, 4001)
    proposal = norm.pdf(grid, 1.0, 2.0)
    target = proposal / np.cosh(grid - 2.0)
    step = grid[1] - grid[0]
    mass = target.sum() * step
    mean = (grid * target).sum() * step / mass
    variance = ((grid - mean) ** 2 * target).sum() * step / mass
    z = draws(1, 40_000, seed=2)
    log_mass, m, P, effective = sampled_moments(
        np.array([[1.0]]), np.array([[[4.0]]]), lambda x: np.asarray(-np.log(np.cosh(x[0] - 2.0))), z
    )
    assert 0.0 < effective[0] < z.shape[1]
    assert np.exp(log_mass[0]) == pytest.approx(mass, rel=0.01)  # standard errors: 0.003 of the mass,
    assert m[0, 0] == pytest.approx(mean, abs=0.03)  # 0.01
    assert P[0, 0, 0] == pytest.approx(variance, rel=0.05)  # and 0.015 of the variance


def test_draws_have_exact_moments() -> None:
    z = draws(3, 200, seed=5)
    np.testing.assert_allclose(z.sum(axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(z @ z.T / z.shape[1], np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(z, draws(3, 200, seed=5))
    assert not np.array_equal(z, draws(3, 200, seed=6))
