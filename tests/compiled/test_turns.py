"""Jacobi's rotations: the loop gives the bits of NumPy, as it stands and compiled, and of each matrix alone."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from fusion_service.arrays import Floats
from fusion_service.compiled import turns, use
from fusion_service.compiled.either import FAST
from fusion_service.compiled.kernels import LANES
from fusion_service.compiled.small import functions
from fusion_service.rules.weights.pencil import eigen
from tests.compiled.test_kernels import same


@pytest.fixture(autouse=True)
def plain() -> Iterator[None]:
    use("off")
    yield
    use("off")


def batch(n: int, size: int) -> Floats:
    """Symmetric matrices of many scales; some diagonal, of equal eigenvalues, zero, indefinite, NaN."""
    rng = np.random.default_rng(1000 * n + size)
    G = rng.normal(size=(n, n, size)) * 10.0 ** rng.uniform(-4, 4, (n, 1, size))
    A: Floats = np.einsum("ikb,jkb->ijb", G, G)
    for place, one in enumerate((np.eye(n), np.zeros((n, n)), np.diag(-np.arange(n) - 0.0), np.full((n, n), np.nan))):
        if size > place + 4:
            A[..., place + 2] = one
    return A


def by_hand(A: Floats) -> tuple[Floats, Floats]:
    """By the loop as it stands."""
    FAST["jacobi"] = functions(SimpleNamespace(jacobi=turns.jacobi))["jacobi"]
    try:
        return eigen(A)
    finally:
        FAST.clear()


@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_loop_gives_the_bits_of_numpy(n: int) -> None:
    with np.errstate(all="ignore"):
        for size in (1, 9):
            A = batch(n, size)
            values, vectors = eigen(A)
            assert same(by_hand(A), (values, vectors))
            assert (np.signbit(by_hand(A)[1]) == np.signbit(vectors))[..., np.isfinite(values[0])].all()
            good = np.isfinite(values).all(axis=0)
            again = np.einsum("ikb,kb,jkb->ijb", vectors, values, vectors)[..., good]
            np.testing.assert_allclose(
                again, A[..., good], rtol=1e-9, atol=1e-9 * np.abs(A[..., good]).max(initial=1.0)
            )


def test_compiled_it_gives_them_too_and_none_looks_at_its_neighbours() -> None:
    pytest.importorskip("numba")
    for n in (2, 4, 6):
        A = batch(n, LANES + 9)
        with np.errstate(all="ignore"):
            use("off")
            expected = eigen(A)
            alone = [eigen(A[..., i : i + 1]) for i in range(9)]
            use("on")
            found = eigen(A)
            assert same(found, expected)
            for i in (*range(9), LANES + 1):
                assert same(eigen(A[..., i : i + 1]), tuple(one[..., i : i + 1] for one in found))
        for i, (values, vectors) in enumerate(alone):
            assert values.tobytes() == expected[0][:, i : i + 1].tobytes() or not np.isfinite(values).all()
            assert vectors.tobytes() == expected[1][..., i : i + 1].tobytes() or not np.isfinite(values).all()
