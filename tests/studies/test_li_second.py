"""Li-2nd's experiments: averages of variables, of densities and of intensities, against independent answers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.stats import norm, poisson

import schemas
from fusion_service.centre import IntensityCentre
from fusion_service.rules import fuse_mixtures
from studies.experiments import li_densities as densities
from studies.experiments import li_phd as phd
from studies.experiments import li_phd_filter as filters
from studies.experiments import li_variables as variables
from studies.study import Result, Row, Run, catalogue

STUDIES = catalogue()


def table(result: Result) -> dict[tuple[str, str], Row]:
    return {(row.name, row.quantity): row for row in result.rows}


@pytest.fixture(scope="module")
def results() -> dict[str, Result]:
    names = ("li-variables", "li-densities", "li-phd", "li-phd-filter")
    return {name: STUDIES[name].run(Run(STUDIES[name].quick, 11)) for name in names}


@pytest.fixture(scope="module")
def rows(results: dict[str, Result]) -> dict[str, dict[tuple[str, str], Row]]:
    return {name: table(result) for name, result in results.items()}


# variables


@pytest.mark.parametrize("w1", [0.1, 0.5, 0.9])
def test_the_gaussian_pair_by_adaptive_quadrature(w1: float) -> None:
    """Independent variables: moments of the GA as products of one-dimensional integrals."""

    def power(index: int, s: float) -> float:
        mu, sigma = variables.MU[index], np.sqrt(variables.SIGMA2[index])
        inside = norm.sf(0, mu, sigma)
        whole = quad(lambda x: x**s * norm.pdf(x, mu, sigma), 0, mu + 12 * sigma, points=[mu], limit=200)[0]
        return float(whole / inside)

    k = int(np.flatnonzero(np.isclose(variables.W, w1))[0])
    curve = variables.curves(variables.gaussian_pair(0.0))
    first = power(0, w1) * power(1, 1 - w1)
    assert curve.mean[1, k] == pytest.approx(first, rel=1e-8)
    assert curve.variance[1, k] == pytest.approx(power(0, 2 * w1) * power(1, 2 - 2 * w1) - first**2, rel=1e-6)


def test_the_correlated_gaussian_pair_by_adaptive_quadrature() -> None:
    rho, mu, sigma = 0.70846, variables.MU, np.sqrt(variables.SIGMA2)

    def density(y: float, x: float) -> float:
        a, b = (x - mu[0]) / sigma[0], (y - mu[1]) / sigma[1]
        return float(np.exp(-(a * a - 2 * rho * a * b + b * b) / (2 * (1 - rho * rho))))

    limits = (0.1, mu[0] + 6 * sigma[0], 0.1, mu[1] + 6 * sigma[1])
    total = dblquad(density, *limits, epsrel=1e-6)[0]
    mean = dblquad(lambda y, x: np.sqrt(x * y) * density(y, x), *limits, epsrel=1e-6)[0] / total
    assert variables.curves(variables.gaussian_pair(rho)).mean[1, 500] == pytest.approx(mean, rel=1e-4)


@pytest.mark.parametrize("rho", variables.POISSON_RHO)
def test_the_poisson_pair_has_its_marginals_and_its_correlation(rho: float) -> None:
    pair = variables.poisson_pair(rho)
    for axis, rate in ((1, 10.0), (0, 12.0)):
        np.testing.assert_allclose(pair.p.sum(axis=axis), poisson.pmf(np.arange(61), rate), atol=1e-9)
    cov = (pair.x1 - 10) @ pair.p @ (pair.x2 - 12)
    assert cov / np.sqrt(120) == pytest.approx(rho, abs=1e-6)
    x = pair.draw(np.random.default_rng(3), 200_000)
    assert np.mean((x[0] - 10) * (x[1] - 12)) / np.sqrt(120) == pytest.approx(
        rho, abs=5 * np.sqrt((1 + 2 * rho**2) / 200_000)
    )


def test_the_average_of_samples_has_the_exact_moments(rows: dict[str, dict[tuple[str, str], Row]]) -> None:
    """The largest of some 500 correlated deviations, in standard errors."""
    assert 0.5 < rows["li-variables"]["most |sampled - exact| / std. err.", "value"].ours < 5.0


def test_remark_2_is_a_matter_of_skewness(rows: dict[str, dict[tuple[str, str], Row]]) -> None:
    """Var GA - Var AA at w1 = 1/2 of two gamma variables alike is -(s/c - 3/2) (mu c^2 / 2)^2, to leading order."""
    mu, c = 100.0, 0.05
    curve = variables.independent("gamma", (mu, mu), ((c * mu) ** 2,) * 2)
    gap = curve.variance[1, 500] - curve.variance[0, 500]
    assert gap == pytest.approx(-0.5 * (mu * c * c / 2) ** 2, rel=0.02)
    for family, kept in (("Fig. 1, rho 0", True), ("Fig. 2, rho 0", True), ("two independent Exp(1)", False)):
        aa, ga = (rows["li-variables"][f"{family}: {rule}", "least variance"].ours for rule in ("AA", "GA"))
        assert (aa < ga) == kept, family


def test_remark_4_needs_errors_that_are_not_correlated(rows: dict[str, dict[tuple[str, str], Row]]) -> None:
    """With beta above (26) no weight makes AA better than the better estimator, though theta is on a mean."""
    curve = variables.curves(variables.gaussian_pair(variables.FIG4_RHO)).mse(50.0)[0]
    assert curve.argmin() == len(variables.W) - 1
    curve = variables.curves(variables.gaussian_pair(0.5)).mse(50.0)[0]
    assert curve.argmin() < len(variables.W) - 1
    name = "Fig. 4 at theta = 50"
    assert (
        rows["li-variables"][f"{name}: beta", "value"].ours > rows["li-variables"][f"{name}: bound (26)", "value"].ours
    )


# densities


@pytest.mark.parametrize(("theta", "crosses"), [(64.9, False), (65.2, True), (67.0, True), (69.8, True), (70.1, False)])
def test_the_band_of_cross_overs_by_the_papers_formulas(theta: float, crosses: bool) -> None:
    """(32)-(35), (41) and (43) written out, at single values of theta."""
    w = np.linspace(1e-3, 1 - 1e-3, 999)
    (m1, m2), (P1, P2) = densities.EXAMPLES["Fig. 5"]
    aa = w * P1 + (1 - w) * P2 + w * (m1 - theta) ** 2 + (1 - w) * (m2 - theta) ** 2
    P = P1 * P2 / (w * P2 + (1 - w) * P1)
    ga = P + (P * (w * m1 / P1 + (1 - w) * m2 / P2) - theta) ** 2
    assert (aa > ga).all() or (aa < ga).all() or crosses
    assert ((aa > ga).any() and (aa < ga).any()) == crosses
    star = densities.indifferent(densities.fused((m1 + 0 * w, m2 + 0 * w), (P1 + 0 * w, P2 + 0 * w), w))
    assert (star.min() < theta < star.max()) == crosses


@pytest.mark.parametrize("apart", [0.0, 1.0, 3.0, 6.0])
def test_what_49_adds_to_a_density_averaged_with_itself(apart: float) -> None:
    assert densities.self_average(apart) == pytest.approx(1 + np.exp(-(apart**2) / 8), rel=1e-9)


def test_49_against_the_grid_integral(rows: dict[str, dict[tuple[str, str], Row]]) -> None:
    f, g = (densities.mixture(parts) for parts in densities.FIG7)

    def geometric(x: float) -> float:
        return float(np.sqrt(f.pdf([x]) * g.pdf([x])))

    exact = sum(quad(geometric, a, a + 50, epsabs=1e-10)[0] for a in range(-150, 250, 50))
    found = rows["li-densities"]
    assert found["Fig. 7, grid integral", "GA mass"].ours == pytest.approx(exact, rel=1e-7)
    assert found["Fig. 7, cross terms sampled", "GA mass"].ours == pytest.approx(exact, rel=0.01)
    assert found["Fig. 7, cross terms dropped, (49)", "GA mass"].ours > 1.2 * exact


def test_the_remarks_on_densities(rows: dict[str, dict[tuple[str, str], Row]]) -> None:
    found = rows["li-densities"]
    assert found["moments against a grid integral", "largest relative difference"].ours < 1e-9
    assert found["random pairs", "GA/AA variance, most"].ours <= 1 + 1e-12
    assert found["random pairs, remark 7's cases", "GA/AA MSE, most"].ours <= 1 + 1e-12
    share = found["random pairs", "share with a cross-over"]
    assert share.stderr is not None
    assert share.ours > 5 * share.stderr
    assert found["three modes against two", "variance GA"].ours > found["three modes against two", "variance AA"].ours


# intensities


def test_the_grid_is_the_products_rules() -> None:
    """(49) and AA on the grid against the product of all choices of components; the exact GA below both."""
    grid, curves, _ = phd.fig7()
    pair = [densities.mixture(parts) for parts in densities.FIG7]
    for rule, f in (("aa", curves[0]), ("gm-ga", curves[2])):
        product = fuse_mixtures(rule, pair, weights="uniform", normalise=False)
        np.testing.assert_allclose(f, product.pdf(grid[:, None]), rtol=1e-9, atol=1e-12)
    assert (curves[1] <= curves[0] + 1e-15).all()
    assert (curves[1] <= curves[2] + 1e-15).all()
    assert curves[3].sum() == pytest.approx(curves[0].sum())


def test_peaks_have_the_mass_between_their_minima() -> None:
    f = 0.7 * norm.pdf(phd.GRID, 20, 3) + 0.9 * norm.pdf(phd.GRID, 100, 5) + 0.2 * norm.pdf(phd.GRID, 180, 4)
    mass, place = phd.peaks(f)
    np.testing.assert_allclose(mass, [0.9, 0.7, 0.2], atol=1e-6)
    np.testing.assert_allclose(place, [100, 20, 180])
    assert phd.states(mass, place)[0].tolist() == [100, 20]
    assert phd.states(mass, place)[1].tolist() == [100, 20]
    assert not len(phd.peaks(np.zeros(100))[0])


def test_reports_are_as_the_reading_says() -> None:
    given = phd.reports(np.random.default_rng(4), 3_000)
    seen, false = (given.weight[..., :5] > 0), (given.weight[..., 5:] > 0).sum(axis=-1)
    assert seen.mean() == pytest.approx(0.9, abs=5 * np.sqrt(0.09 / seen.size))
    assert false.mean() == pytest.approx(1.0, abs=5 / np.sqrt(false.size))
    assert false.var() == pytest.approx(1.0, abs=0.1)
    normalised = (given.mean[..., :5] - phd.TARGETS) / np.sqrt(given.variance[..., :5])
    assert normalised.var() == pytest.approx(1.0, abs=5 * np.sqrt(2 / normalised.size))


@pytest.mark.parametrize("way", phd.READ)
def test_more_sensors_make_ga_worse_and_aa_better(way: str, rows: dict[str, dict[tuple[str, str], Row]]) -> None:
    for sign, rules in ((1, ("GA exact", "GA (49)", "hybrid", "cells GA")), (-1, ("AA", "cells AA", "cells hybrid"))):
        for rule in rules:
            row = rows["li-phd"][f"GOSPA against sensors, {way}: {rule}", "8 less 2"]
            assert row.stderr is not None
            assert sign * row.ours > 3 * row.stderr, rule


@pytest.mark.parametrize("p", filters.DETECTIONS)
def test_filters_lose_targets_by_ga_with_and_without_missed_detections(
    p: float, rows: dict[str, dict[tuple[str, str], Row]]
) -> None:
    """Quick runs are few, but the loss of mass is some ten standard deviations of one."""
    found = rows["li-phd-filter"]
    mass = {
        (rule, N): found[f"mass - 5 against sensors, p = {p:g}: {rule}", f"N = {N}"].ours
        for rule in ("aa", "ga")
        for N in (1, 2, 8)
    }
    assert mass["ga", 8] < mass["ga", 2] - 0.3 < mass["ga", 1] - 1.0
    assert abs(mass["aa", 8]) < 1
    for way in filters.READ:
        gospa = {
            rule: found[f"GOSPA [m] against sensors, p = {p:g}, {way}: {rule}", "N = 8"].ours for rule in filters.RULES
        }
        assert gospa["ga"] > 1.5 * max(gospa["aa"], gospa["hybrid"])


def test_six_sensors_by_ga_and_by_aa(rows: dict[str, dict[tuple[str, str], Row]]) -> None:
    found = rows["li-phd"]
    exact, dropped, aa = (found[f"Fig. 8, rank: {rule}", "mass - 5"].ours for rule in ("GA exact", "GA (49)", "AA"))
    assert exact < -2 < aa < 1 < 5 < dropped
    false = [found[f"Fig. 8, rank: {rule}", "false"].ours for rule in ("GA exact", "AA")]
    assert false[0] < false[1]


def test_what_ga_loses_to_independent_errors() -> None:
    """The mean mass of the GA of N unit Gaussians in n dimensions at independent unit errors, by Monte Carlo."""
    rng, n, N = np.random.default_rng(5), 4, 6
    x = rng.standard_normal((200_000, N, n))
    apart = ((x - x.mean(axis=1, keepdims=True)) ** 2).sum(axis=(1, 2))
    mass = np.exp(-apart / (2 * N))
    expected = 1 + filters.independent_loss(N) / filters.TARGETS
    assert mass.mean() == pytest.approx(expected, abs=5 * mass.std() / np.sqrt(len(mass)))


@pytest.mark.parametrize("rule", filters.RULES)
def test_the_intensities_are_fused_as_by_the_centre(rule: str) -> None:
    rng = np.random.default_rng(6)
    truth = filters.walk(rng)
    reports = [filters.sensor(rng, truth, 0.9) for _ in range(3)]
    k = filters.LOOKED_AT[-1]
    parts = [filters.components(report[k], number) for number, report in enumerate(reports)]
    ours = filters.fused(parts)[filters.RULES.index(rule)]
    centre = IntensityCentre({"intensity_rule": rule})
    frame, time = schemas.Local("scene"), k * filters.SECOND
    for number, report in enumerate(reports):
        head: dict[str, Any] = {"source": f"s{number}", "epoch": 1, "frame": frame}
        info = schemas.SensorInfo(
            **head,
            seq=0,
            sent=0,
            position=(0.0, 0.0, 0.0),
            period=1.0,
            motion=filters.CONFIG.motion,
            coverage=schemas.Disk(1e6),
        )
        centre.handle(info, 0)
        centre.handle(schemas.LocalIntensity(**head, seq=1, sent=time, time=time, **report[k]), time)
    centre.step(time)
    assert centre.intensity is not None
    np.testing.assert_allclose(ours.weight, centre.intensity.weights, rtol=1e-9)
    np.testing.assert_allclose(ours.mean.T, centre.intensity.means, rtol=1e-9, atol=1e-9)


def test_the_scene_moves_as_the_filters_suppose() -> None:
    """Mean squared change of a velocity over a second is the noise's intensity; places follow velocities."""
    rng = np.random.default_rng(7)
    walks = np.stack([filters.walk(rng) for _ in range(400)])
    kicks = np.diff(walks[:, :, 2:], axis=1)
    assert (kicks**2).mean() == pytest.approx(filters.NOISE, rel=5 * np.sqrt(2 / kicks.size))
    drift = np.diff(walks[:, :, :2], axis=1) - walks[:, :-1, 2:]
    assert (drift**2).mean() == pytest.approx(filters.NOISE / 3, rel=5 * np.sqrt(2 / drift.size))


def test_notes_speak_of_every_remark(results: dict[str, Result]) -> None:
    spoken = " ".join(note for result in results.values() for note in result.notes)
    assert all(f"Remark {number}" in spoken for number in range(1, 11))
