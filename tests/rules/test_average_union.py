"""Closed-form CI, the arithmetic average and covariance union: formulas, optimal weights and bounds, promises."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from fusion_service.arrays import Floats
from fusion_service.rules import RuleError, fuse
from tests.helpers.strategies import sources
from tests.rules.correlation import gains_of, worst_ratio

SEED = 2009


# ------------------------------------------------------------------ fast CI and FFCC


@pytest.mark.parametrize("N", [2, 3, 6])
def test_fast_ci_weights_are_the_printed_ones(N: int) -> None:
    x, P = sources(np.random.default_rng(SEED), N, 3)
    A = np.linalg.inv(P)
    S = A.sum(axis=0)
    share = np.array([np.linalg.det(S) - np.linalg.det(S - a) + np.linalg.det(a) for a in A])
    np.testing.assert_allclose(fuse("fast-ci", x, P).weights, share / share.sum(), rtol=1e-10)
    share = 1.0 / np.trace(P, axis1=1, axis2=2)
    np.testing.assert_allclose(fuse("fast-ci", x, P, criterion="trace").weights, share / share.sum(), rtol=1e-12)


@pytest.mark.parametrize("criterion", ["det", "trace"])
def test_fast_ci_and_ffcc_bound_the_error_of_every_correlation(criterion: str) -> None:
    """FFCC also where every source understates its covariance by delta."""
    rng = np.random.default_rng(SEED)
    for N in (2, 3):
        x, P = sources(rng, N, 3)
        everything = np.ones((N, N))
        fused = fuse("fast-ci", x, P, criterion=criterion)
        assert (
            0.5 < worst_ratio(P, fused.covariance, gains_of(P, fused.weights, fused.covariance), everything) < 1 + 1e-7
        )
        wide = fuse("ffcc", x, P, criterion=criterion, delta=0.6)
        np.testing.assert_allclose(wide.weights, 0.6 * fused.weights)
        np.testing.assert_allclose(wide.mean, fused.mean, rtol=1e-9)
        K = gains_of(P, wide.weights, wide.covariance)
        assert 0.5 < worst_ratio(P / 0.6, wide.covariance, K, everything) < 1 + 1e-7


def test_equal_sources_under_ffcc_are_wider_by_delta() -> None:
    x, P = (np.repeat(a, 3, axis=0) for a in sources(np.random.default_rng(SEED), 1, 2))
    fused = fuse("ffcc", x, P, delta=0.8)
    np.testing.assert_allclose(fused.mean, x[0], rtol=1e-12)
    np.testing.assert_allclose(fused.covariance, P[0] / 0.8, rtol=1e-9)


def test_equal_sources_under_naive_and_bci() -> None:
    """As N independent ones, and between that and themselves."""
    x, P = (np.repeat(a, 4, axis=0) for a in sources(np.random.default_rng(SEED), 1, 3))
    np.testing.assert_allclose(fuse("naive", x, P).covariance, P[0] / 4, rtol=1e-9)
    for rho in (0.0, 0.3, 1.0):
        fused = fuse("bci", x, P, max_correlation=rho)
        np.testing.assert_allclose(fused.mean, x[0], rtol=1e-12)
        np.testing.assert_allclose(fused.covariance, P[0] * (1 + 3 * rho) / 4, rtol=1e-9)


# ------------------------------------------------------------------ arithmetic average


@pytest.mark.parametrize("n", [1, 2])
def test_aa_has_the_moments_of_the_mixture(n: int) -> None:
    x, P = sources(np.random.default_rng(SEED), 3, n, decades=0.6)
    w = np.array([0.5, 0.2, 0.3])
    axes = [np.linspace(-14, 14, 4001 if n == 1 else 561)] * n
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, n)
    p = sum(w[i] * multivariate_normal(x[i], P[i]).pdf(grid) for i in range(3))
    p = p / p.sum()
    mean = p @ grid
    fused = fuse("aa", x, P, weights=w, influence=True)
    np.testing.assert_allclose(fused.mean, mean, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(fused.covariance, (grid - mean).T * p @ (grid - mean), rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(fused.influence, w)
    np.testing.assert_array_equal(fuse("aa", x, P).weights, np.full(3, 1 / 3))


def merged(x: Floats, P: Floats, w: Floats) -> tuple[Floats, Floats]:
    m = w @ x
    return m, np.asarray(np.einsum("i,ijk->jk", w, P) + ((x - m).T * w) @ (x - m))


def divergences(x: Floats, P: Floats, w: Floats) -> Floats:
    """KL(p_i, merged average), as Li-AA prints it."""
    m, S = merged(x, P, w)
    A = np.linalg.inv(S)
    return np.array(
        [
            0.5 * (np.trace(A @ p) - len(m) + np.linalg.slogdet(S)[1] - np.linalg.slogdet(p)[1] + (y - m) @ A @ (y - m))
            for y, p in zip(x, P, strict=True)
        ]
    )


def lowest(f: Any, N: int) -> float:
    starts = (np.zeros(N), *(3.0 * np.eye(N)))
    return float(min(minimize(lambda z: f(np.exp(z) / np.exp(z).sum()), z, options={"gtol": 1e-9}).fun for z in starts))


@pytest.mark.parametrize(("N", "n"), [(2, 1), (2, 4), (3, 1), (3, 2), (5, 3), (4, 12)])
def test_diversity_weights_solve_40(N: int, n: int) -> None:
    rng = np.random.default_rng(SEED)
    for _ in range(3):
        x, P = sources(rng, N, n)
        fused = fuse("aa", x, P, criterion="diversity")

        def f(w: Floats) -> float:
            return -float(w @ divergences(x, P, w))  # noqa: B023

        assert f(fused.weights) <= lowest(f, N) + 1e-7
        apart = divergences(x, P, fused.weights)
        used = fused.weights > 1e-6
        np.testing.assert_allclose(apart[used], apart.max(), rtol=1e-4)  # (37), on active weights
        np.testing.assert_allclose(fused.covariance, merged(x, P, fused.weights)[1], rtol=1e-9)


@pytest.mark.parametrize(("N", "n"), [(2, 1), (2, 3), (3, 2), (5, 2)])
def test_bound_weights_solve_45(N: int, n: int) -> None:
    """Not convex: the best of a dense scan for two; for more no worse than anything near."""
    rng = np.random.default_rng(SEED)
    for _ in range(3):
        x, P = sources(rng, N, n)
        z = np.array([[multivariate_normal(x[j], P[i] + P[j]).pdf(x[i]) for j in range(N)] for i in range(N)])

        def f(w: Floats) -> float:
            return float(w @ np.log(np.sqrt(np.linalg.det(P)) * (z @ w)))  # noqa: B023

        w = fuse("aa", x, P, criterion="bound").weights
        others = np.linspace(0, 1, 2001)
        tried = np.stack([others, 1 - others], axis=1) if N == 2 else w * np.exp(0.02 * rng.normal(size=(500, N)))
        assert f(w) <= min(f(v / v.sum()) for v in (*tried, np.full(N, 1 / N))) + 1e-7


# ------------------------------------------------------------------ covariance union


def adjusted(x: Floats, P: Floats, w: Floats) -> Floats:
    """Li-AA (11)."""
    d = w @ x - x
    return np.asarray(P + d[:, :, None] * d[:, None, :])


@pytest.mark.parametrize("criterion", ["det", "trace"])
@pytest.mark.parametrize(("N", "n"), [(2, 1), (2, 2), (3, 2), (2, 3), (4, 2), (3, 3)])
def test_cu_is_the_smallest_bound(N: int, n: int, criterion: str) -> None:
    rng = np.random.default_rng(SEED)
    lower = np.tril_indices(n)
    for _ in range(2):
        x, P = sources(rng, N, n, decades=1.0)
        w = rng.dirichlet(np.ones(N))
        U = adjusted(x, P, w)
        fused = fuse("cu", x, P, criterion=criterion, weights=w)
        np.testing.assert_allclose(fused.mean, w @ x, rtol=1e-12, atol=1e-12)
        assert all(np.linalg.eigvalsh(fused.covariance - u).min() >= -1e-12 for u in U)

        def unpack(z: Floats) -> Floats:
            L = np.zeros((n, n))
            L[lower] = z
            return L @ L.T

        def size(S: Floats) -> float:
            return float(np.linalg.slogdet(S)[1] if criterion == "det" else np.log(np.trace(S)))

        start = np.linalg.cholesky(U.sum(axis=0))[lower]
        constraints = [{"type": "ineq", "fun": lambda z, u=u: np.linalg.eigvalsh(unpack(z) - u)} for u in U]
        found = minimize(
            lambda z: size(unpack(z)), start, constraints=constraints, method="SLSQP", options={"ftol": 1e-12}
        )
        slack = min(np.linalg.eigvalsh(unpack(found.x) - u).min() for u in U)
        assert size(fused.covariance) <= found.fun + 1e-6 + 10 * n * max(0.0, -slack)


@pytest.mark.parametrize("criterion", ["det", "trace"])
@pytest.mark.parametrize("small", [1e-3, 1e-6, 1e-9])
def test_union_holds_beside_a_source_that_claims_far_too_much(criterion: str, small: float) -> None:
    """It is found, above all, and in the limit what follows without the small covariance: for that, U_3 = d d' alone,
    the least P above U_1 and U_2 with d' P^-1 d <= 1."""
    rng = np.random.default_rng(SEED)
    x = rng.normal(size=(40, 3, 4)) * np.array([30.0, 30.0, 2.0, 2.0])
    P = np.tile(np.diag([900.0, 900.0, 4.0, 4.0]), (40, 3, 1, 1))
    P[:, 2] *= small
    fused = fuse("cu", x, P, criterion=criterion)
    scale = np.diag(1.0 / np.array([30.0, 30.0, 2.0, 2.0]))
    for one, mean, found in zip(x, P, fused.covariance, strict=True):
        for u in adjusted(one, mean, np.full(3, 1 / 3)):
            assert np.linalg.eigvalsh(scale @ (found - u) @ scale).min() >= -1e-9
    P[:, 2] *= 1e-3
    limit = fuse("cu", x, P, criterion=criterion)
    change = np.abs(scale @ (limit.covariance - fused.covariance) @ scale).max(axis=(1, 2))
    assert (change <= 100 * small + 1e-4).all(), change.max()


