"""The studies of Uney: their filters against integrals on a grid and their calibration, Algorithms 1 and 2 against
searches, and what the experiments claim."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom, multivariate_normal, poisson

from fusion_service.densities import Mixtures, power_product
from studies import uney
from studies.experiments import uney_bernoulli, uney_iid_cluster, uney_poisson
from studies.study import Result, Run, catalogue

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def results() -> dict[str, Result]:
    names = ("uney-bernoulli", "uney-iid-cluster", "uney-poisson")
    return {name: catalogue()[name].run(Run(catalogue()[name].quick, 7)) for name in names}


def value(result: Result, name: str, quantity: str) -> tuple[float, float]:
    (row,) = [row for row in result.rows if (row.name, row.quantity) == (name, quantity)]
    return row.ours, row.stderr or 0.0


def test_aspects_are_turned_diagonals() -> None:
    """Example 3.3: R(+-pi/4) diag(1, 1/kappa) R'."""
    for kappa in (1.0, 7.0):
        for P, angle in zip(uney.aspects(kappa), (np.pi / 4, -np.pi / 4), strict=True):
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            np.testing.assert_allclose(P, turn @ np.diag([1.0, 1.0 / kappa]) @ turn.T, atol=1e-15)
    many = uney.aspects(np.array([3.0, 5.0]), 4)
    assert many.shape == (4, 2, 2, 2)
    np.testing.assert_allclose(np.linalg.det(many[..., 1]), 0.2)


@pytest.mark.parametrize("kind", ["bernoulli", "phd"])
def test_update_by_integrals_on_a_grid(kind: str) -> None:
    """Mass, mean and covariance of the posterior of a survivor and a birth, two reports, one of them a false slot."""
    pd, density = 0.7, 0.02
    R = np.array([[0.5, 0.2], [0.2, 0.4]])
    parts = (
        uney.Local(np.array([0.5]), np.array([[0.3], [-0.2]]), np.array([[0.4, 0.1], [0.1, 0.9]])[..., None]),
        uney.Local(np.array([0.2]), np.array([[1.0], [0.5]]), 2.0 * np.eye(2)[..., None]),
    )
    z = np.array([[0.8, 3.0, -1.5], [0.1, 3.0, 0.9]])
    reports = uney.Reports(z[..., None], np.array([[True], [False], [True]]))
    ours = uney.update(parts, reports, R[..., None], pd, density, kind)

    axis = np.linspace(-9.0, 10.0, 381)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    area = (axis[1] - axis[0]) ** 2
    prior = sum(
        float(part.mass[0]) * multivariate_normal(part.mean[:, 0], part.covariance[..., 0]).pdf(grid) for part in parts
    )
    posterior = (1 - pd) * prior
    for report in z.T[[0, 2]]:
        hit = pd * multivariate_normal(report, R).pdf(grid) * prior
        posterior = posterior + hit / (density + (hit.sum() * area if kind == "phd" else 0.0))
    total = posterior.sum() * area
    mass = total if kind == "phd" else total / (1 - 0.7 + total)
    assert ours.mass[0] == pytest.approx(mass, rel=1e-6)
    share = posterior * area / total
    mean = (share[..., None] * grid).sum(axis=(0, 1))
    np.testing.assert_allclose(ours.mean[:, 0], mean, atol=1e-6)
    offset = grid - mean
    np.testing.assert_allclose(ours.covariance[..., 0], np.einsum("ab,abi,abj->ij", share, offset, offset), atol=1e-6)


def test_filters_are_calibrated() -> None:
    """A target that comes and goes as the filters assume: what a sensor says is, on average, how often it is there.
    The second Gaussian it merges into costs little; 4 standard errors and 0.01 are allowed."""
    rng, B, K = np.random.default_rng(11), 3000, 25
    there = np.zeros((K, B), dtype=np.bool_)
    for k in range(K):
        before = there[k - 1] if k else np.zeros(B, dtype=np.bool_)
        there[k] = rng.random(B) < np.where(before, uney.SURVIVAL, uney.BIRTH)
    *_, (masses, z, centre) = uney.network(rng, uney.aspects(np.full(B, 10.0)), there, "bernoulli")
    assert ((z >= 0) & (z <= 1)).all()
    for r in (*masses, centre):
        off = r - there[-1]
        assert abs(off.mean()) < 4 * off.std() / np.sqrt(B) + 0.01
        for low, high in ((0.0, 0.1), (0.1, 0.9), (0.9, 1.01)):
            some = off[(r >= low) & (r < high)]
            assert abs(some.mean()) < 4 * 0.5 / np.sqrt(len(some)) + 0.01
    assert np.mean((centre - there[-1]) ** 2) < np.mean((masses[0] - there[-1]) ** 2)


