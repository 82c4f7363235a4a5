"""What a number of samples shows, by sums of the binomial and Poisson distributions."""

from __future__ import annotations

from math import comb, exp, factorial

import numpy as np
import pytest

from fusion_service.review.profiles import confidence as sure
from fusion_service.review.profiles.counting import Counted
from fusion_service.review.profiles.judging import FAILED, NOT_SHOWN, PASSED, _verdict
from fusion_service.review.profiles.profile import Requirement
from tests.helpers.missions import picture, truth
from tests.review.profiles.test_counting import lone, need, one


def below(k: int, n: int, p: float) -> float:
    return sum(comb(n, i) * p**i * (1 - p) ** (n - i) for i in range(k + 1))


@pytest.mark.parametrize(("k", "n"), [(0, 10), (0, 1000), (3, 50), (49, 50), (7, 7)])
def test_bounds_of_clopper_and_pearson(k: int, n: int) -> None:
    high, low = sure.upper(k, n, 0.95), sure.lower(k, n, 0.95)
    assert high == 1.0 if k == n else below(k, n, high) == pytest.approx(0.05)
    assert low == 0.0 if k == 0 else 1 - below(k - 1, n, low) == pytest.approx(0.05)


def test_the_rule_of_three_and_the_number_of_samples() -> None:
    assert sure.upper(0, 1000, 0.95) == pytest.approx(3 / 1000, rel=0.01)
    assert sure.needed(1e-6, 0.95) == pytest.approx(3e6, rel=0.01)
    n = int(np.ceil(sure.needed(1e-3, 0.95)))
    assert sure.upper(0, n, 0.95) <= 1e-3 < sure.upper(0, n - 2, 0.95)
    high = sure.upper_count(2, 0.95)
    assert sum(exp(-high) * high**i / factorial(i) for i in range(3)) == pytest.approx(0.05)


def verdict(requirement: Requirement, value: float, samples: float, what: str = "share") -> str:
    return _verdict(requirement, Counted(np.array([value]), np.array([samples]), what), value, samples).verdict


def test_a_rare_rate_is_not_shown_by_few_samples() -> None:
    rare = need("gap", longer_than_s=5.0, interval_s=1.0, share_max=1e-6)
    found = _verdict(rare, Counted(np.zeros(1), np.array([1000.0]), "share"), 0.0, 1000.0)
    assert found.verdict == NOT_SHOWN
    assert "2,995,731 samples without one would show it" in found.words
    assert found.bound == pytest.approx(0.002991, rel=1e-3)
    assert verdict(rare, 0, 3_000_000) == PASSED
    assert verdict(rare, 1, 1000) == FAILED
    assert verdict(need("gap", longer_than_s=5.0, interval_s=1.0, share_max=1e-6, confidence=0.0), 0, 1000) == PASSED


def test_a_share_that_must_be_large_and_a_rate_of_events() -> None:
    often = need("detection", share_min=0.97)
    assert [verdict(often, good, 1000) for good in (960, 975, 990)] == [FAILED, NOT_SHOWN, PASSED]
    assert verdict(often, 0, 0) == NOT_SHOWN
    swaps = need("continuity", count="swaps", per_target_hour_max=1.0)
    assert [verdict(swaps, count, hours, "rate") for count, hours in ((2, 1), (0, 1), (0, 4), (1, 2))] == [
        FAILED, NOT_SHOWN, PASSED, NOT_SHOWN,
    ]  # fmt: skip
    root = need("position_error", rms_max_m=5.0)
    assert [verdict(root, squares, 4, "rms") for squares in (100.0, 101.0)] == [PASSED, FAILED]


def test_each_target_alone_if_that_is_asked() -> None:
    mission = lone(99, range(100))
    mission += [truth(t, [2], [[1000.0, 0.0]]) for t in range(5)]
    mission = [*mission, *(picture(t + 0.5, [5], [[3.0, 4.0]]) for t in range(5))]
    whole = one(mission, need("detection", share_min=0.8))
    assert (whole.verdict, whole.targets[2].verdict) == (PASSED, FAILED)
    assert one(mission, need("detection", share_min=0.8, each_target=True)).verdict == FAILED
