"""The kernels give the bits of `linalg`: as they stand, and compiled where numba is installed."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.compiled import kernels, use
from fusion_service.compiled.either import FAST
from fusion_service.compiled.small import functions

BY_HAND = functions(SimpleNamespace(**{name: getattr(kernels, name) for name in kernels.__all__}))


@pytest.fixture(autouse=True)
def plain() -> Iterator[None]:
    use("off")
    yield
    use("off")


def batch(n: int, size: int, seed: int) -> tuple[Floats, Floats, Floats]:
    """Covariances, vectors and matrices; the first three covariances are NaN, negative and zero."""
    rng = np.random.default_rng(seed)
    G, scale = rng.normal(size=(n, n + 1, size)), np.exp(rng.normal(0.0, 3.0, (n, 1, 1)))
    P = np.einsum("ikb,jkb->ijb", G * scale, G * scale)
    if size > 3:
        P[..., 0], P[..., 1], P[..., 2] = np.nan, -P[..., 1], 0.0
    return P, rng.normal(size=(n, size)), rng.normal(size=(n, n, size))


def cases(n: int, size: int, seed: int) -> list[tuple[str, tuple[Floats, ...]]]:
    P, x, Q = batch(n, size, seed)
    strided = np.ascontiguousarray(P.transpose(2, 0, 1)).transpose(1, 2, 0)
    one = np.eye(n)
    one[0, -1] = 0.1
    return [
        *((name, (P,)) for name in ("inverse", "sweep", "inverse_det", "ldl", "_pivots")),
        ("solve", (P, x)), ("quadratic", (P, x)), ("matvec", (Q, x)), ("product", (Q, P)), ("inner", (P, P + P)),
        ("congruence", (one, P)), ("congruence", (Q, P)), ("sweep", (strided,)),
    ]  # fmt: skip


def same(one: Any, other: Any) -> bool:
    pairs = zip(one, other, strict=True) if isinstance(one, tuple) else [(one, other)]
    return all(a.shape == b.shape and np.array_equal(a, b, equal_nan=True) for a, b in pairs)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("size", [1, 5, kernels.LANES + 3])
def test_a_kernel_gives_the_bits_of_linalg(n: int, size: int) -> None:
    with np.errstate(all="ignore"):
        for name, args in cases(n, size, seed := n * 1000 + size):
            found = BY_HAND[name](*args)
            assert found is not None, name
            assert same(found, getattr(linalg, name)(*args)), (name, seed)


def test_more_batch_axes_are_one() -> None:
    P, x, _ = batch(4, 12, 5)
    two = P.reshape(4, 4, 3, 4)
    with np.errstate(all="ignore"):
        assert same(BY_HAND["sweep"](two), linalg.sweep(two))
        assert same(BY_HAND["quadratic"](two, x.reshape(4, 3, 4)), linalg.quadratic(two, x.reshape(4, 3, 4)))


def test_what_is_not_for_a_kernel_is_left_to_linalg() -> None:
    P, x, Q = batch(3, 4, 6)
    wide: Any = P.astype(np.longdouble)
    assert BY_HAND["inverse"](wide) is None
    assert BY_HAND["inverse"](P[..., :0]) is None
    assert BY_HAND["solve"](P, x[:, :1]) is None
    assert BY_HAND["product"](P[:, :, None], Q[:, :, None].repeat(2, axis=2)) is None
    assert BY_HAND["matvec"](np.eye(3), x) is None


@pytest.mark.parametrize("n", [2, 4, 6])
def test_compiled_kernels_give_the_same_bits(n: int) -> None:
    pytest.importorskip("numba")
    for size in (1, 20, 1000):
        for name, args in cases(n, size, seed := n * 1000 + size):
            use("off")
            with np.errstate(all="ignore"):
                expected = getattr(linalg, name)(*args)
            assert use("on").startswith("numba ")
            assert name in FAST
            assert same(getattr(linalg, name)(*args), expected), (name, seed)


def test_compiled_kernels_do_not_look_at_their_neighbours() -> None:
    pytest.importorskip("numba")
    use("on")
    P, x, _ = batch(4, 200, 9)
    whole, square = linalg.sweep(P), linalg.quadratic(P, x)
    for i in range(0, 200, 37):
        some = slice(i, i + 3)
        assert same(linalg.sweep(P[..., some]), tuple(one[..., some] for one in whole))
        assert same(linalg.quadratic(P[..., some], x[..., some]), square[some])
