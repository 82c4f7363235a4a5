"""The kernels of merging give the bits of `densities.reduction`: as they stand, and compiled."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from fusion_service.compiled import merging, use
from fusion_service.compiled.either import FAST
from fusion_service.compiled.small import functions
from fusion_service.densities import Mixtures, reduce_mixtures


@pytest.fixture(autouse=True)
def plain() -> Iterator[None]:
    use("off")
    yield
    use("off")


def mixtures(components: int, size: int, n: int, seed: int) -> Mixtures:
    """Unequal ones, some of fewer components, two that are alike, one with a covariance that is none."""
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(n, n + 1, components, size))
    P = np.einsum("ikcb,jkcb->ijcb", G, G)
    logs = rng.normal(size=(components, size)) * 2.0
    logs[rng.random(logs.shape) < 0.2] = -np.inf
    logs[0] = 0.0
    means = rng.normal(size=(n, components, size)) * 3.0
    logs[:3, 0], means[:, 1, 0], P[:, :, 1, 0] = 0.0, means[:, 2, 0], P[:, :, 2, 0]
    P[0, 0, 1, -1] = -1.0
    return Mixtures(logs, means, P)


def same(one: Mixtures, other: Mixtures) -> bool:
    names = ("log_weights", "means", "covariances")
    return all(np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True) for name in names)


@pytest.mark.parametrize("method", ["runnalls", "salmond"])
def test_kernels_as_they_stand_give_the_same_bits(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    of = mixtures(7, 5, 2, seed := 31)
    expected = reduce_mixtures(of, max_components=3, method=method)
    made = functions(SimpleNamespace(merged_pivots=merging.merged_pivots, settled=merging.settled))
    for name in ("merged_logdet", "settled"):
        monkeypatch.setitem(FAST, name, made[name])
    with np.errstate(all="ignore"):
        assert same(reduce_mixtures(of, max_components=3, method=method), expected), seed
    assert expected.covariances.shape == (2, 2, 3, 5)


@pytest.mark.parametrize(("components", "size", "n"), [(24, 130, 4), (2, 1, 1), (9, 40, 6)])
def test_so_do_the_compiled_ones(components: int, size: int, n: int) -> None:
    pytest.importorskip("numba")
    of = mixtures(components, size, n, seed := 32) if size > 1 else mixtures(4, 2, n, 33)
    expected = reduce_mixtures(of, max_components=2)
    assert use("on").startswith("numba ")
    assert same(reduce_mixtures(of, max_components=2), expected), seed
    assert expected.covariances.shape[2] == 2
