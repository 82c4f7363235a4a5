"""The face of the rules: shapes, refusals, independence of the batch, and hard numbers against rationals."""

import re
import warnings
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from fusion_service.arrays import Floats
from fusion_service.rules import RULES, RuleError, fuse, fuse_last
from tests.helpers.strategies import sources

SEED = 31
CASES: list[tuple[str, dict[str, Any]]] = [
    ("naive", {}),
    ("ci", {"criterion": "det"}),
    ("ci", {"criterion": "trace"}),
    ("ci", {"weights": "uniform"}),
    ("bci", {"max_correlation": 0.3}),
    ("bci", {"max_correlation": 0.3, "criterion": "trace"}),
    ("hmd-ga", {"criterion": "det"}),
    ("hmd-ga", {"criterion": "trace"}),
    ("hmd-ga", {"criterion": "kl"}),
    ("fast-ci", {}),
    ("ffcc", {"criterion": "trace"}),
    ("ici", {"criterion": "det"}),
    ("ici", {"criterion": "trace"}),
    ("ei", {}),
    ("aa", {}),
    ("aa", {"criterion": "diversity"}),
    ("aa", {"criterion": "bound"}),
    ("cu", {"criterion": "det"}),
    ("cu", {"criterion": "trace"}),
    ("cu", {"bound": "min"}),
]
IDS = [" ".join((rule, *map(str, options.values()))) for rule, options in CASES]
every_case = pytest.mark.parametrize(("rule", "options"), CASES, ids=IDS)


def batch(rng: np.random.Generator, size: int, N: int, n: int, decades: float = 2.0) -> tuple[Floats, Floats]:
    drawn = [sources(rng, N, n, decades) for _ in range(size)]
    return np.stack([x for x, _ in drawn]), np.stack([P for _, P in drawn])


@every_case
@pytest.mark.parametrize("shape", [(), (1,), (0,), (3, 2), (2, 0)])
@pytest.mark.parametrize(("N", "n"), [(1, 3), (2, 1), (2, 12), (3, 2), (20, 2)])
def test_any_shape(rule: str, options: dict[str, Any], shape: tuple[int, ...], N: int, n: int) -> None:
    if options.get("criterion") == "kl" and N > 3:
        pytest.skip("slow: differences over twenty weights")
    size = int(np.prod(shape))
    rng = np.random.default_rng(SEED)
    x, P = (a[:size].reshape(*shape, *a.shape[1:]) for a in batch(rng, max(size, 1), N, n))
    fused = fuse(rule, x, P, influence=True, **options)
    assert fused.mean.shape == (*shape, n)
    assert fused.covariance.shape == (*shape, n, n)
    assert fused.weights.shape == (*shape, N)
    assert fused.influence is not None
    assert fused.influence.shape == (*shape, N)
    np.testing.assert_allclose(fused.influence.sum(axis=-1), np.ones(shape), atol=1e-9)
    np.testing.assert_array_equal(fused.covariance, fused.covariance.swapaxes(-1, -2))
    assert (np.linalg.eigvalsh(fused.covariance) > 0.0).all()
    assert fuse(rule, x, P, **options).influence is None


