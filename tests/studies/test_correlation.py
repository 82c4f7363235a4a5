"""Fusion of errors with known joint distributions (`studies/correlation.py`), local tracks' joint errors
(`studies/local_tracks.py`), and the two studies made of them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from fusion_service.rules import fuse
from sensor_clients.filters import RangeAzimuth, kalman, sigma_points
from sensor_clients.scenarios.three_radars import RADAR, TRACKER
from studies import report
from studies.correlation import (
    draws,
    excess,
    expected,
    independent,
    joint_of,
    largest_correlation,
    mse,
    optimal,
    rank_one,
    worst,
    worst_in_plane,
)
from studies.experiments import correlation_sweep as sweep
from studies.experiments import track_correlation as local
from studies.local_tracks import Model, Tracks, alike, filtered, planar, positions, steady
from studies.rules import fuser
from studies.study import Floats, Result, Row, Run, Study

CONSTANT = ("naive", "ci", "bci:max_correlation=0.5", "fast-ci", "ffcc", "ici", "ei")


def known(rule: str, P: Floats) -> tuple[Floats, Floats]:
    _, N, n, _ = P.shape
    found = expected(fuser(rule), P, independent(P), draws(np.random.default_rng(0), (N - 1) * n, 0))
    assert found.constant
    return found.gains, found.reported


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("rule", CONSTANT)
def test_no_admissible_correlation_is_worse_than_the_worst_and_one_reaches_it(rule: str, n: int) -> None:
    rng = np.random.default_rng(n)
    P = sweep.sources(rng, 3, 2, n)
    gains, reported = known(rule, P)
    for rho in (0.5, 1.0):
        bound, u = worst(gains, reported, P, rho)
        K = rank_one(gains, P, u, rho)
        assert np.linalg.eigvalsh(K).min() > -1e-12
        assert (np.linalg.norm(K[:, :n, n:], 2, axis=(1, 2)) <= rho + 1e-9).all()
        reached = excess(mse(gains, joint_of(P, K)), reported)
        np.testing.assert_allclose(reached, bound, rtol=1e-4)
        for i in range(3):
            tried = 1500
            K = sweep.correlations(rng, tried, n)
            U, s, V = np.linalg.svd(K)  # as often on the border of what is admissible, or of rank one
            s = np.where(rng.random((tried, 1)) < 0.5, 1.0, s) * (np.arange(n) < rng.integers(1, n + 1, (tried, 1)))
            K = rho * (U * s[:, None]) @ V
            J = joint_of(np.repeat(P[i : i + 1], tried, axis=0), sweep.whole(K))
            one = excess(mse(np.repeat(gains[i : i + 1], tried, axis=0), J), reported[i])
            assert one.max() <= bound[i] * (1 + 1e-9)
            assert one.max() >= (0.999, 0.97, 0.85)[n - 1] * bound[i]  # brute force comes near


def test_the_worst_case_by_a_search_over_directions_is_the_same() -> None:
    P = sweep.sources(np.random.default_rng(5), 40, 2, 2)
    for rule in CONSTANT:
        gains, reported = known(rule, P)
        for rho in (0.3, 0.9):
            bound, _ = worst(gains, reported, P, rho)
            searched, _ = worst_in_plane(gains, reported, P, rho)
            assert (searched <= bound * (1 + 1e-9)).all()
            np.testing.assert_allclose(searched, bound, rtol=1e-4)


def test_three_sources_reach_their_worst_case() -> None:
    P = sweep.sources(np.random.default_rng(6), 20, 3, 2)
    for rule in ("naive", "bci:max_correlation=0.5", "ci"):
        gains, reported = known(rule, P)
        bound, u = worst_in_plane(gains, reported, P, 0.5)
        K = rank_one(gains, P, u, 0.5)
        assert np.linalg.eigvalsh(K).min() > -1e-12
        np.testing.assert_allclose(excess(mse(gains, joint_of(P, K)), reported), bound, rtol=1e-4)


@pytest.mark.parametrize("rule", ["hmd-ga", "cu", "aa", "ici"])
def test_true_and_reported_covariance_agree_with_plain_monte_carlo(rule: str) -> None:
    rng = np.random.default_rng(7)
    P = sweep.sources(rng, 1, 2, 2)
    J = joint_of(P, sweep.whole(0.9 * sweep.correlations(rng, 1, 2)))
    found = expected(fuser(rule), P, J, draws(rng, 2, 40_000))
    M = 200_000
    e = (np.linalg.cholesky(J[0]) @ rng.standard_normal((4, M))).reshape(2, 2, M)
    fused = fuser(rule)(e, np.ascontiguousarray(np.broadcast_to(P[0][..., None], (2, 2, 2, M))))
    products = fused.mean[:, None] * fused.mean[None]
    for ours, samples in ((found.mse[0], products), (found.reported[0], fused.covariance)):
        error = samples.std(axis=-1) * np.sqrt(1 / M + 1 / 40_000)
        assert (np.abs(samples.mean(axis=-1) - ours) <= 5 * error + 1e-9).all()


def test_the_optimum_is_that_of_known_cross_covariance() -> None:
    rng = np.random.default_rng(8)
    P = sweep.sources(rng, 10, 2, 3)
    J = joint_of(P, sweep.whole(0.8 * sweep.correlations(rng, 10, 3)))
    reference = fuse("bar-shalom-campo", np.zeros((10, 2, 3)), P, cross_covariance=J[:, :3, 3:])
    np.testing.assert_allclose(optimal(J, 3), reference.covariance, rtol=1e-8)
    one = P[:, 0]
    np.testing.assert_allclose(optimal(np.tile(one, (1, 2, 2)), 3), one, rtol=1e-9)  # the same error twice


def test_the_average_is_conservative_as_its_formula_says() -> None:
    """MSE (P1 + P2 + C + C') / 4 against (P1 + P2) / 2 + E[dd'] / 4: the difference is (P1 + P2 - C - C') / 2 >= 0."""
    rng = np.random.default_rng(9)
    P = sweep.sources(rng, 20, 2, 3)
    J = joint_of(P, sweep.whole(sweep.correlations(rng, 20, 3)))
    found = expected(fuser("aa"), P, J, draws(rng, 3, 8))
    C = J[:, :3, 3:] + J[:, 3:, :3]
    both = P[:, 0] + P[:, 1]
    np.testing.assert_allclose(found.mse, (both + C) / 4, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.reported, both / 2 + (both - C) / 4, rtol=1e-9, atol=1e-9)


@cache
def swept(rule: str, n: int, N: int = 2) -> sweep.Found:
    return sweep.study(sweep.Task(2, 24, n, N, fuser(rule)))


def test_conservative_rules_are_and_bounded_inflation_is_tight() -> None:
    for n in (1, 2, 4):
        for rule in ("ci", "fast-ci", "ffcc", "aa", "cu"):
            limit = 1e-9 if rule in CONSTANT else 0.02  # Monte Carlo
            assert swept(rule, n).worst.max() <= 1 + limit, rule
        bci = swept("bci:max_correlation=0.5", n).worst
        np.testing.assert_allclose(bci[0], 1.0, atol=1e-9)
        assert bci[1:].mean() > 1.05
    assert swept("ffcc", 2).worst.max() <= 0.9 + 1e-9
    for rule in ("ci", "bci:max_correlation=0.5"):
        assert swept(rule, 2, 3).worst[0].max() <= 1 + 1e-9


def test_the_others_are_too_sure_and_more_so_in_more_dimensions() -> None:
    for rule in ("ici", "ei", "hmd-ga"):
        last = swept(rule, 4).worst[-1]
        assert last.mean() > 1.2, rule
        assert last.max() > 1.6, rule
    naive = [swept("naive", n).worst[-1].mean() for n in (1, 2, 4)]
    assert naive[0] < naive[1] < naive[2] <= 2 + 1e-9
    np.testing.assert_allclose(swept("naive", 2).average[0], 1.0, rtol=1e-9)  # independent: exact
    np.testing.assert_allclose(swept("naive", 2).reported[0], 0.0, atol=1e-9)


def test_a_rule_of_ones_own_is_judged_exactly_too(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The average of the means under that of the covariances is conservative whatever the correlation; the other
    process finds the function again by its file."""
    monkeypatch.setattr(sweep, "RULE_NAMES", ("naive", "ci", "fast-ci", "hmd-ga"))
    own = tmp_path / "own.py"
    own.write_text("def half(means, covariances):\n    return means.mean(axis=1), covariances.mean(axis=1)\n")
    result = sweep.run(Run(8, 1, rules=(fuser(f"{own}:half"),), jobs=2))
    rows = [row for row in result.rows if row.name == "own.half" and row.quantity.startswith("worst")]
    assert len(rows) == 3 * 6 + 3
    assert all(row.ours <= 1 + 1e-9 for row in rows)


def simulated(model: Model, start: Tracks, steps: int, M: int, seed: int) -> tuple[Floats, Floats]:
    """Errors (N, n, M) of Kalman filters of their own, and the covariances (N, n, n) that they report."""
    rng = np.random.default_rng(seed)
    N, n, d = model.H.shape[0], len(model.F), model.R.shape[1]

    def noise(P: Floats, size: tuple[int, ...] = (M,)) -> Floats:
        return np.asarray(rng.multivariate_normal(np.zeros(len(P)), P, size, method="eigh").T)

    truth = np.zeros((n, M))
    e = noise(start.J[0]).reshape(N, n, M)
    filters = [kalman.Estimate(e[i], np.repeat(start.P[0, i][..., None], M, axis=-1)) for i in range(N)]
    true = model.Q if model.true is None else model.true
    b = model.shared * rng.standard_normal((d, M))
    for _ in range(steps):
        truth = model.F @ truth + noise(true)
        b = model.decay * b + np.sqrt(1 - model.decay**2) * model.shared * rng.standard_normal((d, M))
        for i in range(N):
            z = model.H[i] @ truth + b + noise(model.R[i])
            predicted = kalman.predict(filters[i], model.F, model.Q)
            R = model.R[i] + model.shared**2 * np.eye(d)
            filters[i] = kalman.update(predicted, model.H[i], R, z)
    return np.stack([one.mean - truth for one in filters]), np.stack([one.covariance[..., 0] for one in filters])


FERRY = positions(1.0, 0.05, (3.0, 4.0))


@pytest.mark.parametrize(
    ("model", "steps"),
    [
        (positions(1.0, 0.1, (1.0, 3.0)), 25),
        (positions(1.0, 10.0, (1.0, 2.0, 3.0)), 10),
        (positions(1.0, 0.0, (1.0, 1.0)), 5),
        (positions(1.0, 0.1, (1.0, 1.0))._replace(true=np.zeros((4, 4))), 15),
        (FERRY._replace(shared=3.0), 20),
        (FERRY._replace(shared=3.0, decay=0.95), 20),
    ],
    ids=["two", "three", "prior", "straight", "white", "coloured"],
)
def test_joint_covariances_are_those_of_simulated_filters(model: Model, steps: int) -> None:
    N, M = len(model.H), 20_000
    start = alike(np.diag([4.0, 1.0, 4.0, 1.0]), N)
    e, reported = simulated(model, start, steps, M, seed=3)
    found = filtered(start, model, steps)
    np.testing.assert_allclose(found.P[0], reported, rtol=1e-9)
    e = e.reshape(-1, M)
    products = e[:, None] * e[None]
    error = products.std(axis=-1) / np.sqrt(M)
    assert (np.abs(products.mean(axis=-1) - found.J[0]) < 5 * error).all()


def test_a_common_prior_fades_as_in_closed_form() -> None:
    """A constant, P0 = 1, R = 4: after k measurements P = 1 / (1 + k / 4), P12 = P^2 / P0, so the correlation is P."""
    one = np.ones((1, 1))
    model = Model(one, 0 * one, np.ones((2, 1, 1)), np.full((2, 1, 1), 4.0))
    for k in (1, 3, 10):
        tracks = filtered(alike(one, 2), model, k)
        assert largest_correlation(tracks.J, tracks.P)[0] == pytest.approx(1 / (1 + k / 4), rel=1e-12)


def test_steady_states_are_steady_and_forget_their_start() -> None:
    for model in (positions(1.0, 0.001, (1.0, 3.0)), positions(1.0, 10.0, (1.0, 1.0))):
        first, second = steady(model), steady(model, 190)
        np.testing.assert_allclose(first.J, second.J, rtol=1e-6, atol=1e-9)
    memory = positions(1.0, 0.1, (1.0, 1.0))
    for rule, bound in (("naive", 0.0), ("ci", 0.5)):
        first, second = local.remembered(memory, rule, bound), local.remembered(memory, rule, bound, 75)
        np.testing.assert_allclose(first.J, second.J, rtol=1e-6, atol=1e-9)


def test_memory_and_feedback_are_those_of_simulated_filters() -> None:
    """Memory: CI of two local tracks and of the last result with it. Feedback: both filters go on from the CI."""
    M, steps = 20_000, 8
    rng = np.random.default_rng(4)
    model = positions(1.0, 0.1, (1.0, 2.0))

    def ci(first: kalman.Estimate, second: kalman.Estimate) -> kalman.Estimate:
        fused = fuser("ci")(np.stack([first.mean, second.mean]), np.stack([first.covariance, second.covariance]))
        return kalman.Estimate(fused.mean, fused.covariance)

    for feedback in (False, True):
        P0 = steady(model).P[0, 0]
        start = kalman.Estimate(np.linalg.cholesky(P0) @ rng.standard_normal((4, M)), np.repeat(P0[..., None], M, -1))
        truth, tracks, last = np.zeros((4, M)), [start, start], start
        for _ in range(steps):
            truth = model.F @ truth + np.linalg.cholesky(model.Q) @ rng.standard_normal((4, M))
            for i in range(2):
                z = model.H[i] @ truth + np.sqrt(model.R[i]) @ rng.standard_normal((2, M))
                before = last if feedback else tracks[i]
                tracks[i] = kalman.update(kalman.predict(before, model.F, model.Q), model.H[i], model.R[i], z)
            new = ci(*tracks)
            two = tracks if feedback else [kalman.predict(last, model.F, model.Q), new]
            last = new if feedback else ci(*two)
        found = local.fed_back(model, P0, "ci", steps) if feedback else local.remembered(model, "ci", 1.0, steps)
        e = np.concatenate([one.mean - truth for one in two])
        products = e[:, None] * e[None]
        error = products.std(axis=-1) / np.sqrt(M)
        assert (np.abs(products.mean(axis=-1) - found.J[0]) < 5 * error).all()
        np.testing.assert_allclose([one.covariance[..., 0] for one in two], found.P[0], rtol=1e-6)


@pytest.mark.parametrize("manoeuvring", [False, True])
def test_radars_agree_with_simulated_cubature_filters(manoeuvring: bool) -> None:
    """Range and azimuth taken as they are, not linearised: the largest correlation of one pair, by Monte Carlo."""
    rng, M = np.random.default_rng(6), 1500
    where = local.sightings()[:, 0]  # (K, 2, 2)
    F, Q = planar(RADAR.period, TRACKER.motion.q)
    model = RangeAzimuth(RADAR.sigma_range, RADAR.sigma_azimuth)
    R = np.diag([RADAR.sigma_range**2, RADAR.sigma_azimuth**2])
    speed = (where[1, 0] - where[0, 0]) / RADAR.period
    guess = speed[:, None] + TRACKER.sigma_speed * rng.standard_normal((2, M))  # the same for both radars
    found = local.radars(manoeuvring)
    away = np.zeros((4, M))
    filters = []
    rule = sigma_points.cubature(4)

    def sighting(i: int, k: int) -> Floats:
        return model.observe(where[k, i][:, None] + away[::2]) + np.sqrt(R) @ rng.standard_normal((2, M))

    for i in range(2):
        r, angle = sighting(i, 0)
        mean = np.stack([r * np.cos(angle), guess[0], r * np.sin(angle), guess[1]])
        turn = np.array([[np.cos(angle), -r * np.sin(angle)], [np.sin(angle), r * np.cos(angle)]])
        P = np.zeros((4, 4, M))
        P[::2, ::2] = np.einsum("ikm,kl,jlm->ijm", turn, R, turn)
        P[1, 1] = P[3, 3] = TRACKER.sigma_speed**2
        filters.append(kalman.Estimate(mean, P))
    for k in range(1, len(where)):
        away = F @ away + (np.linalg.cholesky(Q) @ rng.standard_normal((4, M)) if manoeuvring else 0.0)
        for i in range(2):
            z = sighting(i, k)
            before = kalman.predict(filters[i], F, Q)
            filters[i] = sigma_points.update(rule, lambda x: model.observe(x[::2]), before, R, z)
    nominal = np.stack(
        [where[-1, :, 0], np.broadcast_to(speed[0], 2), where[-1, :, 1], np.broadcast_to(speed[1], 2)], 1
    )
    e = np.concatenate([filters[i].mean - nominal[i][:, None] - away for i in range(2)])
    J = np.cov(e)
    claimed = np.linalg.cholesky(found.P[0])
    ours = largest_correlation(found.J[:1], found.P[:1])[0]
    W = [np.linalg.inv(L) for L in claimed]
    sampled = np.linalg.norm(W[0] @ J[:4, 4:] @ W[1].T, 2)
    # the norm of a (4, 4) matrix of sampling errors of about 1 / sqrt(M): below 4 / sqrt(M)
    assert abs(sampled - ours) < 4 / np.sqrt(M)


@cache
def tracked() -> Result:
    return local.run(Run(400, 1))


def test_bounds_hold_where_tracks_are_honest() -> None:
    rows = {(row.name, row.quantity): row.ours for row in tracked().rows}
    names = {name for name, _ in rows}
    honest = {name for name in names if rows[name, "correlation: a track's own true / reported"] <= 1 + 1e-6}
    assert 15 < len(honest) < len(names)
    for name in honest:
        assert rows[name, "excess: ci"] <= 1 + 1e-6, name
        assert rows[name, "excess: bci"] <= 1 + 1e-6, name
        bound = rows[name, "correlation: largest"]
        assert rows[name, "correlation: largest in position"] <= bound <= 1 + 1e-6
        over = rows[name, "excess: bci:max_correlation=0.5"]
        assert over <= 1 + 1e-6 if bound <= 0.5 else over > 1, name
    for name in names - honest:
        assert rows[name, "excess: naive"] > 1.8


def test_what_is_said_of_the_scenarios_holds() -> None:
    rows = {(row.name, row.quantity): row.ours for row in tracked().rows}
    largest = {name: value for (name, quantity), value in rows.items() if quantity == "correlation: largest"}
    assert all(0.7 < value < 0.85 for name, value in largest.items() if name.startswith("process noise"))
    assert largest["radars, straight"] < 0.01
    assert largest["Li-AA, feedback of ci"] == pytest.approx(1.0, abs=1e-6)


def test_many_quantities_in_groups_become_a_table_each() -> None:
    names = [f"{head}: n = {n}" for head in ("first", "second") for n in range(5)]
    result = Result(tuple(Row(rule, name, None, 1.5) for rule in ("ci", "naive") for name in names))
    study = Study("one", "One", "our own", "", lambda run: result, 1, 1, 1.0)
    lines = report._tables(study, report.as_json(study, Run(1), result))
    head = "| | n = 0 | n = 1 | n = 2 | n = 3 | n = 4 |"
    assert lines[:5] == [
        "First:",
        "",
        head,
        "|---|---|---|---|---|---|",
        "| ci | 1.500 | 1.500 | 1.500 | 1.500 | 1.500 |",
    ]
    assert lines[6:10] == ["", "Second:", "", head]


def test_what_is_derived_of_filters_is_their_joint_covariance() -> None:
    """From the covariances alone, three filters that started from one estimate; and nothing is left of that."""
    tracks = steady(positions(1.0, 0.1, (1.0, 2.0, 3.0)), 300)
    assert tracks.derived is not None
    assert tracks.left is not None
    J = tracks.J.reshape(1, 3, 4, 3, 4).swapaxes(2, 3)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        np.testing.assert_allclose(tracks.derived[:, i, j], J[:, i, j], rtol=1e-9, atol=1e-12)
    assert np.abs(tracks.left).max() < 1e-12
