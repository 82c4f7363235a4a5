"""`naive` at once, in the layout of the faces: the bits of the plain road, and its refusals."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from fusion_service.arrays import Floats
from fusion_service.compiled import products, use
from fusion_service.compiled.either import FAST
from fusion_service.compiled.kernels import LANES
from fusion_service.compiled.small import functions
from fusion_service.rules import RuleError, fuse
from tests.helpers.strategies import sources


@pytest.fixture(autouse=True)
def plain() -> Iterator[None]:
    use("off")
    yield
    use("off")


def by_hand() -> None:
    """The loop as it stands, alone."""
    FAST["product_of_all"] = functions(SimpleNamespace(product_of_all=products.product_of_all))["product_of_all"]


def batch(seed: int, N: int, n: int, size: int, decades: float = 2.0) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(seed)
    drawn = [sources(rng, N, n, decades) for _ in range(size)]
    return np.stack([x for x, _ in drawn]), np.stack([P for _, P in drawn])


@pytest.mark.parametrize(("N", "n", "size"), [(1, 2, 1), (2, 4, 3), (3, 1, 2), (5, 3, 2)])
def test_the_loop_gives_the_bits_of_numpy(N: int, n: int, size: int) -> None:
    x, P = batch(14, N, n, size)
    expected = fuse("naive", x, P)
    by_hand()
    with np.errstate(all="ignore"):
        assert (FAST["product_of_all"](x, P)[2] < 1e7).all()
        found = fuse("naive", x, P)
    assert found.mean.tobytes() == expected.mean.tobytes()
    assert found.covariance.tobytes() == expected.covariance.tobytes()
    assert np.isnan(found.weights).all()
    assert found.weights.shape == expected.weights.shape


def test_compiled_it_gives_them_too_whatever_the_batch() -> None:
    pytest.importorskip("numba")
    x, P = batch(15, 2, 4, 2 * LANES + 3)
    expected = fuse("naive", x, P)
    use("on")
    found = fuse("naive", x, P)
    assert found.mean.tobytes() == expected.mean.tobytes()
    assert found.covariance.tobytes() == expected.covariance.tobytes()
    part = fuse("naive", x[LANES - 1 : LANES + 2, ::1], P[LANES - 1 : LANES + 2])
    assert part.covariance.tobytes() == expected.covariance[LANES - 1 : LANES + 2].tobytes()
    turned = fuse("naive", x[:, ::-1], P[:, ::-1])
    use("off")
    assert turned.mean.tobytes() == fuse("naive", x[:, ::-1], P[:, ::-1]).mean.tobytes()


def test_what_is_hard_or_wrong_goes_the_ordinary_road() -> None:
    x, P = batch(16, 2, 3, 4)
    hard = P.copy()
    hard[1, 0] = np.array([[1.0, 1.0 - 1e-9, 0.0], [1.0 - 1e-9, 1.0, 0.0], [0.0, 0.0, 1.0]])
    skewed = P.copy()
    skewed[2, 1, 0, 1] *= 1.0 + 1e-14
    for one in (hard, skewed):
        expected = fuse("naive", x, one)
        by_hand()
        with np.errstate(all="ignore"):
            assert not (FAST["product_of_all"](x, one)[2] <= 1e7).all()
            assert fuse("naive", x, one).covariance.tobytes() == expected.covariance.tobytes()
        FAST.clear()
    wrong = P.copy()
    wrong[3, 1] = -wrong[3, 1]
    by_hand()
    with np.errstate(all="ignore"):
        with pytest.raises(RuleError, match=r"source 1 of batch element \(3,\) is not positive definite"):
            fuse("naive", x, wrong)
        x[0, 0, 0] = np.nan
        with pytest.raises(RuleError, match="not finite"):
            fuse("naive", x, P)
        empty = fuse("naive", x[:0], P[:0])
    assert empty.mean.shape == (0, 3)
