"""The sonobuoys' world and its studies: against dense and numerical answers, and what they claim."""

from __future__ import annotations

import itertools
import multiprocessing

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import chi2

from studies import sonobuoy_scores as scores
from studies import sonobuoys
from studies.experiments import dubey_consensus, dubey_sonobuoys
from studies.rules import fuser
from studies.sonobuoys import CT, CV, KNOT, Q1, SIGMA, STEPS, Readings, Scenario, T
from studies.study import Floats, Run


@pytest.mark.parametrize("turn", [0.0, CT.turn, 0.05, -0.2])
def test_the_noise_of_a_turn_is_the_integral_of_its_model(turn: float) -> None:
    """Q = integral of G(u) G(u)' q1, G(u) what a unit of velocity becomes in the time u that is left; with the signs
    printed in (5) it is not."""
    u = np.linspace(0.0, T, 20_001)
    a = turn * u
    s, c = (np.sin(a) / turn, (1 - np.cos(a)) / turn) if turn else (u, 0 * u)
    G = np.array([[s, -c], [c, s], [np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    exact = Q1 * np.trapezoid(np.einsum("iku,jku->iju", G, G), u, axis=-1)
    ours = sonobuoys.noise(CT, np.array(turn))
    scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
    np.testing.assert_allclose(ours[:4, :4] / scale, exact / scale, atol=1e-8)
    if abs(turn) > 0.01:
        printed = ours[:4, :4].copy()
        printed[[0, 3, 1, 2], [3, 0, 2, 1]] *= -1
        assert np.abs(printed / scale - exact / scale).max() > 1e-2
    np.testing.assert_allclose(ours[4, 4], sonobuoys.Q2 * T)


@pytest.mark.parametrize("scenario", [CV, CT])
def test_the_path_is_that_of_its_differential_equation(scenario: Scenario) -> None:
    """And goes through the sub-regions in the paper's order: 4 first, 1 last; with the turn 2 between them."""
    turn = scenario.turn or 0.0
    x = scenario.state()
    path = [x[:2]]
    for _ in range(STEPS):
        x = sonobuoys.move(x[:, None])[:, 0]
        path.append(x[:2])
    line = solve_ivp(
        lambda t, s: [s[2], s[3], -turn * s[3], turn * s[2]], (0, T * STEPS), scenario.state()[:4], rtol=1e-9, atol=1e-6
    )
    np.testing.assert_allclose(x[:4], line.y[:, -1], atol=1e-2)
    squares = [int(p[0] > 5000) + 2 * int(p[1] > 5000) + 1 for p in path]
    assert [one for one, _ in itertools.groupby(squares)] == ([4, 2, 1] if scenario.turn else [4, 3, 1])
    assert np.all((np.array(path) > 0) & (np.array(path) < 10_000))


def test_triangulation_is_exact_without_noise_and_its_covariance_that_of_many_draws() -> None:
    rng = np.random.default_rng(1)
    place, sensors = np.array([4000.0, 3000.0]), np.array([[1000.0, 5200.0], [900.0, 1500.0]])
    z = np.arctan2(*(place[:, None] - sensors))
    at, P = sonobuoys.triangulate(sensors[..., None], z[:, None])
    np.testing.assert_allclose(at[:, 0], place, atol=1e-6)
    sigma = 0.1 * SIGMA  # small: (33) is of first order
    M = 200_000
    drawn, _ = sonobuoys.triangulate(np.repeat(sensors[..., None], M, -1), z[:, None] + sigma * rng.normal(size=(2, M)))
    error = np.trace(P[..., 0]) * np.sqrt(2 / M)
    np.testing.assert_allclose(np.cov(drawn) * (SIGMA / sigma) ** 2, P[..., 0], atol=5 * error)


def test_sensors_are_selected_as_by_trying_every_set() -> None:
    """The best pair always; of three sensors, one at a time, within 15 % of the best set's trace and 2 % on average."""
    rng = np.random.default_rng(2)
    sensors = 5000 * rng.random((2, 12, 40))
    place = np.array([[6000.0], [4000.0]]) + 3000 * rng.normal(size=(2, 40))

    def trace(b: int, chosen: tuple[int, ...]) -> float:
        d = place[:, b, None] - sensors[:, chosen, b]
        H = np.stack([d[1], -d[0]]) / (d**2).sum(axis=0)
        return float(np.trace(np.linalg.inv(H @ H.T)))

    for count in (2, 3):
        chosen = sonobuoys.select(place, sensors, count)
        ratios = []
        for b in range(40):
            best = min(trace(b, one) for one in itertools.combinations(range(12), count))
            ratios.append(trace(b, tuple(chosen[:, b])) / best)
        assert max(ratios) < (1 + 1e-9 if count == 2 else 1.15)
        assert np.mean(ratios) < 1.02
    farthest = sonobuoys.select(place, sensors, 2, inverse=False)
    r = np.hypot(*(place[:, None] - sensors))
    np.testing.assert_array_equal(np.sort(farthest, axis=0), np.sort(np.argsort(r, axis=0)[-2:], axis=0))


@pytest.mark.parametrize(("scenario", "name"), [(CV, "SRF"), (CV, "CKF"), (CT, "SRF"), (CT, "UKF")])
def test_tracks_are_as_wide_as_their_errors(scenario: Scenario, name: str) -> None:
    """Mean NEES of 200 runs at 8 times within 5 standard errors of n, or 6 % (the filters are not exact)."""
    rng = np.random.default_rng(3)
    true, tracks = sonobuoys.fly(scenario, rng, np.repeat(sonobuoys.field(rng, 20), 10, -1), name=name)
    at = slice(40, None, 13)
    for j in range(4):
        nees = scores.errors(true[at], tracks.means[at, j], tracks.covariances[at, j])[2].mean(axis=0)
        n = scenario.n
        assert abs(nees.mean() - n) < 5 * nees.std() / np.sqrt(len(nees)) + 0.06 * n, (j, nees.mean())


def test_after_a_consensus_all_trackers_have_one_density_and_the_truth_is_the_same() -> None:
    layout = sonobuoys.field(np.random.default_rng(4), 3)
    apart, alone = sonobuoys.fly(CV, np.random.default_rng(5), layout, steps=20)
    together, fused = sonobuoys.fly(CV, np.random.default_rng(5), layout, consensus=fuser("hmd-ga"), steps=20)
    np.testing.assert_array_equal(apart, together)
    assert np.all(fused.means == fused.means[:, :1])
    assert np.any(alone.means != alone.means[:, :1])
    assert fused.weights is not None
    np.testing.assert_allclose(fused.weights.sum(axis=1), 1.0)


def test_the_bounds_are_those_of_chi_squared() -> None:
    """(34), (35) are Wilson and Hilferty's approximation."""
    for n, runs in ((4, 50), (5, 1000)):
        exact = chi2.ppf([0.025, 0.975], n * runs) / runs
        np.testing.assert_allclose(scores.bounds(n, runs), exact, rtol=2e-4)


@pytest.fixture(scope="module")
def quick() -> dict[tuple[str, str], tuple[float, float]]:
    result = dubey_sonobuoys.STUDIES[0].run(Run(40, 7))
    return {(row.name, row.quantity): (row.ours, row.stderr or 0.0) for row in result.rows}


def test_what_the_study_of_constant_velocity_says(quick: dict[tuple[str, str], tuple[float, float]]) -> None:
    """40 runs in two layouts. Fused by det weights the track is better than the best local one, and the nearest tracker
    weighs most; by dispersion of divergences it weighs less than that; the mean (AMD) is far too wide."""
    position = "n = 2: position, m"
    best = min(quick[f"Track-{j}", position][0] for j in range(1, 5))
    assert quick["HMD det", position][0] < 0.9 * best
    assert quick["HMD det", "mean weight of the nearest tracker"][0] > 0.6
    assert quick["HMD det", "mean weight of the farthest tracker"][0] < 0.1
    assert quick["HMD (23)", "mean weight of the nearest tracker"][0] < 0.4
    assert quick["AMD equal", "fusions: ANEES"][0] < 2.5
    assert quick["GMD equal", "fusions: ANEES"][0] < 3.5
    for n, fewer in ((3, 2), (4, 3)):
        for j in range(1, 5):
            more, less = (quick[f"Track-{j}", f"n = {k}: position, m"] for k in (n, fewer))
            assert more[0] < less[0] + 3 * np.hypot(more[1], less[1])
    for name in ("CKF", "UKF"):
        ours, srf = quick[name, "filters, HMD equal: position, m"], quick["HMD equal", position]
        assert abs(ours[0] - srf[0]) < 0.15 * srf[0], "all filters do the same"


def test_lost_runs_are_counted_and_left_out() -> None:
    stats: Floats = np.zeros((3, 5, 1, 4))
    stats[0, -1, 0, 0] = 1.1e6
    stats[0, 2, 0, 1] = 1.1e6
    stats[0, 3, 0, 2] = np.nan
    stats[0, :, 0, 3] = 9.0
    assert scores.lost(stats).tolist() == [[True, False, True, False]]
    assert scores.lost(stats, at_end=False).tolist() == [[True, True, True, False]]
    stats[0, 2, 0, 1] = 0.0
    assert scores.averages(stats)[0, 0] == pytest.approx(np.sqrt(4.5))


def test_readings_change_what_they_name() -> None:
    layout = sonobuoys.field(np.random.default_rng(6), 200)

    def first(readings: Readings) -> Floats:
        true, tracks = sonobuoys.fly(CV, np.random.default_rng(7), layout, readings=readings, steps=1)
        return np.asarray(tracks.means[0, :, 2:] - true[0, 2:])

    assert np.sqrt(np.mean(first(Readings()) ** 2)) == pytest.approx(0.5 * KNOT / np.sqrt(3), rel=0.1)
    assert np.allclose(first(Readings("zero")), -CV.state()[2:, None])
    assert np.median(np.abs(first(Readings("triangulated")))) > 5 * KNOT


def test_four_real_nodes_agree_with_each_other_and_with_the_batch() -> None:
    result = dubey_consensus.STUDIES[0].run(Run(1, 11))
    values = {(row.name, row.quantity): row.ours for row in result.rows}
    for mode in dubey_consensus.MODES:
        assert values[mode, "rounds of every node"] == dubey_consensus.SHORT + 1
        assert values[mode, "all four nodes have the same bits, % of rounds"] == 100
        assert values[mode, "local tracks in a fused one, fewest"] == 4
        assert values[mode, "largest difference from the batch, sigma"] < 1e-9
    assert values["both", "messages refused"] == 0
    assert not multiprocessing.active_children()
