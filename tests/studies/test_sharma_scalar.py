"""The weights of scalar estimates against quadrature and against (77) maximised by scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.stats import norm

from studies.experiments import sharma_scalar as scalar
from studies.rules import fuser
from studies.study import Run


@pytest.mark.parametrize(("Q", "rho"), [(0.3, -0.5), (1.0, 0.5), (3.0, 0.9)])
def test_the_first_weight_has_the_mean_that_quadrature_gives(Q: float, rho: float) -> None:
    """At the first instant the prior's variance is 1 + Q and d ~ N(0, 2 + Q + 2 rho sqrt Q)."""
    one = scalar.walk(fuser("hmd-ga"), np.array([Q]), np.array([rho]), np.random.default_rng(1), 40_000)
    sigma = np.sqrt(2 + Q + 2 * rho * np.sqrt(Q))

    def weight(d: float) -> float:
        found = minimize_scalar(
            lambda w: -((1 - w) * (1 + Q) + w + w * (1 - w) * d * d),
            bounds=(0, 1),
            method="bounded",
            options={"xatol": 1e-9},
        )
        return float(found.x * norm.pdf(d, scale=sigma))

    exact = 2 * quad(weight, np.sqrt(Q), 12 * sigma, limit=200)[0]  # below sqrt(Q) it is 0
    assert abs(one.over_time[0, 0] - exact) < 4.5 * 0.25 / np.sqrt(40_000)  # it lies within 0 and 1/2


def test_the_rule_chooses_the_weight_where_77_is_best() -> None:
    rng = np.random.default_rng(2)
    variances, d = 10 ** rng.uniform(-1, 1, (2, 200)), 3 * rng.standard_normal(200)
    w = fuser("hmd-ga")(np.stack([np.zeros(200), d])[:, None], variances[:, None, None]).weights[0]
    np.testing.assert_allclose(w, scalar.best(variances, d), atol=1e-7)
    for k in range(200):
        a, b = variances[:, k]
        found = minimize_scalar(
            lambda t: -((1 - t) * a + t * b + t * (1 - t) * d[k] ** 2),  # noqa: B023
            bounds=(0, 1),
            method="bounded",
            options={"xatol": 1e-10},
        )
        assert w[k] == pytest.approx(found.x, abs=1e-5)


def test_ci_and_ici_leave_the_measurement() -> None:
    """So their mean squared error is R and their weights those of (78) and (79)."""
    for label, weight in (("ci", 0.0), ("ici", 1.0)):
        one = scalar.walk(fuser(label), np.array([0.5]), np.array([-0.7]), np.random.default_rng(3), 2_000)
        np.testing.assert_allclose(one.weight, weight, atol=1e-9)
        np.testing.assert_allclose(one.reported, 1.0, rtol=1e-9)
        runs, instants = one.squared.shape[1], scalar.STEPS - scalar.WARM
        assert abs(one.squared.mean() - 1.0) < 4.5 * np.sqrt(2 / (runs * instants))


def test_the_published_weight_comes_out_at_the_plainest_choice_and_depends_on_it() -> None:
    rows = {(row.name, row.quantity): row for row in scalar.run(Run(1_000, 4)).rows}
    assert rows["hmd-ga: weight at Q/R = 1", "rho = 0.5"].ours == pytest.approx(0.2, abs=0.02)
    over_ratio = [rows[f"hmd-ga: weight at Q/R = {q:g}", "rho = 0.5"].ours for q in scalar.RATIOS]
    assert over_ratio == sorted(over_ratio, reverse=True)
    assert over_ratio[0] > 0.5
    assert over_ratio[-1] < 0.15
    unsure = rows["hmd-ga: MSE / reported at Q/R = 10", "rho = -0.9"]
    assert unsure.stderr is not None
    assert unsure.ours > 1 + 3 * unsure.stderr
