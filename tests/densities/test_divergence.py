"""Divergences and Chernoff weights against integrals on a grid and against scipy's minimisers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import binom

from fusion_service.arrays import Floats
from fusion_service.densities import (
    Mixture,
    Mixtures,
    chernoff_discrete,
    chernoff_gaussians,
    chernoff_mixtures,
    kl_bounds,
    kl_gaussians,
    overlap_gaussians,
)
from tests.helpers.strategies import dimensions, seeds, sources

GRID = np.linspace(-25.0, 25.0, 20_001)
STEP = GRID[1] - GRID[0]


def one_dimensional(rng: np.random.Generator, C: int) -> Mixture:
    return Mixture(rng.dirichlet(np.ones(C)), 2.0 * rng.normal(size=(C, 1)), rng.uniform(0.3, 3.0, (C, 1, 1)))


def kl_on_grid(f: Mixture, g: Mixture) -> float:
    log_f, log_g = f.log_pdf(GRID[:, None]), g.log_pdf(GRID[:, None])
    return float((np.exp(log_f) * (log_f - log_g)).sum() * STEP)


@given(seeds)
@settings(max_examples=40, deadline=None)
def test_bounds_hold_the_divergence(seed: int) -> None:
    rng = np.random.default_rng(seed)
    f, g = (one_dimensional(rng, C) for C in (3, 2))
    low, high = kl_bounds(f, g)
    assert low - 1e-9 <= kl_on_grid(f, g) <= high + 1e-9


def test_divergence_of_gaussians_on_a_grid() -> None:
    f, g = Mixture([1.0], [[1.0]], [[[2.0]]]), Mixture([1.0], [[-0.5]], [[[0.7]]])
    ours = kl_gaussians(f.means.T, f.covariances.T, g.means.T, g.covariances.T)
    assert ours[0] == pytest.approx(kl_on_grid(f, g), abs=1e-6)


def log_z(w: Floats, x: Floats, P: Floats) -> float:
    """log of the integral of the weighted geometric mean of Gaussians (Uney (25), corrected)."""
    A = np.linalg.inv(P)
    M = np.einsum("i,ijk->jk", w, A)
    y = np.einsum("i,ijk,ik->j", w, A, x)
    square = np.einsum("i,ij,ijk,ik->", w, x, A, x) - y @ np.linalg.solve(M, y)
    return float(0.5 * (w @ np.linalg.slogdet(A)[1] - np.linalg.slogdet(M)[1] - square))


@given(seeds, dimensions)
@settings(max_examples=30, deadline=None)
def test_two_gaussians_are_equally_far_from_their_mean(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    x, P = sources(rng, 2, n)
    w = chernoff_gaussians(x[..., None], P[..., None])[:, 0]
    best = minimize_scalar(
        lambda t: log_z(np.array([1 - t, t]), x, P), bounds=(0, 1), method="bounded", options={"xatol": 1e-9}
    )
    assert log_z(w, x, P) <= best.fun + 1e-10
    C = np.linalg.inv(np.einsum("i,ijk->jk", w, np.linalg.inv(P)))
    m = C @ np.einsum("i,ijk,ik->j", w, np.linalg.inv(P), x)
    far = [kl_gaussians(m[:, None], C[..., None], x[i][:, None], P[i][..., None])[0] for i in (0, 1)]
    assert far[0] == pytest.approx(far[1], rel=1e-6, abs=1e-9)


@given(seeds, dimensions)
@settings(max_examples=30, deadline=None)
def test_overlap_and_its_derivatives_by_differences(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    x, P = sources(rng, 2, n)

    def at(t: float) -> float:
        return log_z(np.array([1 - t, t]), x, P)

    t, h = 0.2 + 0.6 * rng.random(), 1e-3
    log, gradient, hessian = overlap_gaussians(x[..., None], P[..., None], np.array([[1 - t], [t]]))
    assert log[0] == pytest.approx(at(t), abs=1e-8)
    first = (8 * (at(t + h) - at(t - h)) - at(t + 2 * h) + at(t - 2 * h)) / (12 * h)
    assert gradient[1, 0] - gradient[0, 0] == pytest.approx(first, rel=1e-5, abs=1e-6)
    second = (at(t + h) - 2 * at(t) + at(t - h)) / h**2
    bend = hessian[0, 0, 0] + hessian[1, 1, 0] - 2 * hessian[0, 1, 0]
    assert bend == pytest.approx(second, rel=1e-3, abs=1e-4)


def test_overlap_of_three_on_a_grid() -> None:
    x, P, w = np.array([[0.0], [1.0], [2.5]]), np.array([[[1.0]], [[2.0]], [[0.5]]]), np.array([0.2, 0.3, 0.5])
    logs = -0.5 * (GRID - x) ** 2 / P[:, 0] - 0.5 * np.log(2 * np.pi * P[:, 0])
    integral = np.exp(w @ logs).sum() * STEP
    log, _, _ = overlap_gaussians(x[..., None], P[..., None], w[:, None])
    assert np.exp(log[0]) == pytest.approx(integral, abs=1e-9)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_more_gaussians_against_a_minimiser(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, P = sources(rng, 4, 2)
    w = chernoff_gaussians(x[..., None], P[..., None])[:, 0]
    assert w.min() >= 0.0
    assert w.sum() == pytest.approx(1.0, abs=1e-12)
    other = minimize(
        log_z, np.full(4, 0.25), args=(x, P), bounds=[(0, 1)] * 4, method="SLSQP",
        constraints={"type": "eq", "fun": lambda v: v.sum() - 1}, options={"ftol": 1e-12},
    )  # fmt: skip
    assert log_z(w, x, P) <= other.fun + 1e-8
    order = rng.permutation(4)
    again = chernoff_gaussians(x[order][..., None], P[order][..., None])[:, 0]
    assert log_z(again, x[order], P[order]) == pytest.approx(log_z(w, x, P), abs=1e-8)


def uney(kappa: float) -> tuple[Floats, Floats]:
    """Uney's example 3.3: two Gaussians seen from different aspects, (N, n) and (N, n, n)."""
    turn = np.array([[1.0, -1.0], [1.0, 1.0]]) / np.sqrt(2.0)
    S = np.diag([1.0, 1.0 / kappa])
    return np.array([[0.25, 0.25], [-0.75, -0.25]]), np.stack([turn @ S @ turn.T, turn.T @ S @ turn])


