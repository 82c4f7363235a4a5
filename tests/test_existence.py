"""Fused existence and cardinality against direct minimisation, Uney's examples and properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.special import xlogy
from scipy.stats import binom, poisson

from fusion_service.arrays import Floats
from fusion_service.existence import (
    ExistenceError,
    cardinality_map,
    cardinality_mean,
    fuse_cardinality,
    fuse_existence,
    fuse_poisson,
    loses_cardinality,
    loses_existence,
    loses_rate,
    loss_bound,
    loss_threshold,
    lower_existence,
)
from tests.helpers.strategies import seeds

probabilities = st.floats(0.0, 1.0)
inside = st.floats(1e-6, 1.0 - 1e-6)
METHODS: tuple[tuple[str, dict[str, float]], ...] = (
    ("consistent", {}), ("average", {}), ("geometric", {"overlap": 0.7})
)  # fmt: skip
SMALL = np.stack([binom.pmf(np.arange(6), 5, p) for p in (0.95, 0.92)])
LARGE = np.stack([binom.pmf(np.arange(36), 35, p) for p in (0.98, 0.975)])
"""Uney's example 3.6."""


def least(p: Floats, q: Floats) -> Floats:
    """The weighted geometric mean of two pmfs with the least normalisation, by search (Uney P4)."""
    best = minimize_scalar(
        lambda w: (p ** (1 - w) * q**w).sum(), bounds=(0, 1), method="bounded", options={"xatol": 1e-10}
    )
    out = p ** (1 - best.x) * q**best.x
    return np.asarray(out / out.sum())


@given(inside, inside)
@settings(deadline=None)
def test_consistent_existence_is_the_chernoff_point(a: float, b: float) -> None:
    assume(abs(a - b) > 1e-3)
    r = float(fuse_existence([a, b]))
    searched = least(np.array([1 - a, a]), np.array([1 - b, b]))[1]
    assert r == pytest.approx(searched, abs=1e-5)
    to_a, to_b = (xlogy(r, r / p) + xlogy(1 - r, (1 - r) / (1 - p)) for p in (a, b))
    assert to_a == pytest.approx(to_b, rel=1e-9)


def test_consistent_existence_is_uneys_50_and_51() -> None:
    a, b = 0.6, 0.9
    w = (np.log(np.log((1 - a) / (1 - b)) / np.log(b / a)) - np.log(a / (1 - a))) / (
        np.log((1 - a) / (1 - b)) + np.log(b / a)
    )
    there, gone = a ** (1 - w) * b**w, (1 - a) ** (1 - w) * (1 - b) ** w
    assert fuse_existence([a, b]) == pytest.approx(there / (there + gone), abs=1e-14)


@given(st.floats(0.0, 1.0), st.floats(-1e-9, 1e-9))
@settings(deadline=None)
def test_the_limit_of_equal_existences(a: float, step: float) -> None:
    b = min(1.0, max(0.0, a + step))
    assert fuse_existence([a, a]) == a
    assert min(a, b) <= fuse_existence([a, b]) <= max(a, b)


def test_certain_sources() -> None:
    r = fuse_existence([[0.0, 0.7], [0.7, 1.0], [0.0, 1.0], [0.0, 0.0], [1.0, 1.0]])
    assert r.tolist() == [0.0, 1.0, 0.5, 0.0, 1.0]
    assert fuse_existence([1e-9, 1 - 1e-9]) == pytest.approx(0.5)
    assert fuse_existence([1e-200, 0.7]) == pytest.approx(1.0 / (1.0 + np.log(0.7e200) / np.log(1 / 0.3)))


@given(st.lists(probabilities, min_size=1, max_size=5), st.permutations(range(5)))
@settings(deadline=None)
def test_existence_stays_between_its_sources_in_any_order(r: list[float], order: list[int]) -> None:
    again = [r[i] for i in order if i < len(r)]
    for method in ("consistent", "average"):
        fused = float(fuse_existence(r, method))
        assert min(r) <= fused <= max(r)
        assert fuse_existence(again, method) == pytest.approx(fused, abs=1e-15)
    if not (0.0 in r and 1.0 in r):
        fused = float(fuse_existence(r, "geometric", overlap=0.3))
        assert 0.0 <= fused <= max(r) * (1 + 1e-12)
        assert fuse_existence(again, "geometric", overlap=0.3) == pytest.approx(fused, abs=1e-14)


def uney_overlap(kappa: float) -> float:
    """z at equal weights of the Gaussians of Uney's example 3.3, by a sum over a grid."""
    turn = np.array([[1.0, -1.0], [1.0, 1.0]]) / np.sqrt(2.0)
    axis = np.linspace(-6.0, 6.0, 601)
    x = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
    logs = np.zeros(x.shape[:2])
    for m, R in (([0.25, 0.25], turn), ([-0.75, -0.25], turn.T)):
        P = R @ np.diag([1.0, 1.0 / kappa]) @ R.T
        d = x - m
        square = np.einsum("...i,ij,...j->...", d, np.linalg.inv(P), d)
        logs += -0.25 * square - 0.5 * np.log(2 * np.pi * np.sqrt(np.linalg.det(P)))
    return float(np.exp(logs).sum() * (axis[1] - axis[0]) ** 2)


