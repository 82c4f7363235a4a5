"""HMD-GA against integrals on a grid, the printed numbers, scipy, and its counter-example."""

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import multivariate_normal

from fusion_service.arrays import Floats
from fusion_service.rules import fuse
from tests.helpers.strategies import sources

SEED = 99
CRITERIA = ("det", "trace")


def cost(criterion: str, G: Floats) -> float:
    """(77): a scalar of the inverse of the mutual component."""
    if criterion == "det":
        return float(-np.linalg.slogdet(G)[1])
    return float(np.log(np.trace(np.linalg.inv(G))))


def mutual_by_integration(x: Floats, P: Floats, w: Floats) -> tuple[Floats, Floats]:
    """Mean and covariance of sum w_j prod_{i != j} p_i, by sums over a grid (n = 1 or 2)."""
    n = x.shape[1]
    axes = [np.linspace(-14, 14, 4001 if n == 1 else 561)] * n
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, n)
    p = np.stack([multivariate_normal(m, S).pdf(grid) for m, S in zip(x, P, strict=True)])
    q = sum(w[j] * np.delete(p, j, axis=0).prod(axis=0) for j in range(len(w)))
    q = q / q.sum()
    mean = q @ grid
    return mean, (grid - mean).T * q @ (grid - mean)


@pytest.mark.parametrize(("n", "N"), [(1, 2), (1, 3), (1, 5), (2, 2), (2, 3), (2, 4)])
def test_the_mutual_component_has_the_moments_of_the_mixture(n: int, N: int) -> None:
    rng = np.random.default_rng(SEED)
    x, P = sources(rng, N, n, decades=0.6)
    w = rng.dirichlet(np.ones(N))
    c, G = mutual_by_integration(x, P, w)
    A = np.linalg.inv(P)
    M = A.sum(axis=0) - np.linalg.inv(G)
    fused = fuse("hmd-ga", x, P, weights=w)
    np.testing.assert_allclose(fused.covariance, np.linalg.inv(M), rtol=1e-7, atol=1e-10)
    want = np.linalg.solve(M, np.einsum("ijk,ik->j", A, x) - np.linalg.solve(G, c))
    np.testing.assert_allclose(fused.mean, want, rtol=1e-6, atol=1e-8)
    np.testing.assert_array_equal(fused.weights, w)


def test_the_example_with_and_without_constants() -> None:
    """Printed to four digits in an independent derivation; the density itself gives 1.7093 and .3545."""
    x, P = np.array([[0.0], [1.0], [2.5]]), np.array([1.0, 2.0, 0.5]).reshape(3, 1, 1)
    w = [0.2, 0.3, 0.5]
    printed = fuse("hmd-ga", x, P, weights=w, constants=False)
    assert printed.mean[0] == pytest.approx(1.7259, abs=5e-5)
    assert printed.covariance[0, 0] == pytest.approx(0.3807, abs=5e-5)
    exact = fuse("hmd-ga", x, P, weights=w)
    assert exact.mean[0] == pytest.approx(1.7830, abs=5e-5)
    assert exact.covariance[0, 0] == pytest.approx(0.3720, abs=5e-5)


