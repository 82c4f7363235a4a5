"""`li-nonlinear`: the model against the differential equation, and what the table claims."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from studies import li_tables
from studies.experiments import li_nonlinear
from studies.experiments.li_nonlinear import MODEL, Q
from studies.feedback import Record
from studies.statistics import mean
from studies.study import Run


@pytest.fixture(scope="module")
def found() -> dict[str, Record]:
    return li_tables.records(Run(20, 2), MODEL, "ckf", exact=True)


@pytest.mark.parametrize("omega", [-np.pi / 60, 0.3, 1e-9, 0.0])
def test_a_step_is_the_turn_of_the_differential_equation(omega: float) -> None:
    x = np.array([1000.0, 20.0, 900.0, -7.0, omega])

    def turning(t: float, s: np.ndarray) -> list[float]:
        return [s[1], -omega * s[3], s[3], omega * s[1]]

    end = solve_ivp(turning, (0.0, 1.0), x[:4], rtol=1e-11, atol=1e-9).y[:, -1]
    np.testing.assert_allclose(li_nonlinear.turn(x[:, None])[:, 0], [*end, omega], rtol=1e-9)


def test_the_truth_moves_with_the_noise_the_filter_assumes() -> None:
    M = 200_000
    still = np.zeros((5, M))
    moved = MODEL.move(np.random.default_rng(1), still)
    scale = np.sqrt(np.diag(Q))
    np.testing.assert_allclose(
        np.cov(moved) / np.outer(scale, scale), Q / np.outer(scale, scale), atol=5 * np.sqrt(2 / M)
    )


def test_bearings_wrap() -> None:
    d = li_nonlinear.difference(np.array([[5.0], [3.1]]), np.array([[3.0], [-3.1]]))
    np.testing.assert_allclose(d[:, 0], [2.0, 6.2 - 2 * np.pi])


def above(found: dict[str, Record], a: str, b: str) -> float:
    """By how many standard errors the mean squared position error of `a` is above that of `b`, run by run."""
    got = mean((found[a].squared[0] - found[b].squared[0]).mean(axis=0))
    return got.value / got.stderr


def test_what_the_table_says(found: dict[str, Record]) -> None:
    for kind in ("ckf", "sir"):
        assert above(found, f"{kind}-nf", f"{kind}-noncoop") > 2
    for name in ("ic", "aa", "ci 1/det"):
        assert above(found, "ckf-noncoop", f"ckf-{name}") > 2


def test_the_weight_of_sensor_1_falls_from_584_to_541_thousandths(found: dict[str, Record]) -> None:
    """At the first and the last step, within 4 standard errors of ours and 0.005 of reading off Fig. 11."""
    weight = found["ckf-aa"].weight
    for step, printed in ((0, 0.584), (-1, 0.541)):
        got = mean(weight[step])
        assert abs(got.value - printed) < 4 * got.stderr + 0.005
    assert mean(weight[0] - weight[-1]).value > 0