def test_intersection_and_union_of_ellipsoids_add_up_however_hard() -> None:
    """T min(r, 1) T' + T max(r, 1) T' = P_1 + P_2, and their determinants multiply to |P_1| |P_2|; or refused."""
    rng = np.random.default_rng(SEED)
    done = {True: 0, False: 0}
    for decades in (0.0, 3.0, 6.0, 9.0, 12.0):
        for size in (0.0, 6.0, 12.0):
            for _ in range(4):
                _, P = sources(rng, 2, 3, decades)
                unit = 10.0 ** rng.uniform(-3, 3, 3)
                P *= np.outer(unit, unit)
                P[1] *= 10.0**size
                try:
                    inner, outer = (fuse(rule, np.zeros((2, 3)), P).covariance for rule in ("ei", "cu"))
                except RuleError:
                    done[False] += 1
                    assert decades >= 9.0
                    continue
                done[True] += 1
                np.testing.assert_allclose(inner + outer, P.sum(axis=0), rtol=1e-6, atol=1e-6 * np.abs(P).max())
                logs = [np.linalg.slogdet(S)[1] for S in (inner, outer, *P)]
                if decades < 9.0:  # the oracle's own rounding
                    assert logs[0] + logs[1] == pytest.approx(logs[2] + logs[3], abs=1e-6)
    assert done[True] >= 36


