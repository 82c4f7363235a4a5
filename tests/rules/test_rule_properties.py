"""What holds for every rule whatever the numbers: order, units, equal sources, one source."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion_service.arrays import Floats
from fusion_service.rules import fuse
from tests.helpers.strategies import estimates, seeds

Estimates = tuple[Floats, Floats]
ALL: list[tuple[str, dict[str, Any]]] = [
    ("naive", {}),
    ("ci", {}),
    ("ci", {"criterion": "trace"}),
    ("bci", {"max_correlation": 0.5}),
    ("hmd-ga", {}),
    ("hmd-ga", {"criterion": "trace"}),
    ("fast-ci", {}),
    ("ffcc", {}),
    ("ici", {}),
    ("ici", {"criterion": "trace"}),
    ("ei", {}),
    ("aa", {}),
    ("aa", {"criterion": "diversity"}),
    ("cu", {}),
    ("cu", {"criterion": "trace"}),
]
UNITS = ("ci", "bci", "fast-ci", "ici", "hmd-ga", "cu")
SAME = ("ci", "fast-ci", "ici", "ei", "hmd-ga", "aa", "cu")
cases = st.sampled_from(ALL)
optimal = st.sampled_from([case for case in ALL if case[0] in ("ci", "bci", "hmd-ga")])
few = settings(max_examples=60, deadline=None)


def close(a: Floats, b: Floats, P: Floats, tolerance: float = 1e-4) -> None:
    """Means or covariances equal, in units of the smaller standard deviations around."""
    np.testing.assert_allclose(
        a, b, rtol=tolerance, atol=tolerance * np.sqrt(np.linalg.eigvalsh(P).min()) ** np.ndim(a)
    )


@few
@given(cases, estimates(), seeds)
def test_order_does_not_matter(case: tuple[str, dict[str, Any]], drawn: Estimates, seed: int) -> None:
    rule, options = case
    x, P = drawn
    order = np.random.default_rng(seed).permutation(len(x))
    a, b = fuse(rule, x, P, **options), fuse(rule, x[order], P[order], **options)
    close(a.covariance, b.covariance, a.covariance)
    close(a.mean, b.mean, a.covariance)


@few
@given(st.sampled_from([c for c in ALL if c[1].get("criterion") != "trace"]), estimates(), seeds)
def test_det_rules_do_not_depend_on_coordinates(case: tuple[str, dict[str, Any]], drawn: Estimates, seed: int) -> None:
    rule, options = case
    x, P = drawn
    rng = np.random.default_rng(seed)
    n = x.shape[1]
    q, _ = np.linalg.qr(rng.normal(size=(2, n, n)))
    T, shift = q[0] * 10.0 ** rng.uniform(-1, 1, n) @ q[1], rng.normal(size=n)
    moved = T @ P @ T.T
    a = fuse(rule, x, P, **options)
    b = fuse(rule, x @ T.T + shift, 0.5 * (moved + moved.swapaxes(1, 2)), **options)
    want = T @ a.covariance @ T.T
    close(b.covariance, want, want)
    close(b.mean, T @ a.mean + shift, want)


@few
@given(cases, estimates(max_sources=1))
def test_one_source_is_itself(case: tuple[str, dict[str, Any]], drawn: Estimates) -> None:
    rule, options = case
    x, P = drawn
    fused = fuse(rule, x, P, influence=True, **options)
    P = P / 0.9 if rule == "ffcc" else P
    np.testing.assert_allclose(fused.mean, x[0], rtol=1e-12)
    np.testing.assert_allclose(fused.covariance, P[0], rtol=1e-9, atol=1e-11)
    assert fused.influence is not None
    np.testing.assert_allclose(fused.influence, [1.0], rtol=1e-9)


@few
@given(st.sampled_from([c for c in ALL if c[0] in SAME]), estimates(max_sources=1), st.integers(2, 6))
def test_equal_sources_are_themselves(case: tuple[str, dict[str, Any]], drawn: Estimates, N: int) -> None:
    rule, options = case
    x, P = (np.repeat(a, N, axis=0) for a in drawn)
    fused = fuse(rule, x, P, **options)
    np.testing.assert_allclose(fused.mean, x[0], rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(fused.covariance, P[0], rtol=1e-9, atol=1e-11)
    if rule not in ("ei", "ici"):  # none, and those of a chain
        np.testing.assert_allclose(fused.weights, np.full(N, 1 / N))


@few
@given(st.sampled_from(UNITS), estimates(), seeds)
def test_scales_are_the_units_of_the_trace(rule: str, drawn: Estimates, seed: int) -> None:
    """With the scales of its units an estimate is fused as in any others; without them it is not."""
    x, P = drawn
    unit = 10.0 ** np.random.default_rng(seed).uniform(-3, 3, x.shape[1])
    a = fuse(rule, x, P, criterion="trace")
    b = fuse(rule, x * unit, P * np.outer(unit, unit), criterion="trace", scales=unit)
    close(b.covariance / np.outer(unit, unit), a.covariance, a.covariance)
    close(b.mean / unit, a.mean, a.covariance)
    c = fuse(rule, x, P, criterion="det", scales=unit)
    close(c.covariance, fuse(rule, x, P, criterion="det").covariance, c.covariance)


def test_the_trace_depends_on_units() -> None:
    """So the test above can fail."""
    x, P = np.zeros((2, 2)), np.stack([np.diag([4.0, 1.0]), np.diag([1.0, 4.0])])
    assert fuse("ci", x, P, criterion="trace", scales=[1.0, 10.0]).weights[0] < 0.1
    # the mutual part takes after the source that matters less
    assert fuse("ici", x, P, criterion="trace", scales=[1.0, 10.0]).weights[0] > 0.9


@few
@given(optimal, estimates(min_sources=2))
def test_chosen_weights_are_no_worse_than_uniform_or_one_source(
    case: tuple[str, dict[str, Any]], drawn: Estimates
) -> None:
    """By the rule's own criterion: of the result for CI and BCI, of the mutual component for HMD-GA."""
    rule, options = case
    x, P = drawn
    N = len(x)

    def value(covariance: Floats) -> float:
        M = covariance
        if rule == "hmd-ga":
            M = np.linalg.inv(P).sum(axis=0) - np.linalg.inv(covariance)
        return float(np.trace(M) if options.get("criterion") == "trace" else np.linalg.slogdet(M)[1])

    best = value(fuse(rule, x, P, **options).covariance)
    for w in (np.full(N, 1 / N), *(0.98 * np.eye(N) + 0.02 / N)):
        other = value(fuse(rule, x, P, weights=w, **options).covariance)
        assert best <= other + 1e-6 * (1.0 + abs(other))


@few
@given(cases, estimates())
def test_results_are_covariances_and_influences_sum_to_one(case: tuple[str, dict[str, Any]], drawn: Estimates) -> None:
    rule, options = case
    fused = fuse(rule, *drawn, influence=True, **options)
    np.testing.assert_array_equal(fused.covariance, fused.covariance.T)
    assert np.linalg.eigvalsh(fused.covariance).min() > 0.0
    assert fused.influence is not None
    assert fused.influence.sum() == pytest.approx(1.0, abs=1e-8)
