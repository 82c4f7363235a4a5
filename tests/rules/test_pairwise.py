"""ICI, EI and fusion with a known cross-covariance: formulas, weights, promises, order."""

from itertools import permutations
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh, sqrtm
from scipy.optimize import minimize, minimize_scalar

from fusion_service.arrays import Floats
from fusion_service.rules import RuleError, fuse, fuse_last
from tests.helpers.strategies import covariance, sources

SEED = 2017
CRITERIA = ("det", "trace")
PAIR = np.stack([np.diag([4.0, 1.0]), np.diag([1.0, 4.0])])
"""The counter-example's covariances, with E[e1_2 e2_1] = .9 and no other cross-term."""


def inverse_ci(x: Floats, P: Floats, w: Floats) -> tuple[Floats, Floats]:
    """Sharma (47), with the leading covariance that it lacks."""
    A = np.linalg.inv(P)
    G = w[0] * P[0] + w[1] * P[1]
    fused = np.linalg.inv(A[0] + A[1] - np.linalg.inv(G))
    return fused @ (A[0] @ x[0] + A[1] @ x[1] - np.linalg.solve(G, w @ x)), fused


def gains(rule: str, P: Floats, **options: Any) -> Floats:
    """Gains (N, n, n) of a rule that is linear in the means, read off its results."""
    N, n = P.shape[:2]
    units = np.eye(N * n).reshape(N * n, N, n)
    fused = fuse(rule, units, np.broadcast_to(P, (N * n, *P.shape)), **options)
    return fused.mean.reshape(N, n, n).swapaxes(1, 2)