@pytest.mark.parametrize(("kappa", "omega"), [(1.0, 0.5), (10.0, 0.397), (20.0, 0.387)])
def test_uney_example_4_2(kappa: float, omega: float) -> None:
    """As published, from 1,000 samples; the least z by a bounded search is what decides."""
    x, P = uney(kappa)
    ours = chernoff_gaussians(x[..., None], P[..., None])[1, 0]
    assert ours == pytest.approx(omega, abs=0.005)
    best = minimize_scalar(
        lambda t: log_z(np.array([1 - t, t]), x, P), bounds=(0, 1), method="bounded", options={"xatol": 1e-10}
    )
    assert ours == pytest.approx(best.x, abs=1e-6)


@pytest.mark.parametrize(("k", "p", "q", "omega"), [(5, 0.95, 0.92, 0.5182), (35, 0.98, 0.975, 0.5090)])
def test_uney_example_4_3(k: int, p: float, q: float, omega: float) -> None:
    pmfs = np.stack([binom.pmf(np.arange(k + 1), k, v) for v in (p, q)])
    w = chernoff_discrete(np.log(pmfs)[..., None], np.zeros((k + 1, 1)))[:, 0]
    assert w[1] == pytest.approx(omega, abs=2e-4)
    f = np.prod(pmfs ** w[:, None], axis=0)
    f /= f.sum()
    assert f @ np.log(f / pmfs[0]) == pytest.approx(f @ np.log(f / pmfs[1]), abs=1e-12)


def test_equal_sources_keep_equal_weights() -> None:
    x, P = sources(np.random.default_rng(1), 1, 3)
    for N in (1, 2, 3):
        w = chernoff_gaussians(np.repeat(x, N, axis=0)[..., None], np.repeat(P, N, axis=0)[..., None])
        np.testing.assert_array_equal(w, np.full((N, 1), 1.0 / N))


def test_weights_do_not_feel_the_batch() -> None:
    rng = np.random.default_rng(2)
    for N in (2, 3):
        parts = [sources(rng, N, 4) for _ in range(7)]
        x, P = np.stack([p[0] for p in parts], axis=-1), np.stack([p[1] for p in parts], axis=-1)
        together = chernoff_gaussians(x, P)
        for i in range(7):
            np.testing.assert_array_equal(together[:, i], chernoff_gaussians(x[..., [i]], P[..., [i]])[:, 0])


@pytest.mark.parametrize("N", [2, 3])
def test_mixtures_against_a_grid(N: int) -> None:
    rng = np.random.default_rng(7)
    mixtures = [one_dimensional(rng, 3) for _ in range(N)]
    logs = np.stack([m.log_pdf(GRID[:, None]) for m in mixtures])
    w = chernoff_mixtures([Mixtures.of([m]) for m in mixtures], 8000, 1)[:, 0]

    def z(v: Floats) -> float:
        return float(np.log(np.exp(v @ logs).sum() * STEP))

    best = minimize(
        z, np.full(N, 1 / N), bounds=[(0, 1)] * N, method="SLSQP",
        constraints={"type": "eq", "fun": lambda v: v.sum() - 1},
    )  # fmt: skip
    assert z(w) == pytest.approx(best.fun, abs=2e-3 * abs(best.fun) + 1e-4)
    np.testing.assert_allclose(w, best.x, atol=0.05)