def test_uney_examples_3_3_and_4_2() -> None:
    """0.8 and 0.8 stay 0.8; the exponential mixture falls, below one half once the aspects differ enough."""
    overlaps = [uney_overlap(kappa) for kappa in (1.0, 10.0, 20.0, 40.0)]
    fused = [float(fuse_existence([0.8, 0.8], "geometric", overlap=z)) for z in overlaps]
    assert fuse_existence([0.8, 0.8]) == 0.8
    assert all(f == pytest.approx(0.8 * z / (0.2 + 0.8 * z), abs=1e-12) for f, z in zip(fused, overlaps, strict=True))
    assert sorted(fused, reverse=True) == fused
    assert fused[0] > 0.5 > fused[-1]
    assert loses_existence(np.full((4, 2), 0.8), overlaps).all()
    assert not loses_existence([0.8, 0.8], 1.0)


@given(st.floats(1e-3, 0.999), st.floats(1e-3, 0.999), st.floats(0.01, 1.0), st.floats(0.05, 0.95))
@settings(deadline=None)
def test_bernoulli_loss_is_corollary_3_2(a: float, b: float, z: float, w: float) -> None:
    there, gone = a ** (1 - w) * b**w, (1 - a) ** (1 - w) * (1 - b) ** w
    bound = gone / (there / min(a, b) - there)
    assume(abs(z / bound - 1) > 1e-6)
    assert bool(loses_existence([a, b], z, [1 - w, w])) == (z < bound)
    pmfs = [[1 - a, a], [1 - b, b]]
    assert loss_bound(pmfs, [1.0, z], [1 - w, w])[1] == pytest.approx(bound, rel=1e-6)


@given(st.floats(1e-6, 1e6), st.floats(1e-6, 1e6))
@settings(deadline=None)
def test_consistent_rate_is_equally_far_from_both(a: float, b: float) -> None:
    assume(abs(a / b - 1) > 1e-3)
    x = float(fuse_poisson([a, b]))
    assert min(a, b) <= x <= max(a, b)
    to_a, to_b = (x * np.log(x / rate) - x + rate for rate in (a, b))
    assert to_a == pytest.approx(to_b, rel=1e-6)


def test_consistent_rate_is_the_chernoff_point_of_the_distributions() -> None:
    n = np.arange(80)
    for a, b in ((2.0, 5.0), (5.0, 2.0), (0.3, 9.0)):
        assert fuse_poisson([a, b]) == pytest.approx(least(poisson.pmf(n, a), poisson.pmf(n, b)) @ n, abs=1e-5)
    assert fuse_poisson([3.0, 3.0]) == 3.0
    assert fuse_poisson([0.0, 3.0]) == 0.0
    assert fuse_poisson([2.0, 3.0, 5.0]) == fuse_poisson([5.0, 2.0]) == pytest.approx(3.0 / np.log(2.5))
    assert fuse_poisson([2.0, 8.0], "geometric", overlap=0.5) == pytest.approx(2.0)
    assert fuse_poisson([2.0, 8.0], "average") == 5.0


@given(st.floats(0.01, 50.0), st.floats(0.01, 50.0), st.floats(0.01, 1.0), st.floats(0.05, 0.95))
@settings(deadline=None)
def test_a_small_overlap_loses_rate(a: float, b: float, z: float, w: float) -> None:
    lost = bool(loses_rate([a, b], z, [1 - w, w]))
    if z < min(a, b) / max(a, b) * (1 - 1e-9):  # Uney (32)
        assert lost
    if not lost:
        assert a ** (1 - w) * b**w * z >= min(a, b) * (1 - 1e-9)


def test_32_is_not_necessary() -> None:
    assert loses_rate([1.0, 4.0], 0.4)
    assert not 0.4 < 1.0 / 4.0


@pytest.mark.parametrize(("pmfs", "omega", "number"), [(SMALL, 0.5182, 5), (LARGE, 0.5090, 35)])
def test_uney_example_4_3(pmfs: Floats, omega: float, number: int) -> None:
    p, w = fuse_cardinality(pmfs)
    assert w[1] == pytest.approx(omega, abs=2e-4)
    assert cardinality_map(p) == number
    np.testing.assert_allclose(p, least(*pmfs), atol=1e-8)
    assert (p >= pmfs.min(axis=0) * (1 - 1e-12)).all()