def worst(fused: Floats, K: Floats, joint: Floats) -> float:
    """Largest eigenvalue of the true error's covariance relative to the reported one."""
    whole = np.hstack(list(K))
    return float(eigh(whole @ joint @ whole.T, fused, eigvals_only=True)[-1])


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6, 7, 12])
def test_ici_weights_are_the_best_and_moments_those_of_the_formula(n: int, criterion: str) -> None:
    rng = np.random.default_rng(SEED + n)
    for decades in (0.5, 2.0, 5.0):
        x, P = sources(rng, 2, n, decades)
        fused = fuse("ici", x, P, criterion=criterion)

        def size(S: Floats) -> float:
            return float(np.linalg.slogdet(S)[1] if criterion == "det" else np.log(np.trace(S)))

        def f(t: float) -> float:
            return size(inverse_ci(x, P, np.array([t, 1 - t]))[1])  # noqa: B023

        inside = minimize_scalar(f, bounds=(0, 1), method="bounded", options={"xatol": 1e-11}).fun
        assert size(fused.covariance) <= min(inside, f(1e-12), f(1 - 1e-12)) + 1e-9
        mean, S = inverse_ci(x, P, fused.weights)
        np.testing.assert_allclose(fused.mean, mean, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(fused.covariance, S, rtol=1e-6, atol=1e-7 * np.abs(S).max())
        given = fuse("ici", x, P, weights=[0.3, 0.7])
        np.testing.assert_allclose(given.covariance, inverse_ci(x, P, np.array([0.3, 0.7]))[1], rtol=1e-5, atol=1e-9)


def test_ici_pairs_as_fast_as_certified() -> None:
    """The short road for det gives weights as good as the long one: few fusions are done twice."""
    rng = np.random.default_rng(SEED)
    drawn = [sources(rng, 2, 6, 3.0) for _ in range(300)]
    x, P = (np.stack(a) for a in zip(*drawn, strict=True))
    det = fuse("ici", x, P)
    for b in range(0, 300, 10):
        values = [np.linalg.slogdet(inverse_ci(x[b], P[b], np.array([t, 1 - t]))[1])[1] for t in np.linspace(0, 1, 201)]
        assert np.linalg.slogdet(det.covariance[b])[1] <= min(values) + 1e-9


def common_information(z: Floats, P: Floats) -> Floats:
    """Some X with 0 <= X <= P_i^-1 for both, at the limit: the information both sources have in common."""
    n = P.shape[1]
    X = z.reshape(n, n) @ z.reshape(n, n).T
    return np.asarray(X / max(np.linalg.eigvals(X @ p).real.max() for p in P))


@pytest.mark.parametrize("criterion", CRITERIA)
def test_ici_is_conservative_under_its_own_structure(criterion: str) -> None:
    """P_12 = P_1 X P_2, (54), for the worst X found by search; and tight, for some X is nearly met."""
    rng = np.random.default_rng(SEED)
    for _ in range(3):
        P = np.stack([covariance(rng, 2), covariance(rng, 2)])
        fused, K = (
            fuse("ici", np.zeros((2, 2)), P, criterion=criterion).covariance,
            gains("ici", P, criterion=criterion),
        )

        def ratio(z: Floats) -> float:
            cross = P[0] @ common_information(z, P) @ P[1]  # noqa: B023
            return worst(fused, K, np.block([[P[0], cross], [cross.T, P[1]]]))  # noqa: B023

        found = max(-minimize(lambda z: -ratio(z), rng.normal(size=4), method="Nelder-Mead").fun for _ in range(4))
        assert 0.5 < found <= 1.0 + 1e-9


def test_the_counter_example() -> None:
    """What is promised for every correlation, and what is not: largest eigenvalue of true over reported."""
    joint = np.zeros((4, 4))
    joint[:2, :2], joint[2:, 2:] = PAIR
    joint[1, 2] = joint[2, 1] = 0.9
    assert np.linalg.eigvalsh(joint).min() > 0.0
    found = {}
    for rule in ("naive", "ei", "ici", "ci", "fast-ci"):
        fused = fuse(rule, np.zeros((2, 2)), PAIR)
        found[rule] = worst(fused.covariance, gains(rule, PAIR), joint)
    assert found["naive"] == pytest.approx(1.72, abs=0.005)
    assert found["ei"] == pytest.approx(1.90, abs=0.005)
    assert found["ici"] == pytest.approx(1.44, abs=0.005)
    assert found["ci"] == pytest.approx(0.86, abs=0.005)
    assert found["fast-ci"] <= 1.0


@pytest.mark.parametrize("n", [1, 2, 5, 12])
def test_ei_is_sijs_and_lazar(n: int) -> None:
    """Their eigenvectors and mutual estimate, without regularisation, far from r = 1."""
    rng = np.random.default_rng(SEED)
    x, P = sources(rng, 2, n)
    d1, S1 = np.linalg.eigh(P[0])
    half = S1 * np.sqrt(d1)
    back = np.linalg.inv(half)
    d2, S2 = np.linalg.eigh(back @ P[1] @ back.T)
    assert np.abs(d2 - 1.0).min() > 1e-2
    G = half @ (S2 * np.maximum(d2, 1.0)) @ S2.T @ half.T
    A, V = np.linalg.inv(P), np.linalg.inv(G)
    mutual = np.linalg.pinv(A[0] + A[1] - 2 * V) @ ((A[1] - V) @ x[0] + (A[0] - V) @ x[1])
    S = np.linalg.inv(A[0] + A[1] - V)
    fused = fuse("ei", x, P)
    np.testing.assert_allclose(fused.covariance, S, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(fused.mean, S @ (A[0] @ x[0] + A[1] @ x[1] - V @ mutual), rtol=1e-3, atol=1e-3)
    assert np.isnan(fused.weights).all()
    for p in P:
        assert np.linalg.eigvalsh(p - fused.covariance).min() >= -1e-9


def test_ei_shares_where_both_are_equally_good() -> None:
    fused = fuse("ei", [[0.0, 0.0, 0.0], [2.0, 2.0, 2.0]], [np.diag([1.0, 1.0, 4.0]), np.diag([1.0, 3.0, 1.0])])
    np.testing.assert_allclose(fused.mean, [1.0, 0.0, 2.0], atol=1e-5)
    np.testing.assert_allclose(fused.covariance, np.eye(3), atol=1e-12)


def with_correlation(rng: np.random.Generator, n: int, rho: float) -> tuple[Floats, Floats, Floats]:
    x, P = sources(rng, 2, n)
    Z = rng.normal(size=(n, n))
    return x, P, np.real(sqrtm(P[0])) @ (rho * Z / np.linalg.norm(Z, 2)) @ np.real(sqrtm(P[1]))


@pytest.mark.parametrize("n", [1, 2, 4, 9])
@pytest.mark.parametrize("rho", [0.0, 0.7, 0.999])
def test_known_cross_covariance_is_blue(n: int, rho: float) -> None:
    rng = np.random.default_rng(SEED)
    x, P, cross = with_correlation(rng, n, rho)
    fused = fuse("bar-shalom-campo", x, P, cross_covariance=cross, influence=True)
    K = np.linalg.solve(P[0] + P[1] - cross - cross.T, (P[0] - cross).T).T
    np.testing.assert_allclose(fused.mean, x[0] + K @ (x[1] - x[0]), rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(fused.covariance, P[0] - K @ (P[0] - cross.T), rtol=1e-7, atol=1e-9)
    assert fused.influence is not None
    assert fused.influence[1] == pytest.approx(np.trace(K) / n, rel=1e-7)
    joint = np.block([[P[0], cross], [cross.T, P[1]]])
    for _ in range(20):
        L = K + 0.1 * rng.normal(size=(n, n))
        other = np.hstack([np.eye(n) - L, L])
        assert np.linalg.eigvalsh(other @ joint @ other.T - fused.covariance).min() >= -1e-9
    if rho == 0.0:
        np.testing.assert_allclose(fused.covariance, fuse("naive", x, P).covariance, rtol=1e-9)


def test_cross_covariances_go_with_their_fusions() -> None:
    """One per element, hard ones too; and what is not a covariance is refused, that element only."""
    rng = np.random.default_rng(SEED)
    drawn = [with_correlation(rng, 2, rho) for rho in (0.0, 0.5, 0.9, 1.0 - 1e-9, 0.3, 1.2)]
    x, P, cross = (np.stack(a) for a in zip(*drawn, strict=True))
    fused = fuse("bar-shalom-campo", x[:5], P[:5], cross_covariance=cross[:5])
    for b in range(5):
        one = fuse("bar-shalom-campo", x[b], P[b], cross_covariance=cross[b])
        np.testing.assert_array_equal(one.covariance, fused.covariance[b])
    with pytest.raises(RuleError, match=r"element \(5,\) .*joint covariance is not positive definite"):
        fuse("bar-shalom-campo", x, P, cross_covariance=cross)
    last = fuse_last(
        "bar-shalom-campo", x.transpose(1, 2, 0), P.transpose(1, 2, 3, 0), cross_covariance=cross.transpose(1, 2, 0)
    )
    np.testing.assert_array_equal(last.covariance[..., :5], fused.covariance.transpose(1, 2, 0))
    assert np.isnan(last.covariance[..., 5]).all()


@pytest.mark.parametrize(("rule", "options"), [("ici", {}), ("ici", {"criterion": "trace"}), ("ei", {})])
def test_more_than_two_are_fused_in_the_stated_order(rule: str, options: dict[str, Any]) -> None:
    rng = np.random.default_rng(SEED)
    x, P = sources(rng, 4, 2)
    P[1] = P[0][::-1, ::-1]  # an equal determinant
    x[3], P[3] = x[2], P[2] * 1.0  # an equal source
    whole = fuse(rule, x, P, influence=True, **options)
    for shuffled in permutations(range(4)):
        again = fuse(rule, x[list(shuffled)], P[list(shuffled)], **options)
        np.testing.assert_array_equal(again.covariance, whole.covariance)
        np.testing.assert_array_equal(again.mean, whole.mean)
    order = sorted(range(4), key=lambda i: (np.linalg.det(P[i]), *x[i]))
    mean, S = x[order[0]], P[order[0]]
    for i in order[1:]:
        step = fuse(rule, np.stack([mean, x[i]]), np.stack([S, P[i]]), **options)
        mean, S = step.mean, step.covariance
    np.testing.assert_allclose(whole.mean, mean, rtol=1e-9)
    np.testing.assert_allclose(whole.covariance, S, rtol=1e-9)


@pytest.mark.parametrize("N", [2, 3, 5])
def test_given_weights_and_influence_of_many(N: int) -> None:
    """w_i = (1 - t_i) t_{i+1} ... t_N is read and given back; influence is that of the gains."""
    rng = np.random.default_rng(SEED)
    x, P = sources(rng, N, 3)
    w = rng.dirichlet(np.ones(N))
    order = np.argsort(np.linalg.det(P))
    mean, S = x[order[0]], P[order[0]]
    for k in range(1, N):
        t = w[order[:k]].sum() / w[order[: k + 1]].sum()
        mean, S = inverse_ci(np.stack([mean, x[order[k]]]), np.stack([S, P[order[k]]]), np.array([t, 1 - t]))
    fused = fuse("ici", x, P, weights=w)
    np.testing.assert_allclose(fused.covariance, S, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(fused.mean, mean, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(fused.weights, w, rtol=1e-9)
    for rule in ("ici", "ei"):
        K = gains(rule, P)
        if N > 2:  # the means decide equal determinants only
            np.testing.assert_allclose(K.sum(axis=0), np.eye(3), atol=1e-8)
        share = fuse(rule, x, P, influence=True).influence
        assert share is not None
        np.testing.assert_allclose(share, np.trace(K, axis1=1, axis2=2) / 3, atol=1e-7)


def test_equal_sources_with_known_correlation() -> None:
    """Not themselves: with P_12 = c P the errors average out to (1 + c) / 2 P."""
    x, P = (np.repeat(a, 2, axis=0) for a in sources(np.random.default_rng(SEED), 1, 3))
    for c in (0.0, 0.5, 0.99):
        fused = fuse("bar-shalom-campo", x, P, cross_covariance=c * P[0])
        np.testing.assert_allclose(fused.mean, x[0], rtol=1e-12)
        np.testing.assert_allclose(fused.covariance, (1 + c) / 2 * P[0], rtol=1e-8)


def joint(rng: np.random.Generator, N: int, n: int) -> tuple[Floats, Floats, Floats]:
    """x (N, n), P (N, n, n), and all cross-covariances (N, N, n, n) of some joint covariance."""
    A = rng.normal(size=(N * n, N * n))
    J = A @ A.T + 0.2 * np.eye(N * n)
    blocks = J.reshape(N, n, N, n).swapaxes(1, 2)
    return rng.normal(size=(N, n)), np.stack([blocks[i, i] for i in range(N)]), blocks


@pytest.mark.parametrize("N", [1, 2, 3, 5])
@pytest.mark.parametrize("n", [1, 2, 4])
def test_known_cross_covariances_of_many_are_maximum_likelihood(N: int, n: int) -> None:
    """Against a dense solve of the whole joint covariance; and no other unbiased combination is better."""
    rng = np.random.default_rng(SEED)
    x, P, cross = joint(rng, N, n)
    fused = fuse("bar-shalom-campo", x, P, cross_covariance=cross, influence=True)
    J, H = cross.swapaxes(1, 2).reshape(N * n, N * n), np.tile(np.eye(n), (N, 1))
    inverse = np.linalg.inv(J)
    want = np.linalg.inv(H.T @ inverse @ H)
    K = want @ H.T @ inverse
    np.testing.assert_allclose(fused.covariance, want, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(fused.mean, K @ x.ravel(), rtol=1e-7, atol=1e-9)
    assert fused.influence is not None
    shares = [np.trace(K[:, i * n : (i + 1) * n]) / n for i in range(N)]
    np.testing.assert_allclose(fused.influence, shares, rtol=1e-6, atol=1e-8)
    for _ in range(20):
        other = K + 0.1 * rng.normal(size=K.shape)
        other[:, :n] -= other @ H - np.eye(n)
        assert np.linalg.eigvalsh(other @ J @ other.T - fused.covariance).min() >= -1e-9
    ignored = cross.copy()
    ignored[range(N), range(N)] = np.eye(n)
    again = fuse("bar-shalom-campo", x, P, cross_covariance=ignored)
    np.testing.assert_array_equal(again.covariance, fused.covariance)


def test_many_with_known_cross_covariances_are_as_good_as_they_say() -> None:
    """Monte Carlo: the mean squared error is the covariance reported, and that of CI and the naive rule is larger."""
    rng = np.random.default_rng(SEED)
    N, n, runs = 3, 2, 40_000
    _, P, cross = joint(rng, N, n)
    J = cross.swapaxes(1, 2).reshape(N * n, N * n)
    errors = (np.linalg.cholesky(J) @ rng.normal(size=(N * n, runs))).T.reshape(runs, N, n)
    many = np.broadcast_to(P, (runs, *P.shape))
    fused = fuse("bar-shalom-campo", errors, many, cross_covariance=cross)
    true = fused.mean.T @ fused.mean / runs
    # the estimate of a variance has a standard error of sqrt(2 / runs), 0.7 %
    ratios = np.linalg.eigvals(np.linalg.solve(fused.covariance[0], true)).real
    assert np.abs(ratios - 1.0).max() < 0.03
    for rule in ("naive", "ci"):
        other = fuse(rule, errors, many).mean
        assert np.trace(other.T @ other) > 1.01 * np.trace(fused.mean.T @ fused.mean)


def test_cross_covariances_of_a_batch_in_both_layouts() -> None:
    rng = np.random.default_rng(SEED)
    drawn = [joint(rng, 3, 2) for _ in range(6)]
    x, P, cross = (np.stack(a) for a in zip(*drawn, strict=True))
    cross[5, 0, 1] *= 40.0
    cross[5, 1, 0] *= 40.0
    fused = fuse("bar-shalom-campo", x[:5], P[:5], cross_covariance=cross[:5])
    for b in range(5):
        one = fuse("bar-shalom-campo", x[b], P[b], cross_covariance=cross[b])
        np.testing.assert_array_equal(one.covariance, fused.covariance[b])
    with pytest.raises(RuleError, match=r"element \(5,\) .*joint covariance is not positive definite"):
        fuse("bar-shalom-campo", x, P, cross_covariance=cross)
    last = fuse_last(
        "bar-shalom-campo",
        x.transpose(1, 2, 0),
        P.transpose(1, 2, 3, 0),
        cross_covariance=cross.transpose(1, 2, 3, 4, 0),
    )
    np.testing.assert_array_equal(last.covariance[..., :5], fused.covariance.transpose(1, 2, 0))
    assert np.isnan(last.covariance[..., 5]).all()
    pair = fuse("bar-shalom-campo", x[:5, :2], P[:5, :2], cross_covariance=cross[:5, 0, 1])
    whole = fuse("bar-shalom-campo", x[:5, :2], P[:5, :2], cross_covariance=cross[:5, :2, :2])
    np.testing.assert_array_equal(pair.covariance, whole.covariance)


def test_the_order_of_sources_with_known_cross_covariances_does_not_matter() -> None:
    rng = np.random.default_rng(SEED)
    x, P, cross = joint(rng, 4, 3)
    fused = fuse("bar-shalom-campo", x, P, cross_covariance=cross)
    for order in permutations(range(4)):
        o = list(order)
        again = fuse("bar-shalom-campo", x[o], P[o], cross_covariance=cross[np.ix_(o, o)])
        np.testing.assert_allclose(again.mean, fused.mean, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(again.covariance, fused.covariance, rtol=1e-7, atol=1e-10)
