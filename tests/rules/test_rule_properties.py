"""What holds for every rule whatever the numbers: order, units, equal sources, one source."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from strategies import estimates, seeds

from fusion_service.rules import fuse

Array = NDArray[np.float64]
Estimates = tuple[Array, Array]
ALL: list[tuple[str, dict[str, Any]]] = [
    ("naive", {}),
    ("ci", {}),
    ("ci", {"criterion": "trace"}),
    ("bci", {"max_correlation": 0.5}),
    ("hmd-ga", {}),
    ("hmd-ga", {"criterion": "trace"}),
]
cases = st.sampled_from(ALL)
optimal = st.sampled_from([case for case in ALL if case[0] != "naive"])
few = settings(max_examples=60, deadline=None)


def close(a: Array, b: Array, P: Array, tolerance: float = 1e-4) -> None:
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
    np.testing.assert_allclose(fused.mean, x[0], rtol=1e-12)
    np.testing.assert_allclose(fused.covariance, P[0], rtol=1e-9, atol=1e-11)
    assert fused.influence is not None
    np.testing.assert_allclose(fused.influence, [1.0], rtol=1e-9)


@few
@given(st.sampled_from([c for c in ALL if c[0] in ("ci", "hmd-ga")]), estimates(max_sources=1), st.integers(2, 6))
def test_equal_sources_are_themselves(case: tuple[str, dict[str, Any]], drawn: Estimates, N: int) -> None:
    rule, options = case
    x, P = (np.repeat(a, N, axis=0) for a in drawn)
    fused = fuse(rule, x, P, **options)
    np.testing.assert_array_equal(fused.mean, x[0])
    np.testing.assert_allclose(fused.covariance, P[0], rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(fused.weights, np.full(N, 1 / N))


@few
@given(optimal, estimates(min_sources=2))
def test_chosen_weights_are_no_worse_than_uniform_or_one_source(
    case: tuple[str, dict[str, Any]], drawn: Estimates
) -> None:
    """By the rule's own criterion: of the result for CI and BCI, of the mutual component for HMD-GA."""
    rule, options = case
    x, P = drawn
    N = len(x)

    def value(covariance: Array) -> float:
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
