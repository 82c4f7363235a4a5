"""CI, BCI and the naive rule: weights against scipy, promises against the worst admissible correlation."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import sqrtm
from scipy.optimize import minimize, minimize_scalar

from fusion_service.arrays import Floats
from fusion_service.rules import fuse
from tests.helpers.strategies import covariance, sources
from tests.rules.correlation import gains_of, worst_ratio

SEED = 4711
CRITERIA = ("det", "trace")


def cost(criterion: str, information: NDArray[Any]) -> float:
    if criterion == "det":
        return float(-np.linalg.slogdet(information)[1])
    return float(np.log(np.trace(np.linalg.inv(information))))


def inflation(w: Floats, R: Floats | float) -> Floats:
    """c_i = w_i / (R w)_i, R a matrix or one number for all pairs."""
    if np.ndim(R) == 0:
        R = np.full((len(w), len(w)), R)
        np.fill_diagonal(R, 1.0)
    return np.asarray(w / (R @ w))


def lowest(f: Callable[[Floats], float], N: int) -> float:
    """Minimum over the simplex, by scipy."""
    if N == 2:
        inside = minimize_scalar(
            lambda t: f(np.array([t, 1 - t])), bounds=(0, 1), method="bounded", options={"xatol": 1e-11}
        )
        return float(min(inside.fun, f(np.array([1e-13, 1 - 1e-13])), f(np.array([1 - 1e-13, 1e-13]))))
    best = np.inf
    for start in (np.zeros(N), *(4.0 * np.eye(N))):
        best = min(best, minimize(lambda z: f(np.exp(z) / np.exp(z).sum()), start, options={"gtol": 1e-8}).fun)
    return best


@pytest.mark.parametrize("N", [2, 3, 5])
@pytest.mark.parametrize("n", [1, 2, 7])
@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("rho", [1.0, 0.6, 0.01])
def test_weights_are_the_best(N: int, n: int, criterion: str, rho: float) -> None:
    rng = np.random.default_rng(SEED)
    options: dict[str, Any] = {"criterion": criterion}
    if rho < 1.0:
        options["max_correlation"] = rho
    for decades in (1.0, 4.0):
        x, P = sources(rng, N, n, decades)
        A = np.linalg.inv(P)
        fused = fuse("ci" if rho == 1.0 else "bci", x, P, **options)

        def f(w: Floats) -> float:
            return cost(criterion, np.einsum("i,ijk->jk", inflation(w, rho), A))  # noqa: B023

        assert fused.weights.sum() == pytest.approx(1.0, abs=1e-12)
        assert (fused.weights >= 0.0).all()
        assert f(fused.weights) <= lowest(f, N) + 1e-9


def test_fused_moments_are_those_of_the_formula() -> None:
    rng = np.random.default_rng(SEED)
    x, P = sources(rng, 3, 4)
    A = np.linalg.inv(P)
    w = np.array([0.5, 0.2, 0.3])
    R = np.array([[1.0, 0.1, 0.7], [0.1, 1.0, 0.4], [0.7, 0.4, 1.0]])
    for rule, c, options in (
        ("ci", w, {}),
        ("bci", inflation(w, 0.4), {"max_correlation": 0.4}),
        ("bci", inflation(w, R), {"max_correlation": R}),
        ("bci", w, {"max_correlation": 1.0}),
        ("bci", np.ones(3), {"max_correlation": 0.0}),
    ):
        fused = fuse(rule, x, P, weights=w, influence=True, **options)
        M = np.einsum("i,ijk->jk", c, A)
        np.testing.assert_allclose(fused.covariance, np.linalg.inv(M), rtol=1e-11)
        np.testing.assert_allclose(fused.mean, np.linalg.solve(M, np.einsum("i,ijk,ik->j", c, A, x)), rtol=1e-11)
        assert fused.influence is not None
        gains = [c[i] * np.trace(np.linalg.solve(M, A[i])) / 4 for i in range(3)]
        np.testing.assert_allclose(fused.influence, gains, rtol=1e-11)


def test_naive_is_recursive_kalman_updating() -> None:
    x, P = sources(np.random.default_rng(SEED), 4, 3)
    mean, S = x[0], P[0]
    for z, R in zip(x[1:], P[1:], strict=True):
        K = np.linalg.solve(S + R, S).T
        mean, S = mean + K @ (z - mean), S - K @ S
    fused = fuse("naive", x, P)
    np.testing.assert_allclose(fused.mean, mean, rtol=1e-11)
    np.testing.assert_allclose(fused.covariance, S, rtol=1e-10, atol=1e-13)
    assert np.isnan(fused.weights).all()


def test_bounds_of_zero_and_one_are_naive_and_ci() -> None:
    x, P = sources(np.random.default_rng(SEED), 3, 3)
    for rho, rule in ((0.0, "naive"), (1.0, "ci")):
        for bound in (rho, np.where(np.eye(3) == 1, 1.0, rho)):
            fused, want = fuse("bci", x, P, max_correlation=bound), fuse(rule, x, P)
            np.testing.assert_allclose(fused.covariance, want.covariance, rtol=1e-12)
            np.testing.assert_allclose(fused.mean, want.mean, rtol=1e-12)
    np.testing.assert_allclose(fuse("bci", x, P, max_correlation=0.0).weights, np.full(3, 1 / 3))


@pytest.mark.parametrize("criterion", CRITERIA)
def test_bits_under_a_matrix_of_bounds_are_those_of_the_numbers(criterion: str) -> None:
    """Not of what stood in memory before: the upper triangle of a derivative was once read and never written."""
    drawn = [sources(np.random.default_rng(SEED + i), 3, 3) for i in range(40)]
    x, P = (np.stack(a) for a in zip(*drawn, strict=True))
    R = np.array([[1.0, 0.8, 0.8], [0.8, 1.0, 0.5], [0.8, 0.5, 1.0]])
    results = []
    for junk in (0.0, 1e3, -1.0, np.nan):
        for size in (40, 9 * 40, 27 * 40):
            np.full(size, junk)
        results.append(fuse("bci", x, P, max_correlation=R, criterion=criterion))
    alone = fuse("bci", x[7], P[7], max_correlation=R, criterion=criterion)
    for fused in results:
        np.testing.assert_array_equal(fused.weights, results[0].weights)
        np.testing.assert_array_equal(fused.weights[7], alone.weights)


def test_the_criterion_rises_with_the_bound() -> None:
    x, P = sources(np.random.default_rng(SEED), 3, 3)
    for criterion in CRITERIA:
        values = [
            cost(criterion, np.linalg.inv(fuse("bci", x, P, max_correlation=rho, criterion=criterion).covariance))
            for rho in np.linspace(0.0, 1.0, 11)
        ]
        assert all(a < b + 1e-12 for a, b in pairwise(values))


def test_different_bounds_per_pair_use_them_well() -> None:
    """Not convex for N > 2, so only near the best of many random weights."""
    rng = np.random.default_rng(SEED)
    R = np.array([[1.0, 0.9, 0.1], [0.9, 1.0, 0.3], [0.1, 0.3, 1.0]])
    for criterion in CRITERIA:
        x, P = sources(rng, 3, 2)
        A = np.linalg.inv(P)
        fused = fuse("bci", x, P, criterion=criterion, max_correlation=R)
        tried = rng.dirichlet(np.ones(3), 4000)
        best = min(cost(criterion, np.einsum("i,ijk->jk", inflation(w, R), A)) for w in tried)
        assert cost(criterion, np.linalg.inv(fused.covariance)) <= best + 1e-2


def test_different_bounds_per_pair_are_searched_from_several_sides() -> None:
    """Bounds of 0 and 1 make several local optima."""
    rng = np.random.default_rng(SEED)
    for _ in range(3):
        R = np.eye(4)
        upper = np.triu_indices(4, 1)
        R[upper] = rng.choice([0.0, 0.05, 0.95, 1.0], size=6)
        R = np.maximum(R, R.T)
        for criterion in CRITERIA:
            x, P = sources(rng, 4, 2)
            A = np.linalg.inv(P)
            c = [w / (R @ w) for w in (*rng.dirichlet(np.ones(4), 3000), *rng.dirichlet(np.full(4, 0.3), 1000))]
            best = min(cost(criterion, np.einsum("i,ijk->jk", one, A)) for one in c)
            fused = fuse("bci", x, P, criterion=criterion, max_correlation=R)
            assert cost(criterion, np.linalg.inv(fused.covariance)) <= best + 1e-2


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("N", [2, 3])
def test_ci_and_bci_bound_the_error_of_every_admissible_correlation(N: int, criterion: str) -> None:
    rng = np.random.default_rng(SEED)
    for rho in (1.0, 0.5, 0.1):
        x, P = sources(rng, N, 3)
        fused = fuse("bci", x, P, max_correlation=rho, criterion=criterion)
        gains = gains_of(P, inflation(fused.weights, rho), fused.covariance)
        np.testing.assert_allclose(gains.sum(axis=0), np.eye(3), atol=1e-9)
        R = np.full((N, N), rho)
        np.fill_diagonal(R, 1.0)
        ratio = worst_ratio(P, fused.covariance, gains, R)
        assert ratio <= 1.0 + 1e-7
        assert ratio > (1.0 - 1e-4 if N == 2 else 0.5)  # for two sources the best bound is tight
    R = np.array([[1.0, 0.9, 0.5], [0.9, 1.0, 0.5], [0.5, 0.5, 1.0]])[:N, :N]
    fused = fuse("bci", x, P, max_correlation=R, criterion=criterion)
    gains = gains_of(P, inflation(fused.weights, R), fused.covariance)
    assert worst_ratio(P, fused.covariance, gains, R) <= 1.0 + 1e-7


@pytest.mark.parametrize("rho", [1.0, 0.4])
def test_no_cross_covariance_found_by_brute_force_breaks_the_promise(rho: float) -> None:
    """The same, without knowing what the worst looks like: search over 2 x 2 cross-covariances."""
    rng = np.random.default_rng(SEED)
    for _ in range(3):
        P = np.stack([covariance(rng, 2), covariance(rng, 2)])
        fused = fuse("bci", np.zeros((2, 2)), P, max_correlation=rho)
        K = np.hstack(list(gains_of(P, inflation(fused.weights, rho), fused.covariance)))
        half = [np.real(sqrtm(p)) for p in P]
        white = np.linalg.inv(np.linalg.cholesky(fused.covariance))

        def largest(z: Floats) -> float:
            Z = z.reshape(2, 2)
            cross = rho * half[0] @ (Z / max(1.0, float(np.linalg.norm(Z, 2)))) @ half[1]  # noqa: B023
            J = np.block([[P[0], cross], [cross.T, P[1]]])  # noqa: B023
            return float(np.linalg.eigvalsh(white @ K @ J @ K.T @ white.T)[-1])  # noqa: B023

        found = max(-minimize(lambda z: -largest(z), rng.normal(size=4), method="Nelder-Mead").fun for _ in range(4))
        assert found <= 1.0 + 1e-9
        R = np.array([[1.0, rho], [rho, 1.0]])
        assert found <= worst_ratio(P, fused.covariance, K.reshape(2, 2, 2).swapaxes(0, 1), R) + 1e-6


def test_a_correlation_beyond_the_bound_does_break_it() -> None:
    """So the test above can fail."""
    P = np.stack([np.diag([4.0, 1.0]), np.diag([1.0, 4.0])])
    fused = fuse("bci", np.zeros((2, 2)), P, max_correlation=0.1)
    gains = gains_of(P, inflation(fused.weights, 0.1), fused.covariance)
    assert worst_ratio(P, fused.covariance, gains, np.array([[1.0, 0.9], [0.9, 1.0]])) > 1.2


def own_bounds(rng: np.random.Generator, B: int, N: int) -> Floats:
    """Bounds of each fusion's own (B, N, N); those of 0 and 1 among them."""
    R = rng.choice([0.0, 0.2, 0.5, 0.9, 1.0], size=(B, N, N))
    R = np.maximum(R, R.swapaxes(1, 2))
    R[:, range(N), range(N)] = 1.0
    return np.asarray(R)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("N", [1, 2, 3, 5])