def test_phd_counts_right_on_average() -> None:
    """Of a target that comes and goes as assumed the expected number is right: 4 standard errors and 0.02 allowed (the
    PHD filter takes births for independent of what is there)."""
    rng, B, K = np.random.default_rng(12), 3000, 20
    there = np.zeros((K, B), dtype=np.bool_)
    for k in range(K):
        before = there[k - 1] if k else np.zeros(B, dtype=np.bool_)
        there[k] = rng.random(B) < np.where(before, uney.SURVIVAL, uney.BIRTH)
    *_, (masses, _, _) = uney.network(rng, uney.aspects(np.full(B, 10.0)), there, "phd")
    off = masses[0] - there[-1]
    assert abs(off.mean()) < 4 * off.std() / np.sqrt(B) + 0.02


@pytest.mark.parametrize("n", [1, 2, 4])
def test_newton_bisection_and_a_grid_of_z_agree(n: int) -> None:
    means, covariances = uney.random_gaussians(np.random.default_rng(n), 30, n, 30.0, 3.0)
    best = uney.equal_divergence(means, covariances)
    search = uney.newton(uney.gaussian_slopes(means, covariances), np.full(30, 0.5), tolerance=1e-9)
    assert search.settled.all()
    np.testing.assert_allclose(search.weight, best, atol=1e-8)
    grid = np.linspace(0.0, 1.0, 1001)
    z = np.stack([uney.overlap(means, covariances, w) for w in grid])
    np.testing.assert_allclose(grid[z.argmin(axis=0)], best, atol=1.1e-3)


def test_printed_start_fails_and_samples_give_the_second_derivative() -> None:
    means, covariances = uney.example(np.linspace(1.5, 40.0, 20))
    exact = uney.gaussian_slopes(means, covariances)
    assert not uney.newton(exact, np.full(20, np.inf), clamp=False).settled.any()
    w, at = np.full(20, 0.3), np.arange(20)
    noisy = uney_bernoulli.sampled(means, covariances, np.random.default_rng(3))
    draws = np.stack([noisy(w, at)[1] for _ in range(40)])
    error = np.abs(draws.mean(axis=0) - exact(w, at)[1]) / (draws.std(axis=0, ddof=1) / np.sqrt(40))
    assert error.max() < 4.5


def test_algorithm_2_on_a_grid_of_weights() -> None:
    for family in ("alike", "unlike"):
        logs = np.log(uney_iid_cluster.random_pmfs(np.random.default_rng(5), 25, family))
        best = uney_iid_cluster.equal_divergence(logs)
        grid = np.linspace(0.0, 1.0, 2001)
        z = np.stack([np.exp((1 - w) * logs[0] + w * logs[1]).sum(axis=0) for w in grid])
        np.testing.assert_allclose(grid[z.argmin(axis=0)], best, atol=6e-4)
        search = uney.newton(uney_iid_cluster.slopes(logs), np.full(25, 0.5), tolerance=1e-9)
        good = search.settled
        assert good.mean() > 0.9
        np.testing.assert_allclose(search.weight[good], best[good], atol=1e-7)


def test_overlap_of_sets_far_apart_is_the_mean_of_the_targets() -> None:
    """The IID cluster sets' z, from the mixtures themselves."""
    rng = np.random.default_rng(9)
    sites = 1e4 * np.arange(3)[:, None] * np.ones(2)
    P = uney.aspects(20.0)
    means = np.stack([sites + rng.standard_normal((3, 2)) for _ in range(2)])
    z = uney.overlap(means.transpose(0, 2, 1), np.ascontiguousarray(np.broadcast_to(P[..., None], (2, 2, 2, 3))))
    sets = [
        Mixtures(np.full((3, 1), -np.log(3.0)), m.T[..., None], np.broadcast_to(p[..., None, None], (2, 2, 3, 1)))
        for m, p in zip(means, P, strict=True)
    ]
    product = power_product(sets, np.full((2, 1), 0.5))
    assert np.exp(product.log_mass)[0] == pytest.approx(z.mean(), rel=1e-9)


def test_counts_give_the_exact_distribution_of_the_number() -> None:
    """Calibrated over a uniform number of targets: posterior mean less truth is 0 within 4 standard errors."""
    rng = np.random.default_rng(21)
    off, inside = [], []
    for n in range(1, uney_iid_cluster.MOST + 1):
        p, z = uney_iid_cluster.counts(rng, n, 2, 50)
        assert p.shape == (50, 2, uney_iid_cluster.MOST + 1)
        assert ((z > 0) & (z <= 1)).all()
        off.append(p @ np.arange(p.shape[-1]) - n)
        inside.append(p[..., n] / p.max(axis=-1))
    error = np.concatenate(off)
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(error.size) + 0.5 / uney_iid_cluster.MOST  # 0 is left out
    assert np.mean(np.concatenate(inside)) > 0.5


