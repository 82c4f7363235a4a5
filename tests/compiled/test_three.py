"""The kernel of three gives the bits of `rules.ci`: as it stands, and compiled where numba is installed."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from fusion_service.arrays import Floats
from fusion_service.compiled import three, use
from fusion_service.compiled.either import FAST
from fusion_service.compiled.small import functions
from fusion_service.rules import Fused, fuse_last

NAME = "from_start_of_three"


@pytest.fixture(autouse=True)
def plain() -> Iterator[None]:
    use("off")
    yield
    use("off")


def estimates(n: int, size: int, seed: int) -> tuple[Floats, Floats, Floats]:
    """Means and covariances, some alike, one not a number; weights to begin with: the best, some near them, some
    anything, and some that are none."""
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(3, n, n, size))
    if seed % 3 == 0:
        G[1] = 1.1 * G[0]
    if seed % 2 == 0:
        G[2] = G[1]
    P = np.einsum("nikb,njkb->nijb", G, G) + 1e-3 * np.eye(n)[:, :, None]
    P[0, :, :, 3] = np.nan
    x = rng.normal(size=(3, n, size))
    best = fuse_last("ci", x, P).weights
    start = rng.dirichlet(np.ones(3), size).T
    start[:, ::3], start[:, 1::3] = best[:, ::3], np.where(best > 0.0, best + 0.02, 0.0)[:, 1::3]
    start[:, 5], start[:, 7], start[:, 9] = np.nan, 0.0, (-1.0, 1.0, 1.0)
    return x, P, start


def same(one: Fused, other: Fused) -> bool:
    names = ("mean", "covariance", "weights", "influence")
    return all(np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True) for name in names)


def begun(x: Floats, P: Floats, start: Floats) -> Fused:
    return fuse_last("ci", x, P, influence=True, start=start)


@pytest.mark.parametrize("seed", range(4))
def test_the_kernel_of_three_gives_the_bits_of_the_rule(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    x, P, start = estimates(4, 20, seed)
    expected = begun(x, P, start)
    taken: list[Floats] = []

    def kernel(*arrays: Floats) -> None:
        with np.errstate(all="ignore"):
            three.from_start_of_three(*arrays)
        taken.append(arrays[-1])

    monkeypatch.setitem(FAST, NAME, functions(SimpleNamespace(from_start_of_three=kernel))[NAME])
    assert same(begun(x, P, start), expected)
    assert sum(int(found.sum()) for found in taken) >= 12
    assert (expected.weights != start).any(axis=0).sum() > 3


@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_so_does_the_compiled_one(n: int) -> None:
    pytest.importorskip("numba")
    x, P, start = estimates(n, 200, seed := 30 + n)
    expected = begun(x, P, start)
    assert use("on").startswith("numba ")
    assert same(begun(x, P, start), expected), seed
