"""The best weights of three sources and more: against the interior point, and the certificate of D-optimal design."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from fusion_service.arrays import Floats
from fusion_service.rules import fuse_last
from fusion_service.rules.ci import KEPT, NEARER, Inflated
from fusion_service.rules.weights import active, simplex

SEED = 20261127
N_B = (3, 4, 5, 20)


def wishart(rng: np.random.Generator, N: int, size: int, n: int = 4) -> Floats:
    G = rng.normal(size=(N, n, n + 2, size))
    return np.asarray(np.einsum("sikb,sjkb->sijb", G, G))


def one_shape(rng: np.random.Generator, N: int, size: int) -> Floats:
    """Position and velocity of the same shape, as trackers say it: at most three sources of a plane have weight."""
    block = wishart(rng, N, size, 2)
    return np.asarray(np.einsum("ac,sijb->saicjb", [[400.0, 12.0], [12.0, 4.0]], block).reshape(N, 4, 4, size))


def scaled(rng: np.random.Generator, N: int, size: int) -> Floats:
    units = 10.0 ** rng.uniform(-3, 3, (1, 4, 1, size)) * 10.0 ** rng.uniform(-1, 1, (N, 1, 1, size))
    return wishart(rng, N, size) * units * units.swapaxes(1, 2)


def singular(rng: np.random.Generator, N: int, size: int) -> Floats:
    G = rng.normal(size=(N, 4, 4, size))
    return np.asarray(np.einsum("sikb,sjkb->sijb", G, G))


def twins(rng: np.random.Generator, N: int, size: int) -> Floats:
    P = wishart(rng, N, size)
    P[1] = P[0]
    return P


def dominated(rng: np.random.Generator, N: int, size: int) -> Floats:
    P = wishart(rng, N, size)
    P[1] = P[0] * rng.uniform(1.05, 3.0, size)
    return P


KINDS: dict[str, Callable[[np.random.Generator, int, int], Floats]] = {
    one.__name__: one for one in (wishart, one_shape, scaled, singular, twins, dominated)
}


def information(P: Floats) -> Floats:
    """(n, n, N, B)"""
    A = np.linalg.inv(P.transpose(3, 0, 1, 2))
    return np.ascontiguousarray((0.5 * (A + A.swapaxes(2, 3))).transpose(2, 3, 1, 0))


def judged(criterion: str, A: Floats, w: Floats) -> tuple[Floats, Floats]:
    """Value and gap (B,), by LAPACK."""
    each = A.transpose(3, 2, 0, 1)
    V = np.linalg.inv(np.einsum("sb,bsij->bij", w, each))
    if criterion == "det":
        value, slope = np.linalg.slogdet(V)[1], np.einsum("bij,bsji->bs", V, each)
        return value, slope.max(axis=1) - A.shape[0]
    size = np.trace(V, axis1=1, axis2=2)
    return np.log(size), np.einsum("bij,bsjk,bki->bs", V, each, V).max(axis=1) / size - 1.0


@pytest.mark.parametrize("criterion", ["det", "trace"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("N", N_B)
def test_as_good_as_the_interior_point(N: int, kind: str, criterion: str) -> None:
    A = information(KINDS[kind](np.random.default_rng(SEED), N, 40))
    model, uniform = Inflated(A, 1.0), np.full((N, 40), 1.0 / N)
    with np.errstate(all="ignore"):
        w, safe = active.best_weights(criterion, model, uniform), simplex.best_weights(criterion, model, uniform)
    (value, gap), (low, other) = judged(criterion, A, w), judged(criterion, A, safe)
    assert (w >= 0.0).all()
    np.testing.assert_allclose(w.sum(axis=0), 1.0, atol=1e-12)
    assert (value <= low + 1e-9).all(), SEED
    assert (gap <= np.maximum(10.0 * simplex.GAP, 2.0 * other)).all(), SEED
    assert (w == 0.0).any(), SEED


@pytest.mark.parametrize("criterion", ["det", "trace"])
@pytest.mark.parametrize("N", [3, 20])
def test_the_safe_road_is_seldom_needed(N: int, criterion: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    safe = simplex.best_weights

    def counted(criterion: str, model: simplex.Model, start: Floats) -> Floats:
        asked.append(start.shape[1])
        return safe(criterion, model, start)

    monkeypatch.setattr(simplex, "best_weights", counted)
    A = information(one_shape(np.random.default_rng(SEED), N, 200))
    active.best_weights(criterion, Inflated(A, 1.0), np.full((N, 200), 1.0 / N))
    assert sum(asked) <= 2, SEED


def test_of_a_source_that_another_contains_nothing_is_taken() -> None:
    A = information(dominated(np.random.default_rng(SEED), 3, 50))
    w = active.best_weights("det", Inflated(A, 1.0), np.full((3, 50), 1.0 / 3.0))
    np.testing.assert_array_equal(w[1], 0.0)


@pytest.mark.parametrize("N", [3, 7])
def test_equal_sources_have_equal_weights(N: int) -> None:
    A = information(np.repeat(wishart(np.random.default_rng(SEED), 1, 5), N, axis=0))
    uniform = np.full((N, 5), 1.0 / N)
    np.testing.assert_array_equal(active.best_weights("det", Inflated(A, 1.0), uniform), uniform)


@pytest.mark.parametrize("N", [3, 6, 20])
def test_bits_do_not_depend_on_the_batch(N: int) -> None:
    rng = np.random.default_rng(SEED)
    A = information(np.concatenate([wishart(rng, N, 15), one_shape(rng, N, 15)], axis=-1))
    uniform = np.full((N, 30), 1.0 / N)
    near = np.where(np.arange(30) % 3 == 0, np.nan, rng.dirichlet(np.ones(N), 30).T)
    for start in (None, near):
        whole = active.best_weights("det", Inflated(A, 1.0), uniform, start)
        for at in ([3], [4], [29], [0, 7, 20]):
            few = None if start is None else start[:, at]
            part = active.best_weights("det", Inflated(A[..., at], 1.0), uniform[:, at], few)
            np.testing.assert_array_equal(part, whole[:, at])
    none = active.best_weights("det", Inflated(A[..., :0], 1.0), uniform[:, :0], near[:, :0])
    assert none.shape == (N, 0)


@pytest.mark.parametrize("criterion", ["det", "trace"])
@pytest.mark.parametrize("N", [3, 20])
def test_covariances_that_change_are_followed(N: int, criterion: str) -> None:
    """By .3 % a step: the weights of the step before are kept within their certificate, else brought to the best."""
    rng = np.random.default_rng(SEED)
    P, x = wishart(rng, N, 60), rng.normal(size=(N, 4, 60))
    w = fuse_last("ci", x, P, criterion=criterion).weights
    sought = 0
    for _ in range(4):
        E = np.eye(4)[None, :, :, None] + 0.003 * rng.normal(size=(N, 4, 4, 60))
        P = np.einsum("sikb,sklb,sjlb->sijb", E, P, E)
        fused = fuse_last("ci", x, P, criterion=criterion, start=w)
        anew = (np.abs(fused.weights - w) > 1e-12).any(axis=0)
        _, gap = judged(criterion, information(P), fused.weights)
        assert (gap <= KEPT * (1.0 + 1e-6)).all(), SEED
        assert (gap[anew] <= 2.0 * NEARER).all(), SEED
        sought += int(anew.sum())
        w = fused.weights
    assert sought > 60, SEED


def test_what_are_no_weights_is_not_begun_with() -> None:
    A = information(wishart(np.random.default_rng(SEED), 3, 6))
    uniform = np.full((3, 6), 1.0 / 3.0)
    near = np.array([[np.nan, np.inf, -1.0, 0.0, 1e308, -0.5]] * 3)
    near[2, 2] = 5.0
    with np.errstate(all="ignore"):
        w = active.best_weights("det", Inflated(A, 1.0), uniform, near, NEARER)
    best = active.best_weights("det", Inflated(A, 1.0), uniform)
    np.testing.assert_array_equal(w[:, :5], best[:, :5])
    assert (judged("det", A, w)[1] <= 2.0 * NEARER).all()
