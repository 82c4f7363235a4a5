"""The kernel of groups gives the bits of `centre.consensus`: as it stands, and compiled where numba is installed."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from fusion_service.arrays import Floats
from fusion_service.centre.consensus import Consensus, consensus
from fusion_service.compiled import groups, use
from fusion_service.compiled.either import FAST
from fusion_service.compiled.small import functions


@pytest.fixture(autouse=True)
def plain() -> Iterator[None]:
    use("off")
    yield
    use("off")


def rows(size: int, seed: int) -> tuple[np.ndarray[tuple[int], np.dtype[np.uint64]], Floats, Floats]:
    """Labels of one to four rows, means and covariances, some of them nearly singular, one not a number."""
    rng = np.random.default_rng(seed)
    labels = rng.permutation(np.repeat(np.arange(size), 1 + np.arange(size) % 4)).astype(np.uint64)
    G = rng.normal(size=(3, 4, len(labels))) * np.array([100.0, 100.0, 1.0])[:, None, None]
    G[2, :, 1::7] = (1e-2 + 1e-7) * G[0, :, 1::7] * (1.0 + 1e-6 * rng.normal(size=(4, len(labels[1::7]))))
    P = np.einsum("ikb,jkb->ijb", G, G)
    P[:, :, 3] = np.nan
    return labels, rng.normal(size=(3, len(labels))) * 50.0, P


def same(one: Consensus, other: Consensus) -> bool:
    names = ("labels", "mean", "covariance", "others_mean", "others_covariance", "size")
    return all(np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True) for name in names[1:])


def test_the_kernel_of_groups_gives_the_bits_of_consensus(monkeypatch: pytest.MonkeyPatch) -> None:
    labels, x, P = rows(9, seed := 21)
    with np.errstate(all="ignore"):
        expected = consensus(labels, x, P)
        made = functions(SimpleNamespace(intersect=groups.intersect))["intersect"]
        monkeypatch.setitem(FAST, "intersect", made)
        assert same(consensus(labels, x, P), expected), seed
    assert (expected.size > 2).any()


def test_so_does_the_compiled_one() -> None:
    pytest.importorskip("numba")
    labels, x, P = rows(200, seed := 22)
    with np.errstate(all="ignore"):
        expected = consensus(labels, x, P)
        assert use("on").startswith("numba ")
        assert same(consensus(labels, x, P), expected), seed
