"""`neighbours`: the pairs of `candidate_pairs` whatever was kept of the steps before."""

import numpy as np
import pytest

from fusion_service.centre.association import candidate_pairs
from fusion_service.centre.neighbours import Neighbours


@pytest.mark.parametrize(("side", "speed"), [(9000.0, 3.0), (9000.0, 60.0), (2500.0, 3.0), (600.0, 3.0)])
def test_the_pairs_are_those_of_a_search_without_memory(side: float, speed: float) -> None:
    rng = np.random.default_rng(7)
    print("seed 7")
    beside, reach, pairs, lists = Neighbours(), 3.5, 0, 0
    ids = np.arange(1, 401, dtype=np.uint64)
    place, way = rng.uniform(0.0, side, (2, 400)), rng.normal(0.0, speed, (2, 400))
    sigma = rng.uniform(5.0, 40.0, 400)
    for step in range(40):
        place = place + way
        place[:, rng.integers(0, len(ids), 2)] = rng.uniform(0.0, side, (2, 2))
        sigma = sigma * rng.uniform(0.98, 1.02, len(ids))
        if step % 3 == 0:  # one ends, one begins
            gone = int(rng.integers(0, len(ids)))
            ids = np.append(np.delete(ids, gone), np.uint64(1000 + step))
            place = np.append(np.delete(place, gone, axis=1), rng.uniform(0.0, side, (2, 1)), axis=1)
            way, sigma = (
                np.append(np.delete(way, gone, axis=1), [[0.0], [0.0]], axis=1),
                np.append(np.delete(sigma, gone), 20.0),
            )
        loose = int(rng.integers(0, 12))
        at = np.concatenate([place, rng.uniform(0.0, side, (2, loose))], axis=1)
        size = np.concatenate([sigma, rng.uniform(5.0, 400.0 if step == 30 else 40.0, loose)])
        source = np.concatenate([np.full(len(ids), -1), np.sort(rng.integers(0, 3, loose))])
        if step == 35:
            at[0, 5] = np.nan
        got = beside.pairs(ids, at, size, reach, source)
        want = candidate_pairs(at, size, reach, source)
        assert np.array_equal(got, want)
        pairs, lists = pairs + len(want[0]), lists + (beside._list is not None)
    assert pairs > 100
    assert lists > 20 or (side, speed) != (9000.0, 3.0), "it is kept where it lasts"


def test_few_none_and_another_dimension() -> None:
    beside, none = Neighbours(), np.zeros(0, dtype=np.uint64)
    assert [len(part) for part in beside.pairs(none, np.zeros((2, 0)), np.zeros(0), 3.0, np.zeros(0, np.intp))] == [
        0,
        0,
    ]
    rng = np.random.default_rng(8)
    print("seed 8")
    ids, source = np.arange(1, 101, dtype=np.uint64), np.full(100, -1)
    for axes in (2, 3, 2):
        at, sigma = rng.uniform(0.0, 2000.0, (axes, 100)), np.full(100, 20.0)
        assert np.array_equal(beside.pairs(ids, at, sigma, 3.0, source), candidate_pairs(at, sigma, 3.0, source))