def test_cu_min_and_chain_13() -> None:
    """(9), the smallest adjusted covariance; in trace below AA's and the union's, as in (13)."""
    x, P = sources(np.random.default_rng(SEED), 3, 2)
    w = np.full(3, 1 / 3)
    U = adjusted(x, P, w)
    for criterion, size in (("det", np.linalg.det), ("trace", lambda u: np.trace(u, axis1=1, axis2=2))):
        least = fuse("cu", x, P, bound="min", criterion=criterion)
        np.testing.assert_allclose(least.covariance, U[np.argmin(size(U))], rtol=1e-12)
    cases: tuple[tuple[str, dict[str, Any]], ...] = (("cu", {"bound": "min"}), ("aa", {}), ("cu", {}))
    low, middle, high = (np.trace(fuse(rule, x, P, **options).covariance) for rule, options in cases)
    assert low < middle < high


def test_cu_holds_if_one_source_is_right() -> None:
    """Truth drawn from any one source: its second moment about the fused mean is within P. AA's is not."""
    x, P = np.array([[0.0, 0.0], [6.0, 1.0]]), np.stack([np.eye(2), np.diag([1.0, 3.0])])
    union, average = fuse("cu", x, P), fuse("aa", x, P, weights=[0.9, 0.1])
    for i in range(2):
        d = union.mean - x[i]
        assert np.linalg.eigvalsh(union.covariance - P[i] - np.outer(d, d)).min() >= -1e-12
    d = average.mean - x[1]
    assert np.linalg.eigvalsh(average.covariance - P[1] - np.outer(d, d)).min() < -1.0


def test_the_one_that_knows_nothing_may_be_the_only_one_that_is_right() -> None:
    """A liar of sigma 10 m, 1 km off, and an honest one of 10,000 km, 1e-12 of its information: with both the error
    is within the union, as promised; without the one that tells nothing the promise is kept by nobody."""
    truth, x = np.array([1000.0, 0.0]), np.zeros((2, 2))
    P = np.stack([100.0 * np.eye(2), 1e14 * np.eye(2)])
    assert (truth - x[1]) @ np.linalg.solve(P[1], truth - x[1]) < 1.0
    union = fuse("cu", x, P)
    d = truth - union.mean
    assert d @ np.linalg.solve(union.covariance, d) < 1.0
    d = truth - x[0]
    assert d @ np.linalg.solve(P[0], d) > 1e3


def test_lemma_2_needs_more_than_conservative_sources() -> None:
    """Variances 1 and 100, fully correlated, equal weights: error 30.25, but min reports 21.25 on average."""
    e = np.random.default_rng(SEED).normal(size=20_000)
    e = (e - e.mean()) / e.std()
    x = np.stack([e, 10.0 * e], axis=1)[..., None]
    P = np.broadcast_to(np.array([1.0, 100.0]).reshape(2, 1, 1), (len(e), 2, 1, 1))
    least, most = (fuse("cu", x, P, bound=bound) for bound in ("min", "max"))
    assert (least.mean**2).mean() == pytest.approx(30.25)
    assert least.covariance.mean() == pytest.approx(21.25)
    assert most.covariance.mean() > 30.25
