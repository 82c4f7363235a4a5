"""What the centre puts in the place of a covariance union that rounding does not let be found."""

from __future__ import annotations

import numpy as np
import pytest

from fusion_service import linalg
from fusion_service.centre import FusionCentre
from fusion_service.centre.bounding import union_bound
from tests.centre.worlds import SECOND, START, centre, give, step, tracks


def drawn(N: int, B: int, decades: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(N, B, 4, 4)))[0]
    sizes = 10.0 ** rng.uniform(-decades / 2, decades / 2, size=(N, B, 4))
    P = np.einsum("...ij,...j,...kj->...ik", turn, sizes, turn)
    return rng.normal(size=(N, 4, B)) * 30.0, np.moveaxis((P + P.swapaxes(-1, -2)) / 2, 1, -1)


@pytest.mark.parametrize("decades", [2.0, 8.0, 16.0])
@pytest.mark.parametrize("N", [1, 2, 5])
def test_the_bound_is_above_every_source_about_the_mean(N: int, decades: float) -> None:
    means, covariances = drawn(N, 50, decades, seed=3)
    x, P = union_bound(means, covariances)
    assert linalg.is_positive_definite(P).all()
    for one, covariance in zip(means, covariances, strict=True):
        d = x - one
        left = np.moveaxis(P - covariance - d[:, None] * d[None], -1, 0)
        scale = np.abs(np.moveaxis(P, -1, 0)).max(axis=(1, 2))
        assert (np.linalg.eigvalsh(left)[:, 0] >= -1e-12 * scale).all()


def test_an_empty_batch_is_empty() -> None:
    x, P = union_bound(np.zeros((2, 4, 0)), np.zeros((2, 4, 4, 0)))
    assert x.shape == (4, 0)
    assert P.shape == (4, 4, 0)


def test_the_centre_says_so_and_covers_all() -> None:
    made: FusionCentre = centre(("r1", "r2"), rule="cu")
    long, short = np.array([1.0, 1.0, 1e-6, 1e-6]), np.array([1e-6, 1e-6, 1.0, 1.0])
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(4, 4)))[0]
    told = []
    for second in range(1, 5):
        for name, size in (("r1", long), ("r2", short)):
            P = turn @ np.diag((1e4 * size) ** 2) @ turn.T
            give(made, tracks(name, second, [[0, 0, 0, 0]], covariances=((P + P.T) / 2)[None]))
        result = step(made, second)
        told += [event for event in result.log.events if event["kind"] == "union-bound"]
    assert result.tracks.time == START + 4 * SECOND
    assert len(result.tracks.ids) >= 1
    assert told, "the union of these is not found in float64"
