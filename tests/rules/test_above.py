"""The smallest matrix above several: whatever the units, beside the closed form for two, and an element on its own."""

from __future__ import annotations

import numpy as np
import pytest

from fusion_service.arrays import Floats
from fusion_service.rules import fuse
from fusion_service.rules.weights.above import GAP, smallest_above
from tests.helpers.strategies import sources

SEED = 1414


def batch(size: int, N: int, n: int, decades: float = 1.0) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(SEED)
    drawn = [sources(rng, N, n, decades) for _ in range(size)]
    return np.stack([x for x, _ in drawn]), np.stack([P for _, P in drawn])


@pytest.mark.parametrize("decades", [2.0, 6.0])
def test_the_least_det_does_not_depend_on_units_however_different_they_are(decades: float) -> None:
    x, P = batch(12, 3, 4)
    unit = 10.0 ** np.linspace(-decades / 2, decades / 2, 4)
    plain, scaled = fuse("cu", x, P), fuse("cu", x * unit, P * unit[:, None] * unit)
    np.testing.assert_allclose(scaled.covariance / unit[:, None] / unit, plain.covariance, rtol=1e-4, atol=1e-4)
    apart = np.linalg.slogdet(scaled.covariance / unit[:, None] / unit)[1] - np.linalg.slogdet(plain.covariance)[1]
    assert np.abs(apart).max() < 1e-8
    d = x - x.mean(axis=1, keepdims=True)
    for i in range(3):
        over = scaled.covariance / unit[:, None] / unit - P[:, i] - d[:, i, :, None] * d[:, i, None, :]
        assert np.linalg.eigvalsh(over).min() > -1e-9


@pytest.mark.parametrize("criterion", ["det", "trace"])
def test_beside_others_far_below_them_two_are_joined_as_by_the_closed_form(criterion: str) -> None:
    _, P = batch(10, 2, 3)
    x = np.zeros((10, 2, 3))
    small = np.concatenate([P, 1e-3 * P[:, :1], 1e-3 * P[:, 1:]], axis=1)
    two = fuse("cu", x, P, criterion=criterion).covariance
    four = fuse("cu", np.zeros((10, 4, 3)), small, criterion=criterion).covariance
    np.testing.assert_allclose(four, two, rtol=1e-4, atol=1e-4 * np.abs(two).max())


@pytest.mark.parametrize("criterion", ["det", "trace"])
def test_it_is_certified_and_above_all_and_no_element_looks_at_the_others(criterion: str) -> None:
    _, P = batch(9, 3, 4, decades=4.0)
    U = np.ascontiguousarray(P.transpose(2, 3, 1, 0))
    U[..., 4] = np.nan
    start = U.sum(axis=2)
    with np.errstate(all="ignore"):
        found, gap = smallest_above(criterion, start, U)
        alone = [smallest_above(criterion, start[..., i : i + 1], U[..., i : i + 1]) for i in range(9)]
    good = np.arange(9) != 4
    assert (gap[good] <= GAP).all()
    assert np.isinf(gap[4])
    for i in np.flatnonzero(good):
        assert alone[i][0].tobytes() == found[..., i : i + 1].tobytes()
        for k in range(3):
            scale = np.sqrt(found[..., i].diagonal())
            assert np.linalg.eigvalsh((found[..., i] - U[:, :, k, i]) / scale / scale[:, None]).min() > -1e-9
