"""What the rows of a global track say together, and each of them without itself, against a dense computation."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion_service.centre.consensus import consensus
from fusion_service.centre.gating import _without
from fusion_service.centre.rows import Rows
from fusion_service.centre.tracks import empty_tracks
from tests.helpers.strategies import Array, sources


def world(seed: int, rows: int = 40, groups: int = 9) -> tuple[NDArray[np.uint64], Array, Array]:
    rng = np.random.default_rng(seed)
    labels = rng.integers(1, groups + 1, rows).astype(np.uint64) << np.uint64(40)
    means, covariances = sources(rng, rows, 4)
    return labels, np.ascontiguousarray(means.T), np.ascontiguousarray(np.moveaxis(covariances, 0, 2))


def uniform(means: Array, covariances: Array) -> tuple[Array, Array]:
    """Covariance intersection with equal weights, by NumPy's inverse."""
    information = np.linalg.inv(covariances)
    P = np.linalg.inv(information.mean(axis=0))
    return P @ np.einsum("kij,kj->i", information, means) / len(means), P


@pytest.mark.parametrize("seed", range(5))
def test_it_is_the_intersection_of_all_and_of_all_but_each(seed: int) -> None:
    labels, means, covariances = world(seed)
    made = consensus(labels, means, covariances)
    for column, label in enumerate(made.labels):
        rows = np.flatnonzero(labels == label)
        mean, covariance = uniform(means.T[rows], np.moveaxis(covariances, 2, 0)[rows])
        np.testing.assert_allclose(made.mean[:, column], mean, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(made.covariance[:, :, column], covariance, rtol=1e-7, atol=1e-9)
        assert (made.size[rows] == len(rows)).all()
        for row in rows:
            others = rows[rows != row]
            if not len(others):
                assert np.isnan(made.others_mean[:, row]).all()
                continue
            mean, covariance = uniform(means.T[others], np.moveaxis(covariances, 2, 0)[others])
            np.testing.assert_allclose(made.others_mean[:, row], mean, rtol=1e-7, atol=1e-9)
            np.testing.assert_allclose(made.others_covariance[:, :, row], covariance, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_what_is_left_when_rows_leave_has_the_bits_of_a_fresh_one(seed: int) -> None:
    labels, means, covariances = world(seed)
    count = len(labels)
    some = np.zeros(count, dtype=np.bool_)
    table = dataclasses.replace(
        empty_tracks(4), id=np.arange(count, dtype=np.uint64), link=labels, mean=means, covariance=covariances
    )
    rows = Rows(
        np.zeros(count, dtype=np.intp), labels, table, some, np.zeros(count, dtype=np.int64), lost=some,
        gate=np.ones(count), fresh=some, kept={},
    )  # fmt: skip
    had = np.flatnonzero(np.random.default_rng(seed).random(count) < 0.9)
    inside = had[np.random.default_rng(seed + 100).random(len(had)) < 0.8]
    whole = consensus(labels[had], means[:, had], covariances[:, :, had])
    left = _without(whole, rows, had, inside)
    fresh = consensus(labels[inside], means[:, inside], covariances[:, :, inside])
    for one in (one for one in dataclasses.fields(fresh) if one.name != "groups"):
        np.testing.assert_array_equal(getattr(left, one.name), getattr(fresh, one.name))


def test_no_rows() -> None:
    made = consensus(np.zeros(0, dtype=np.uint64), np.zeros((4, 0)), np.zeros((4, 4, 0)))
    assert made.mean.shape == (4, 0)
    assert made.others_covariance.shape == (4, 4, 0)