@every_case
@pytest.mark.parametrize(("N", "n"), [(2, 1), (2, 4), (2, 8), (3, 4)])
def test_bits_do_not_depend_on_the_batch(rule: str, options: dict[str, Any], N: int, n: int) -> None:
    """One element of some is hard enough for the slow road, one is not definite."""
    size = 260 if (N, n) == (2, 4) else 24
    rng = np.random.default_rng(SEED)
    x, P = batch(rng, size, N, n, decades=3.0)
    if n > 1:
        direction = np.ones(n)
        P[7] = 1e9 * np.outer(direction, direction) + np.eye(n)
    xs, Ps = x.transpose(1, 2, 0), P.transpose(1, 2, 3, 0)
    Ps = Ps.copy()
    Ps[0, :, :, 5] *= -1.0
    given = None
    if options.get("weights") == "uniform":
        given = np.full((N, size), 1.0 / N)
    rest = {k: v for k, v in options.items() if k != "weights"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole = fuse_last(rule, xs, Ps, given, influence=True, **rest)
    assert np.isnan(whole.covariance[:, :, 5]).all()
    assert np.isfinite(np.delete(whole.covariance, 5, axis=2)).all()
    for part in (slice(0, 1), slice(4, 8), slice(7, 8), slice(11, 21), slice(size - 3, size)):
        w = None if given is None else given[:, part]
        alone = fuse_last(rule, xs[..., part].copy(), Ps[..., part].copy(), w, influence=True, **rest)
        for name in ("mean", "covariance", "weights", "influence"):
            np.testing.assert_array_equal(getattr(alone, name), getattr(whole, name)[..., part], err_msg=name)
    keep = np.arange(size) != 5
    public = fuse(rule, x[keep], P[keep], **options)
    np.testing.assert_array_equal(public.mean, whole.mean[:, keep].T)
    np.testing.assert_array_equal(public.covariance, whole.covariance[..., keep].transpose(2, 0, 1))


def test_neither_input_nor_given_weights_are_changed() -> None:
    x, P = batch(np.random.default_rng(SEED), 3, 2, 2)
    w = np.full((3, 2), 0.5)
    before = x.copy(), P.copy(), w.copy()
    for rule, options in CASES:
        fuse(rule, x, P, **({"weights": w} | options) if RULES[rule].takes_weights else {})
    hard = P.copy()
    hard[0] *= -1
    last = np.ascontiguousarray(hard.transpose(1, 2, 3, 0))
    fuse_last("ci", x.transpose(1, 2, 0), last, w.T)
    for a, b in zip((x, P, w), before, strict=True):
        np.testing.assert_array_equal(a, b)


LOPSIDED = np.zeros((2, 2, 3, 3))
LOPSIDED[0, 1, 0, 1] = 0.5
X, P2 = np.zeros((5, 2, 3)), np.broadcast_to(np.eye(3), (5, 2, 3, 3))


def spoiled(index: tuple[int, ...], value: float, a: Floats) -> Floats:
    out = np.array(a)
    out[index] = value
    return out


@pytest.mark.parametrize(
    ("rule", "x", "P", "options", "message"),
    [
        ("sum", X, P2, {}, "unknown rule 'sum': one of naive, ci"),
        ("naive", X, P2, {"criterion": "det"}, "'naive' has no option 'criterion': it has none"),
        ("ci", X, P2, {"rho": 1}, "'ci' has no option 'rho': it has criterion"),
        ("ci", X, P2, {"criterion": "size"}, "criterion 'size': one of det, trace"),
        ("ci", X, P2[..., :2], {}, "do not fit"),
        ("ci", X[0, 0], P2[0, 0], {}, "do not fit"),
        ("ci", X[:4], P2, {}, "do not fit"),
        ("ci", X[:, :0], P2[:, :0], {}, "at least one source"),
        ("ci", "x", P2, {}, "means are not an array of numbers"),
        ("ci", spoiled((3, 1, 2), np.nan, X), P2, {}, "mean of source 1 of batch element (3,) is not finite"),
        ("ci", X, spoiled((2, 0, 1, 1), np.nan, P2), {}, "covariance of source 0 of batch element (2,) is not finite"),
        ("naive", X, spoiled((4, 1, 0, 0), np.inf, P2), {}, "covariance of source 1 of batch element (4,)"),
        ("ci", X[0], spoiled((1, 0, 0), -1, P2[0]), {}, "covariance of source 1 is not positive definite"),
        ("hmd-ga", X, spoiled((0, 0, 0, 0), 0.0, P2), {}, "batch element (0,) is not positive definite"),
        ("ci", X, spoiled((1, 0, 0, 1), 0.5, P2), {}, "source 0 of batch element (1,) is not symmetric"),
        ("naive", X, P2, {"weights": "uniform"}, "rule 'naive' takes no weights"),
        ("ci", X, P2, {"weights": "equal"}, "weights 'equal'"),
        ("ci", X, P2, {"weights": [1.0, 0.0, 0.0]}, "do not fit"),
        ("ci", X, P2, {"weights": [0.5, 0.4]}, "sum 1"),
        ("ci", X, P2, {"weights": [1.5, -0.5]}, "non-negative"),
        ("ci", X, P2, {"weights": [np.nan, 1.0]}, "non-negative"),
        ("bci", X, P2, {"max_correlation": 1.1}, "between 0 and 1"),
        ("bci", X, P2, {"max_correlation": np.nan}, "between 0 and 1"),
        ("bci", X, P2, {"max_correlation": np.eye(3)}, "a number or (2, 2)"),
        ("bci", X, P2, {"max_correlation": np.ones((4, 2, 2))}, "one (2, 2) for each of"),
        ("bci", X, P2, {"max_correlation": np.full((1, 2, 2), 0.5)}, "ones on its diagonal"),
        ("bci", X, P2, {"max_correlation": [[1, 0.2], [0.3, 1]]}, "symmetric"),
        ("bci", X, P2, {"max_correlation": [[0.5, 0.2], [0.2, 1]]}, "ones on its diagonal"),
        ("ci", X, P2, {"scales": [1.0, 2.0]}, "3 positive numbers"),
        ("ici", X, P2, {"scales": [1.0, 2.0, 0.0]}, "3 positive numbers"),
        ("ici", X, P2, {"criterion": "kl"}, "criterion 'kl': one of det, trace"),
        ("aa", X, P2, {"criterion": "det"}, "criterion 'det': one of uniform, diversity, bound"),
        ("ei", X, P2, {"weights": "uniform"}, "rule 'ei' takes no weights"),
        ("ffcc", X, P2, {"delta": 0.0}, "above 0 and at most 1"),
        ("ffcc", X, P2, {"delta": [0.5, 0.5]}, "one number is needed"),
        ("cu", X, P2, {"bound": "most"}, "one of max, min"),
        ("hmd-s", X, P2, {"alpha": 0.5}, "at least 1"),
        ("hmd-s", X, P2, {"samples": 10}, "at least 200"),
        ("gmd-s", X, P2, {"seed": 1.5}, "whole number"),
        ("bar-shalom-campo", X, P2, {}, "needs the option cross_covariance"),
        ("bar-shalom-campo", X[:, [0, 1, 1]], P2[:, [0, 1, 1]], {"cross_covariance": np.eye(3)}, "does not fit"),
        ("bar-shalom-campo", X, P2, {"cross_covariance": LOPSIDED}, "each other's transpose"),
        ("bar-shalom-campo", X, P2, {"cross_covariance": np.eye(2)}, "cross_covariance (2, 2) does not fit"),
        ("bar-shalom-campo", X, P2, {"cross_covariance": np.full((3, 3), np.nan)}, "cross_covariance is not finite"),
        ("bar-shalom-campo", X, P2, {"cross_covariance": 1.1 * np.eye(3)}, "joint covariance is not positive definite"),
        ("hmd-s", X + 30 * np.array([[0.0], [1.0]]), P2, {}, "too far apart"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(
    rule: str, x: Any, P: Floats, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(RuleError, match=re.escape(message)) as caught:
        fuse(rule, x, P, **options)
    assert "\n" not in str(caught.value)


def test_registry() -> None:
    names = "naive ci bci fast-ci ffcc bar-shalom-campo ici ei hmd-ga hmd-s gmd-s aa cu"
    assert list(RULES) == names.split()
    x, P = sources(np.random.default_rng(SEED), 2, 2)
    for name, rule in RULES.items():
        assert rule.name == name
        if name == "bar-shalom-campo":  # one of its options has no default
            continue
        np.testing.assert_array_equal(fuse(name, x, P, **rule.options).covariance, fuse(name, x, P).covariance)


# ------------------------------------------------------------------ hard numbers, in rational arithmetic

Rational = list[list[Fraction]]


def rational(A: Floats) -> Rational:
    return [[Fraction(float(v)) for v in row] for row in A]


def invert(A: Rational) -> Rational:
    n = len(A)
    M = [row[:] + [Fraction(int(i == j)) for j in range(n)] for i, row in enumerate(A)]
    for k in range(n):
        pivot = M[k][k]
        M[k] = [v / pivot for v in M[k]]
        for i in range(n):
            if i != k and M[i][k]:
                f = M[i][k]
                M[i] = [a - f * b for a, b in zip(M[i], M[k], strict=True)]
    return [row[n:] for row in M]


def combine(weights: list[Fraction], terms: list[Rational]) -> Rational:
    out = [[Fraction(0)] * len(terms[0]) for _ in terms[0]]
    for w, term in zip(weights, terms, strict=True):
        out = [[a + w * b for a, b in zip(*rows, strict=True)] for rows in zip(out, term, strict=True)]
    return out


def exact(rule: str, x: Floats, P: Floats, w: Floats) -> Floats:
    """The fused covariance of two sources at these weights, exact up to the last conversion."""
    w1, w2 = (Fraction(float(v)) for v in (w if rule != "naive" else (1, 1)))
    Ps = [rational(p) for p in P]
    A = [invert(p) for p in Ps]
    if rule == "hmd-ga":
        d = [Fraction(float(a)) - Fraction(float(b)) for a, b in zip(x[0], x[1], strict=True)]
        spread = [[a * b for b in d] for a in d]
        V = invert(combine([w2, w1, w1 * w2], [*Ps, spread]))
        M = combine([Fraction(1), Fraction(1), Fraction(-1)], [*A, V])
    elif rule == "ici":
        M = combine([Fraction(1), Fraction(1), Fraction(-1)], [*A, invert(combine([w1, w2], Ps))])
    else:
        M = combine([w1, w2], A)
    return np.array([[float(v) for v in row] for row in invert(M)])


def hard_covariance(rng: np.random.Generator, n: int, condition: float, scales: float) -> Floats:
    q, _ = np.linalg.qr(rng.normal(size=(n, n)))
    P = (q * np.geomspace(1.0, condition, n)) @ q.T
    s = 10.0 ** rng.uniform(-scales / 2, scales / 2, size=n)
    return np.asarray(0.5 * (P + P.T) * s[:, None] * s[None, :])


@pytest.mark.parametrize("rule", ["naive", "ci", "hmd-ga", "ici", "fast-ci"])
@pytest.mark.parametrize("criterion", ["det", "trace"])
def test_hard_input_is_right_or_refused(rule: str, criterion: str) -> None:
    rng = np.random.default_rng(SEED)
    done = {True: 0, False: 0}
    for condition in (1e3, 1e6, 1e9, 1e12, 1e15):
        for scales, size in ((0.0, 0.0), (12.0, 0.0), (0.0, 12.0), (3.0, 6.0)):
            for _ in range(3):
                n = 3
                shared = 10.0 ** rng.uniform(-scales / 2, scales / 2, size=n)
                P = np.stack([hard_covariance(rng, n, condition, 0.0) * np.outer(shared, shared) for _ in range(2)])
                P[1] *= 10.0 ** rng.uniform(-size, size)
                x = rng.normal(size=(2, n)) * np.sqrt(P[0].diagonal())
                options: dict[str, Any] = {} if rule == "naive" else {"criterion": criterion}
                try:
                    fused = fuse(rule, x, P, **options)
                except RuleError:
                    done[False] += 1
                    # nearly singular, or a spread of means far beyond both covariances
                    assert condition >= 1e12 or rule == "hmd-ga"
                    continue
                done[True] += 1
                want = exact(rule, x, P, fused.weights)
                scale = np.sqrt(want.diagonal())
                error = np.abs(fused.covariance - want) / np.outer(scale, scale)
                assert error.max() <= 1e-6, (condition, scales, size)
    assert done[True] >= 40


@pytest.mark.parametrize(("N", "n"), [(2, 1), (3, 1), (6, 2), (3, 4), (2, 7)])
def test_variances_decades_apart_are_no_reason_to_refuse(N: int, n: int) -> None:
    """Here the weights have optima at 1e-3 and 1e-8: they are found, and no worse than many others."""
    rng = np.random.default_rng(SEED)
    x, P = batch(rng, 10, N, n, decades=8.0)
    A = np.linalg.inv(P)
    for rho in (1.0, 0.3, 1e-6):
        fused = fuse("bci", x, P, max_correlation=rho, criterion="trace")
        best = np.trace(fused.covariance, axis1=1, axis2=2)
        near = fused.weights * np.exp(rng.normal(size=(100, 1, N)) * 0.1)
        far = np.broadcast_to(rng.dirichlet(np.full(N, 0.3), size=(100, 1)), near.shape)
        for w in (*(near / near.sum(axis=-1, keepdims=True)), *far):
            M = np.einsum("bi,bijk->bjk", w / ((1 - rho) * w + rho), A)
            assert (best <= np.trace(np.linalg.inv(M), axis1=1, axis2=2) * (1 + 1e-6)).all()


def test_means_far_from_the_origin_cost_nothing() -> None:
    """Earth-centred coordinates: six million metres, centimetres of difference."""
    x, P = sources(np.random.default_rng(SEED), 2, 3, 1.0)
    for rule, options in CASES:
        near, far = fuse(rule, x, P, **options), fuse(rule, x + 6e6, P, **options)
        np.testing.assert_allclose(far.mean - 6e6, near.mean, atol=2e-8)
        np.testing.assert_allclose(far.covariance, near.covariance, rtol=1e-6)
