"""Against numpy.linalg, one matrix at a time, and bit-for-bit independence of the batch."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Floats

SEED = 20240611


def spd(rng: np.random.Generator, n: int, size: int) -> Floats:
    """(size, n, n), eigenvalues spread over a few decades."""
    q, _ = np.linalg.qr(rng.normal(size=(size, n, n)))
    p = (q * 10.0 ** rng.uniform(-2, 2, size=(size, 1, n))) @ q.swapaxes(1, 2)
    return np.asarray(0.5 * (p + p.swapaxes(1, 2)))


@pytest.fixture(params=[1, 2, 3, 4, 6, 12])
def case(request: pytest.FixtureRequest) -> tuple[int, Floats, Floats]:
    n = request.param
    rng = np.random.default_rng(SEED + n)
    return n, spd(rng, n, 40), rng.normal(size=(40, n))


def test_layout_there_and_back() -> None:
    a = np.arange(2 * 3 * 4 * 5, dtype=float).reshape(2, 3, 4, 5)
    last = linalg.to_last(a, 2)
    assert last.shape == (4, 5, 6)
    assert last.flags.c_contiguous
    assert last[1, 2, 4] == a[1, 1, 1, 2]
    np.testing.assert_array_equal(linalg.to_first(last, (2, 3), 2), a)
    assert linalg.to_last(np.ones(3), 1).shape == (3, 1)
    assert linalg.to_first(np.ones((3, 1)), (), 1).shape == (3,)
    assert linalg.to_first(linalg.to_last(np.ones((0, 7, 3, 3)), 2), (0, 7), 2).shape == (0, 7, 3, 3)


def test_blocks_cover_the_batch_once() -> None:
    for n, size in ((1, 0), (4, 1), (4, 10_001), (12, 700)):
        seen = np.concatenate([np.arange(size)[part] for part in linalg.blocks(n, size)] or [np.arange(0)])
        np.testing.assert_array_equal(seen, np.arange(size))


def test_against_numpy(case: tuple[int, Floats, Floats]) -> None:
    _, P, x = case
    p, v = linalg.to_last(P, 2), linalg.to_last(x, 1)
    close: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-10}
    want = np.linalg.inv(P)
    inverse, det, _ = linalg.sweep(p)
    np.testing.assert_allclose(linalg.trace_inverse_det(p)[0], np.trace(want, axis1=1, axis2=2), rtol=1e-10)
    np.testing.assert_allclose(linalg.trace_inverse_det(p)[1], np.linalg.det(P), rtol=1e-10)
    np.testing.assert_allclose(linalg.trace(p), np.trace(P, axis1=1, axis2=2), rtol=1e-12)
    np.testing.assert_allclose(linalg.inner(p, inverse), np.full(40, len(p)), rtol=1e-10)
    np.testing.assert_allclose(linalg.product(p, inverse).transpose(2, 0, 1), P @ want, **close)
    np.testing.assert_allclose(linalg.to_first(inverse, (40,), 2), want, **close)
    np.testing.assert_array_equal(inverse, inverse.swapaxes(0, 1))
    np.testing.assert_array_equal(linalg.inverse(p), inverse)
    again, _, least = linalg.inverse_det(p)
    np.testing.assert_array_equal(again, inverse)
    np.testing.assert_allclose(least, [1 / (np.diag(np.linalg.cholesky(M)) ** 2).max() for M in P], rtol=1e-10)
    np.testing.assert_allclose(det, np.linalg.det(P), rtol=1e-10)
    np.testing.assert_allclose(linalg.det(p), np.linalg.det(P), rtol=1e-10)
    np.testing.assert_allclose(linalg.logdet(p), np.linalg.slogdet(P)[1], **close)
    np.testing.assert_allclose(linalg.solve(p, v).T, np.linalg.solve(P, x[..., None])[..., 0], **close)
    np.testing.assert_allclose(linalg.quadratic(p, v), np.einsum("bi,bij,bj->b", x, want, x), rtol=1e-10)
    L, d = linalg.ldl(p)
    L, d = linalg.to_first(L, (40,), 2), d.T
    np.testing.assert_allclose(L * d[:, None, :] @ L.swapaxes(1, 2), P, **close)
    np.testing.assert_array_equal(np.triu(L, 1), np.zeros_like(L))
    np.testing.assert_array_equal(linalg.symmetrise(p), p)


@pytest.mark.parametrize("m", [1, 3, 5])
def test_products_with_one_matrix_or_many(case: tuple[int, Floats, Floats], m: int) -> None:
    n, P, x = case
    rng = np.random.default_rng(SEED)
    p, v = linalg.to_last(P, 2), linalg.to_last(x, 1)
    one = rng.normal(size=(m, n)) * (rng.uniform(size=(m, n)) < 0.6)
    many = rng.normal(size=(40, m, n))
    for F, f in ((one, one), (many, linalg.to_last(many, 2))):
        got = linalg.congruence(f, p)
        np.testing.assert_allclose(got.transpose(2, 0, 1), F @ P @ F.swapaxes(-1, -2), rtol=1e-10, atol=1e-10)
        np.testing.assert_array_equal(got, got.swapaxes(0, 1))
        np.testing.assert_allclose(linalg.matvec(f, v).T, (F @ x[..., None])[..., 0], rtol=1e-12, atol=1e-12)


OPERATIONS: dict[str, Callable[[Floats, Floats], NDArray[Any]]] = {
    "inverse": lambda p, v: linalg.inverse(p),
    "ldl": lambda p, v: linalg.ldl(p)[0],
    "det": lambda p, v: linalg.det(p),
    "logdet": lambda p, v: linalg.logdet(p),
    "solve": linalg.solve,
    "quadratic": linalg.quadratic,
    "congruence": lambda p, v: linalg.congruence(p[:2], p),
    "shared": lambda p, v: linalg.congruence(np.tri(len(p)), p),
    "matvec": linalg.matvec,
    "trace": lambda p, v: linalg.trace_inverse_det(p)[0],
    "definite": lambda p, v: linalg.is_positive_definite(p),
}


@pytest.mark.parametrize("name", OPERATIONS)
@pytest.mark.parametrize("n", [1, 4, 12])
def test_an_elements_bits_do_not_depend_on_the_batch(name: str, n: int) -> None:
    rng = np.random.default_rng(SEED)
    p, v = linalg.to_last(spd(rng, n, 2500), 2), rng.normal(size=(n, 2500))
    operation = OPERATIONS[name]
    whole = operation(p, v)
    for size in (1, 2, 3, 7, 16, 33, 1000):
        np.testing.assert_array_equal(operation(p[..., :size], v[..., :size]), whole[..., :size])
        part = np.ascontiguousarray(p[..., 2500 - size :]), np.ascontiguousarray(v[..., 2500 - size :])
        np.testing.assert_array_equal(operation(*part), whole[..., 2500 - size :])


BAD = [np.nan, np.inf, -np.inf, 0.0, -1.0, 1e308]


@pytest.mark.parametrize("name", OPERATIONS)
@pytest.mark.parametrize("value", BAD)
def test_a_bad_matrix_spoils_only_itself(name: str, value: float) -> None:
    rng = np.random.default_rng(SEED)
    p, v = linalg.to_last(spd(rng, 4, 9), 2), rng.normal(size=(4, 9))
    operation = OPERATIONS[name]
    whole = operation(p, v)
    p[:, :, 4] = value
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        spoilt = operation(p, v)
    keep = np.arange(9) != 4
    np.testing.assert_array_equal(spoilt[..., keep], whole[..., keep])


def test_positive_definite_means_numerically_so() -> None:
    def ask(P: Floats) -> bool:
        p = np.asarray(P, dtype=float)[..., None]
        answer = bool(linalg.is_positive_definite(p)[0])
        assert answer == (linalg.sweep(p)[2][0] > 1e-14)
        return answer

    assert ask(np.eye(3))
    assert ask(np.diag([1e-150, 1.0, 1e150]))  # units do not matter
    assert ask(np.array([[1.0, 1 - 1e-13], [1 - 1e-13, 1.0]]))
    assert not ask(np.ones((2, 2)))
    assert not ask(np.diag([1.0, -1.0]))
    assert not ask(np.diag([1.0, 0.0]))
    assert not ask(np.zeros((2, 2)))
    assert not ask(np.array([[1.0, 2.0], [2.0, 1.0]]))
    for value in BAD[:3]:
        for at in ((0, 0), (1, 1), (1, 0)):
            P = np.eye(3)
            P[at] = P[at[::-1]] = value
            assert not ask(P), (value, at)


def test_scales_twelve_decades_apart_cost_no_accuracy() -> None:
    rng = np.random.default_rng(SEED)
    P = spd(rng, 4, 30)
    scale = 10.0 ** rng.uniform(-6, 6, size=(30, 4))
    got = linalg.inverse(linalg.to_last(P * scale[:, :, None] * scale[:, None, :], 2)).transpose(2, 0, 1)
    want = np.linalg.inv(P)
    error = np.abs(got * scale[:, :, None] * scale[:, None, :] - want) / np.abs(want).max(axis=(1, 2))[:, None, None]
    assert error.max() < 1e-10


def test_longdouble_stays_longdouble() -> None:
    P = np.eye(3, dtype=np.longdouble)[..., None] * np.longdouble(3)
    assert linalg.inverse(P).dtype == np.longdouble  # type: ignore[arg-type]
    assert abs(linalg.inverse(P)[0, 0, 0] * 3 - 1) <= np.finfo(np.longdouble).eps  # type: ignore[arg-type]