def test_uney_example_3_6() -> None:
    """The mixture's most probable number falls with z, sooner for more targets; the threshold of (34) tells it."""
    low = [int(cardinality_map(fuse_cardinality(SMALL, "geometric", overlap=z)[0])) for z in (0.1, 0.9)]
    high = [int(cardinality_map(fuse_cardinality(LARGE, "geometric", overlap=z)[0])) for z in (0.1, 0.9)]
    assert low[0] < 5 == low[1]
    assert high[0] < 30
    for pmfs in (SMALL, LARGE):
        for z in (0.1, 0.5, 0.9):
            lost = loses_cardinality(pmfs, z)
            n = np.arange(pmfs.shape[1])
            assert lost[n > loss_threshold(pmfs, z)].all()
            scales = z**n
            np.testing.assert_array_equal(lost[1:], (scales < loss_bound(pmfs, scales))[1:])
    assert loss_threshold(SMALL, 1.0) == np.inf


@given(seeds, st.integers(1, 4), st.integers(2, 7))
@settings(max_examples=40, deadline=None)
def test_cardinality_in_any_order(seed: int, N: int, K: int) -> None:
    rng = np.random.default_rng(seed)
    pmfs = rng.dirichlet(np.ones(K), size=(3, N))
    order = rng.permutation(N)
    for method, options in METHODS:
        p, w = fuse_cardinality(pmfs, method, **options)
        assert p.shape == (3, K)
        assert w.shape == (3, N)
        np.testing.assert_allclose(p.sum(axis=-1), 1.0)
        again, _ = fuse_cardinality(pmfs[:, order], method, **options)
        np.testing.assert_allclose(again, p, atol=1e-5)
        if method != "geometric":
            same, _ = fuse_cardinality(np.repeat(pmfs[:, :1], 3, axis=1), method)
            np.testing.assert_allclose(same, pmfs[:, 0], atol=1e-12)
    p, w = fuse_cardinality(pmfs)
    far = (p[:, None] * np.log(p[:, None] / pmfs)).sum(axis=-1)
    radius = far.max(axis=-1, keepdims=True)  # active sources are equally far, the others nearer
    np.testing.assert_allclose(np.where(w > 1e-6, far, radius), np.broadcast_to(radius, far.shape), atol=2e-5)


def test_impossible_numbers() -> None:
    p, w = fuse_cardinality([[0.5, 0.5, 0.0], [0.0, 0.4, 0.6]])
    assert p.tolist() == [0.0, 1.0, 0.0]
    assert w.sum() == pytest.approx(1.0)
    with pytest.raises(ExistenceError, match="no number"):
        fuse_cardinality([[1.0, 0.0], [0.0, 1.0]])


def test_cardinality_of_bernoullis_is_existence() -> None:
    p, _ = fuse_cardinality([[0.4, 0.6], [0.1, 0.9]])
    assert p[1] == pytest.approx(float(fuse_existence([0.6, 0.9])), abs=1e-9)
    p, _ = fuse_cardinality([[0.4, 0.6], [0.1, 0.9]], "geometric", overlap=0.3)
    assert p[1] == pytest.approx(float(fuse_existence([0.6, 0.9], "geometric", overlap=0.3)), abs=1e-12)


def test_map_and_mean() -> None:
    assert cardinality_map([[0.2, 0.5, 0.3], [0.4, 0.4, 0.2]]).tolist() == [1, 0]
    np.testing.assert_allclose(cardinality_mean([[0.2, 0.5, 0.3]]), [1.1])


@given(probabilities, probabilities)
@settings(deadline=None)
def test_a_scan_without_a_report_lowers_existence(r: float, p: float) -> None:
    lowered = float(lower_existence(r, p))
    assert 0.0 <= lowered <= r * (1 + 1e-12)
    if r * p < 0.999:
        odds = (1 - p) * r / ((1 - p) * r + 1 - r)  # Bayes
        assert lowered == pytest.approx(odds, abs=1e-12)


@pytest.mark.parametrize(
    ("call", "complaint"),
    [
        (lambda: fuse_existence([0.5, 1.2]), "between 0 and 1"),
        (lambda: fuse_existence([0.5, np.nan]), "between 0 and 1"),
        (lambda: fuse_existence([]), "not empty"),
        (lambda: fuse_existence([0.5], "mean"), "unknown method"),
        (lambda: fuse_existence([0.5, 0.5], "geometric"), "overlap"),
        (lambda: fuse_existence([0.5, 0.5], overlap=0.5), "overlap"),
        (lambda: fuse_existence([0.5, 0.5], weights=[0.5, 0.5]), "own weights"),
        (lambda: fuse_existence([0.5, 0.5], "average", weights=[0.5, 0.6]), "sum to 1"),
        (lambda: fuse_existence([0.5, 0.5], "average", weights=[0.2, 0.3, 0.5]), "do not fit"),
        (lambda: fuse_existence([0.0, 1.0], "geometric", overlap=0.5), "contradict"),
        (lambda: fuse_existence(["x"]), "numbers"),
        (lambda: fuse_poisson([-1.0, 1.0]), "not negative"),
        (lambda: fuse_cardinality([[0.5, 0.4]]), "sum to 1"),
    ],
)
def test_what_is_refused(call: object, complaint: str) -> None:
    with pytest.raises(ExistenceError, match=complaint):
        call()  # type: ignore[operator]