def test_two_sources_as_sharma_writes_them() -> None:
    """(31) to (35), in dense algebra."""
    x, P = sources(np.random.default_rng(SEED), 2, 4)
    w = np.array([0.3, 0.7])
    d = x[0] - x[1]
    G = w[1] * P[0] + w[0] * P[1] + w[0] * w[1] * np.outer(d, d)
    g = w[1] * x[0] + w[0] * x[1]
    A, V = np.linalg.inv(P), np.linalg.inv(G)
    S = np.linalg.inv(A[0] + A[1] - V)
    fused = fuse("hmd-ga", x, P, weights=w, influence=True)
    np.testing.assert_allclose(fused.covariance, S, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(fused.mean, S @ (A[0] @ x[0] + A[1] @ x[1] - V @ g), rtol=1e-9)
    gains = [S @ (A[0] - w[1] * V), S @ (A[1] - w[0] * V)]
    assert fused.influence is not None
    np.testing.assert_allclose(fused.influence, [np.trace(K) / 4 for K in gains], rtol=1e-9)


def test_influence_is_the_gain_of_each_source() -> None:
    """Weights held, so by moving one source's mean: the fused mean is linear in it when constants are off."""
    x, P = sources(np.random.default_rng(SEED), 3, 2)
    w = [0.2, 0.3, 0.5]
    base = fuse("hmd-ga", x, P, weights=w, constants=False, influence=True)
    A = np.linalg.inv(P)
    C = [np.linalg.inv(A.sum(axis=0) - a) for a in A]
    c = np.stack([C[j] @ sum(A[i] @ x[i] for i in range(3) if i != j) for j in range(3)])
    r = c - w @ c
    V = np.linalg.inv(np.einsum("i,ijk->jk", w, C) + (r.T * w) @ r)
    assert base.influence is not None
    for i in range(3):
        K = base.covariance @ (A[i] - V @ sum(w[j] * C[j] for j in range(3) if j != i) @ A[i])
        assert base.influence[i] == pytest.approx(np.trace(K) / 2, rel=1e-9)
    assert base.influence.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("n", [1, 2, 4, 7])
def test_pair_weights_solve_77(n: int, criterion: str) -> None:
    rng = np.random.default_rng(SEED)
    for decades in (1.0, 3.0):
        x, P = sources(rng, 2, n, decades)
        d = x[0] - x[1]

        def f(w: float) -> float:
            return cost(criterion, (1 - w) * P[0] + w * P[1] + w * (1 - w) * np.outer(d, d))  # noqa: B023

        inside = minimize_scalar(f, bounds=(0, 1), method="bounded", options={"xatol": 1e-11}).fun
        fused = fuse("hmd-ga", x, P, criterion=criterion)
        assert f(fused.weights[0]) <= min(inside, f(0.0), f(1.0)) + 1e-9


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("constants", [True, False])
def test_weights_of_many_sources_solve_77(criterion: str, constants: bool) -> None:
    rng = np.random.default_rng(SEED)
    for N, n in ((3, 2), (4, 3), (6, 1)):
        x, P = sources(rng, N, n)
        A = np.linalg.inv(P)
        fused = fuse("hmd-ga", x, P, criterion=criterion, constants=constants)

        C = np.stack([np.linalg.inv(A.sum(axis=0) - a) for a in A])
        c = np.stack([C[j] @ sum(A[i] @ x[i] for i in range(N) if i != j) for j in range(N)])

        def best_inverse(z: Floats, C: Floats = C, c: Floats = c) -> float:
            v = np.exp(z) / np.exp(z).sum()
            r = c - v @ c
            return cost(criterion, np.einsum("i,ijk->jk", v, C) + (r.T * v) @ r)

        starts = (np.zeros(N), *(3.0 * np.eye(N)))
        want = min(minimize(best_inverse, z, options={"gtol": 1e-8}).fun for z in starts)
        V = A.sum(axis=0) - np.linalg.inv(fused.covariance)
        assert cost(criterion, np.linalg.inv(V)) <= want + 1e-7
        again = fuse("hmd-ga", x, P, weights=fused.weights, constants=constants)
        np.testing.assert_allclose(again.covariance, fused.covariance, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("n", [2, 4, 7])
def test_means_any_number_of_sigmas_apart(n: int, criterion: str) -> None:
    """Along their difference d nothing is mutual: G^-1 tends to N (N' L N)^-1 N', N the null space of d'."""
    rng = np.random.default_rng(SEED)
    for far in (1e6, 1e9, 1e12):
        x, P = sources(rng, 2, n)
        x[1] += far * rng.normal(size=n)
        fused = fuse("hmd-ga", x, P, criterion=criterion, weights=[0.3, 0.7])
        N = null_space((x[1] - x[0])[None])
        V = N @ np.linalg.inv(N.T @ (0.7 * P[0] + 0.3 * P[1]) @ N) @ N.T
        want = np.linalg.inv(np.linalg.inv(P).sum(axis=0) - V)
        np.testing.assert_allclose(fused.covariance, want, rtol=1e-6, atol=1e-6 * np.trace(want))
        w = fuse("hmd-ga", x, P, criterion=criterion).weights
        assert w.min() > 0.0


def test_scalars_have_the_closed_form_of_section_6_1() -> None:
    """max of (1-w) G1 + w G2 + w(1-w) d^2 is at 1/2 + (G2 - G1) / (2 d^2), clipped."""
    rng = np.random.default_rng(SEED)
    x, P = rng.normal(size=(200, 2, 1)) * 2, rng.uniform(0.2, 3.0, size=(200, 2, 1, 1))
    d2 = (x[:, 0, 0] - x[:, 1, 0]) ** 2
    want = np.clip(0.5 + (P[:, 1, 0, 0] - P[:, 0, 0, 0]) / (2 * d2), 0.0, 1.0)
    for criterion in CRITERIA:
        np.testing.assert_allclose(fuse("hmd-ga", x, P, criterion=criterion).weights[:, 0], want, atol=1e-7)


def test_never_above_ci_at_the_weights_of_the_mixture() -> None:
    rng = np.random.default_rng(SEED)
    for N in (2, 3):
        x, P = sources(rng, N, 3)
        w = rng.dirichlet(np.ones(N))
        excess = fuse("ci", x, P, weights=w).covariance - fuse("hmd-ga", x, P, weights=w, constants=False).covariance
        assert np.linalg.eigvalsh(excess).min() >= -1e-12


@pytest.mark.parametrize("weights", [None, "uniform"])
def test_hmd_ga_is_not_conservative(weights: str | None) -> None:
    """The counter-example to Sharma's section 4.2, by Monte Carlo: eigenvalues 1.45, naive 1.72, CI .86."""
    rng = np.random.default_rng(SEED)
    P = np.stack([np.diag([4.0, 1.0]), np.diag([1.0, 4.0])])
    joint = np.zeros((4, 4))
    joint[:2, :2], joint[2:, 2:] = P
    joint[1, 2] = joint[2, 1] = 0.9
    errors = rng.multivariate_normal(np.zeros(4), joint, size=100_000).reshape(-1, 2, 2)
    batch = np.broadcast_to(P, (len(errors), 2, 2, 2))

    def largest(rule: str, given: str | None) -> float:
        fused = fuse(rule, errors, batch, weights=given)
        mse = fused.mean.T @ fused.mean / len(errors)
        reported = fused.covariance.mean(axis=0)
        return float(np.linalg.eigvals(np.linalg.solve(reported, mse)).real.max())

    assert largest("hmd-ga", weights) == pytest.approx(1.45, abs=0.03)
    assert largest("naive", None) == pytest.approx(1.72, abs=0.03)
    assert largest("ci", weights) == pytest.approx(0.86, abs=0.02)