def test_detections_and_false_reports_add() -> None:
    """The counts' distribution, by the two sums, of one scan of 3 targets: its mean and variance are the parts'."""
    m = np.arange(60)
    pmf = np.convolve(binom.pmf(m, 3, 0.8), poisson.pmf(m, 1.0))[:60]
    seen = np.random.default_rng(2).binomial(3, 0.8, 40_000) + np.random.default_rng(3).poisson(1.0, 40_000)
    assert abs((pmf @ m) - seen.mean()) < 4 * seen.std() / 200


def test_52_as_printed_has_no_number_for_falling_rates() -> None:
    low, high = np.array([2.0]), np.array([5.0])
    assert uney_poisson.printed(low, high)[0] == pytest.approx(3.0 / np.log(2.5))
    assert np.isnan(uney_poisson.printed(high, low)[0])


def test_every_claim_of_the_paper_holds(results: dict[str, Result]) -> None:
    claims = [row for result in results.values() for row in result.rows if row.quantity.startswith("claim")]
    assert len(claims) > 15
    assert [row.name for row in claims if row.ours != 1.0] == []


def test_published_numbers(results: dict[str, Result]) -> None:
    bernoulli, cluster = results["uney-bernoulli"], results["uney-iid-cluster"]
    for kappa, omega in ((1, 0.5), (10, 0.397), (20, 0.387)):
        ours, _ = value(bernoulli, "example 3.3 and 4.2", f"omega* at kappa = {kappa}")
        assert ours == pytest.approx(omega, abs=0.005)
    for label, omega in (("of 5", 0.5182), ("of 35", 0.5090)):
        ours, _ = value(cluster, f"binomials {label}, consistent", "omega_c* of algorithm 2")
        assert ours == pytest.approx(omega, abs=1e-4)


def test_algorithms_fail_as_printed_and_not_as_corrected(results: dict[str, Result]) -> None:
    for name in ("uney-bernoulli", "uney-iid-cluster"):
        for row in results[name].rows:
            if row.quantity == "failures, %":
                if "from infinity" in row.name:
                    assert row.ours == 100.0
                if "clamped" in row.name or "bracketed" in row.name:
                    assert row.ours == 0.0, row
    assert value(results["uney-iid-cluster"], "unlike: from 1/2, N of (16)", "failures, %")[0] > 50.0
    assert value(results["uney-bernoulli"], "unlike: from 1/2, closed form", "failures, %")[0] > 2.0


def test_exponential_mixture_misses_targets_that_consistent_fusion_keeps(results: dict[str, Result]) -> None:
    result = results["uney-bernoulli"]
    for N, kappas in uney_bernoulli.NETWORKS:
        for kappa in kappas:
            label = f"N = {N}, kappa = {kappa:.0f}: "
            missed = {m: value(result, label + m, "missed, %") for m in uney_bernoulli.METHODS}
            assert missed["EMD"][0] > missed["consistent"][0] > missed["centralised"][0]
            assert missed["EMD"][0] - missed["EMD with z = 1"][0] > 0
            assert value(result, label + "EMD", "below every sensor while there, %")[0] > 2.0
            assert value(result, label + "consistent", "below every sensor while there, %")[0] == 0.0
            if N == 2:  # both exceed one half where the existences add to more than 1
                assert missed["consistent"] == missed["average"]


def test_exponential_mixture_counts_too_few(results: dict[str, Result]) -> None:
    cluster, phd = results["uney-iid-cluster"], results["uney-poisson"]
    for N in uney_iid_cluster.TEAMS:
        bias = [value(cluster, f"n = {n}, N = {N}: EMD", "mean error of the number") for n in (1, 10, 30)]
        assert all(b + 4 * e < 0 for b, e in bias[1:])
        assert bias[0][0] > bias[1][0] > bias[2][0]
        for n in uney_iid_cluster.NUMBERS:
            ours, error = value(cluster, f"n = {n}, N = {N}: consistent", "mean error of the number")
            assert abs(ours) < 4 * error + 0.1
    for N in uney_poisson.TEAMS:
        late = "mean error, 12 targets, steps 28 to 33"
        low, error = value(phd, f"N = {N}: EMD", late)
        high, other = value(phd, f"N = {N}: consistent", late)
        assert high - low > 4 * np.hypot(error, other)
