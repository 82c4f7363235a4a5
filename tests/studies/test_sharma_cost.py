"""What is timed is the same fusion three ways; the median's error is what it is said to be."""

from __future__ import annotations

import numpy as np
import pytest

from studies.experiments import sharma_cost as cost
from studies.rules import fuser
from studies.study import Run


@pytest.mark.parametrize("label", cost.PUBLISHED)
@pytest.mark.parametrize("n", [2, 4])
def test_the_script_and_the_rule_fuse_alike(label: str, n: int) -> None:
    """Weights of the script are found to about 1e-5; fusions differ by as much."""
    x, P = cost.pairs(np.random.default_rng(1), n, 20)
    fused = fuser(label)(x, P)
    for k in range(20):
        mean, covariance = cost.script(label, x[..., k], P[..., k])
        # EI's mean: regularisations of the two differ by a millionth
        np.testing.assert_allclose(mean, fused.mean[:, k], atol=2e-4)
        np.testing.assert_allclose(covariance, fused.covariance[..., k], rtol=1e-3, atol=2e-4)


def test_the_error_of_a_median_is_its_spread_over_samples() -> None:
    draws = 3.0 + np.random.default_rng(2).standard_normal((4_000, 100))
    spread = np.median(draws, axis=1).std()
    assert np.mean([cost.middle(one).stderr for one in draws]) == pytest.approx(spread, rel=0.05)


def test_every_rule_is_timed_every_way_and_naive_is_one() -> None:
    run = Run(3, 1, rules=(fuser("fast-ci"),))
    rows = {(row.name, row.quantity): row for row in cost.run(run).rows}
    for n in (2, 4):
        for way in cost.WAYS:
            assert rows["naive", f"{way}, n = {n}"].ours == 1.0
            assert rows["hmd-ga", f"{way}, n = {n}"].published == 3.68
        assert rows["fast-ci", f"ours, one, n = {n}"].published is None
    assert all(row.ours > 0 for row in rows.values())
    # an optimiser in a loop costs several inverses, whatever the machine
    assert rows["ci", "a scipy loop, n = 2"].ours > 2