def test_bounds_of_each_fusions_own(N: int, criterion: str) -> None:
    """Conservative for the worst within them, as good as those of one number where there is one, and nobody's bits
    depend on the others'."""
    rng = np.random.default_rng(SEED)
    B = 8
    drawn = [sources(rng, N, 3) for _ in range(B)]
    x, P = (np.stack(a) for a in zip(*drawn, strict=True))
    R = own_bounds(rng, B, N)
    fused = fuse("bci", x, P, max_correlation=R, criterion=criterion, influence=True)
    assert fused.influence is not None
    np.testing.assert_allclose(fused.influence.sum(axis=-1), 1.0)
    for b in range(B):
        one = fuse("bci", x[b : b + 1], P[b : b + 1], max_correlation=R[b : b + 1], criterion=criterion)
        np.testing.assert_array_equal(one.covariance[0], fused.covariance[b])
        np.testing.assert_array_equal(one.mean[0], fused.mean[b])
        c = np.linalg.lstsq(
            np.linalg.inv(P[b]).reshape(N, -1).T, np.linalg.inv(fused.covariance[b]).ravel(), rcond=None
        )[0]
        gains = gains_of(P[b], c, fused.covariance[b])
        np.testing.assert_allclose(gains.sum(axis=0), np.eye(3), atol=1e-6)
        assert worst_ratio(P[b], fused.covariance[b], gains, R[b]) <= 1.0 + 1e-5
        if N == 2:
            same = fuse("bci", x[b], P[b], max_correlation=max(float(R[b, 0, 1]), 1e-6), criterion=criterion)
            np.testing.assert_allclose(same.covariance, fused.covariance[b], rtol=1e-5)


@pytest.mark.parametrize("criterion", CRITERIA)
def test_quick_weights_are_nearly_the_best(criterion: str) -> None:
    rng = np.random.default_rng(SEED)
    lost = []
    for _ in range(15):
        x, P = sources(rng, 3, 4)
        R = own_bounds(rng, 1, 3)
        quick = fuse("bci", x[None], P[None], max_correlation=R, criterion=criterion)
        best = fuse("bci", x, P, max_correlation=R[0], criterion=criterion)
        lost.append(
            cost(criterion, np.linalg.inv(quick.covariance[0])) - cost(criterion, np.linalg.inv(best.covariance))
        )
    assert np.mean(lost) < 0.01
    assert max(lost) < 0.15
