"""`li-linear`: errors against exact covariance recursions, and what the table claims."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from studies import li_tables
from studies.experiments import li_linear
from studies.experiments.li_linear import MODEL, F, H, Q
from studies.feedback import Record
from studies.rules import fuser
from studies.statistics import armse
from studies.study import Floats, Run

RUNS = 30
R = [np.diag(sigma**2) for sigma in li_linear.SIGMA]


@pytest.fixture(scope="module")
def found() -> dict[str, Record]:
    return li_tables.records(Run(RUNS, 3, rules=(fuser("ci:weights=uniform"),)), MODEL, "kf", exact=False)


def exact(kind: str) -> tuple[float, float]:
    """ARMSE of a filter whose gains do not depend on the data, from the recursion of its true error covariance."""
    P: Floats = MODEL.covariance
    T: Floats = P
    out = []
    for _ in range(MODEL.steps):
        P, T = F @ P @ F.T + Q, F @ T @ F.T + Q
        if kind in ("noncoop", "ic"):
            A, V, J = (H, R[0], 1) if kind == "noncoop" else (np.vstack([H, H]), np.diag([400.0, 400, 1600, 1600]), 2)
            assert len(A) == 2 * J
            K = P @ A.T @ np.linalg.inv(A @ P @ A.T + V)
            keep, gains, noises = np.eye(4) - K @ A, [K], [V]
            P = keep @ P
        else:
            local = [P @ H.T @ np.linalg.inv(H @ P @ H.T + V) for V in R]
            information = [np.linalg.inv((np.eye(4) - K @ H) @ P) for K in local]
            w = 1.0 if kind == "nf" else 0.5
            P = np.linalg.inv(w * (information[0] + information[1])).astype(np.float64)
            share = [w * P @ one for one in information]
            gains, noises = [S @ K for S, K in zip(share, local, strict=True)], R
            keep = sum(S @ (np.eye(4) - K @ H) for S, K in zip(share, local, strict=True))
        T = keep @ T @ keep.T + sum(G @ V @ G.T for G, V in zip(gains, noises, strict=True))
        out.append([np.sqrt(T[0, 0] + T[2, 2]), np.sqrt(T[1, 1] + T[3, 3])])
    position, velocity = np.mean(out, axis=0)
    return float(position), float(velocity)


@pytest.mark.parametrize(
    ("kind", "name"),
    [("noncoop", "noncoop"), ("ic", "ic"), ("nf", "nf"), ("half", "ci w1 = 1/2"), ("half", "ci:weights=uniform")],
)
def test_errors_are_those_of_the_exact_recursion(found: dict[str, Record], kind: str, name: str) -> None:
    """Within 4 standard errors; a rule added on the command line goes the same way."""
    for squared, value in zip(found[f"kf-{name}"].squared, exact(kind), strict=True):
        got = armse(squared)
        assert abs(got.value - value) < 4 * got.stderr


@pytest.mark.parametrize("kind", ["noncoop", "ic", "nf"])
def test_the_printed_table_is_that_of_the_model_with_feedback(kind: str) -> None:
    """The exact values lie within 2 % of the printed averages over 100 runs (of NF, whose error wanders, 4 %)."""
    assert exact(kind) == pytest.approx(li_linear.PUBLISHED[f"kf-{kind}"], rel=0.04 if kind == "nf" else 0.02)


def difference(found: dict[str, Record], a: str, b: str) -> float:
    """By how many standard errors the mean squared position error of `a` is above that of `b`, run by run."""
    away = (found[a].squared[0] - found[b].squared[0]).mean(axis=0)
    return float(away.mean() / (away.std(ddof=1) / np.sqrt(len(away))))


def test_what_the_table_says(found: dict[str, Record]) -> None:
    for kind in ("kf", "sir"):
        assert difference(found, f"{kind}-nf", f"{kind}-noncoop") > 5
        assert difference(found, f"{kind}-noncoop", f"{kind}-aa") > 2
    for name in li_tables.FUSION:
        if name != "ic":
            assert difference(found, f"kf-{name}", "kf-ic") > 2
    np.testing.assert_allclose(found["kf-ci"].squared, found["kf-noncoop"].squared, rtol=1e-6)  # the optimum is w1 = 1
    weight = found["kf-aa"].weight
    assert abs(weight.mean() - 0.575) < 0.005
    assert weight.std() < 0.1


def test_without_feedback_the_naive_rule_is_no_worse_than_one_sensor(found: dict[str, Record]) -> None:
    assert difference(found, "kf-noncoop", "kf-nf without feedback") > 2


def test_the_number_of_processes_does_not_matter() -> None:
    model = replace(MODEL, steps=2, particles=20)
    runs = li_tables.CHUNK + 3
    one, two = (li_tables.records(Run(runs, 5, jobs=jobs), model, "kf", exact=False) for jobs in (1, 2))
    assert list(one) == list(two)
    for name in one:
        np.testing.assert_array_equal(one[name].squared, two[name].squared)


def test_the_truth_moves_with_the_noise_the_filter_assumes() -> None:
    rng = np.random.default_rng(1)
    x: Floats = np.repeat(MODEL.mean[:, None], 200_000, axis=1)
    after = MODEL.move(rng, x)
    np.testing.assert_allclose(np.cov(after), Q, atol=5 * 25 * np.sqrt(2 / 200_000))
    np.testing.assert_allclose(after.mean(axis=1), F @ MODEL.mean, atol=5 * 5 / np.sqrt(200_000))
