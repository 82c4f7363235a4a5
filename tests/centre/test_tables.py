"""The tables of sources from report to report, beside dictionaries that do the same track by track."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion_service.arrays import find_sorted
from fusion_service.centre.tracks import LINKS, Tracks, by_id, empty_tracks, join_tracks, renewed, taken, unlinked
from fusion_service.motion import predict
from schemas import Motion

SEED = 14
SPACE = ("x", "y", "vx", "vy")


def table(ids: NDArray[np.uint64], time: NDArray[np.int64], updated: NDArray[np.int64], origin: int = 0) -> Tracks:
    """Tracks told apart by their means: number in the report, and time."""
    count = len(ids)
    blank = empty_tracks(4)
    columns = {name: np.resize(getattr(blank, name), count).astype(getattr(blank, name).dtype) for name in (
        "existence", "interval", "identity", "kind", "kind_p", "lineage")}  # fmt: skip
    mean = np.stack([np.arange(count, dtype=float), time.astype(float), ids.astype(float), updated.astype(float)])
    return replace(
        blank, id=ids, time=time, updated=updated, mean=mean, covariance=np.tile(np.eye(4)[:, :, None], count),
        log_weight=np.zeros((0, count)), part_mean=np.zeros((4, 0, count)), part_covariance=np.zeros((4, 4, 0, count)),
        origin=np.full(count, origin, dtype=np.uint8), extent=np.zeros((0, count)), **columns, **unlinked(count),
    )  # fmt: skip


def report(rng: np.random.Generator, most: int, *, twice: bool) -> Tracks:
    """Some tracks at some times, in any order; some of them of an exercise."""
    ids = rng.choice(most, size=int(rng.integers(0, most + 1)), replace=twice).astype(np.uint64)
    time = rng.integers(0, 4, len(ids)).astype(np.int64)
    one = table(ids, time, time - rng.integers(0, 2, len(ids)))
    return replace(one, origin=(rng.random(len(ids)) < 0.2).astype(np.uint8))


def as_rows(tracks: Tracks) -> list[tuple[float, ...]]:
    """What tells a version from all others, and its link."""
    return [(*column, float(link)) for column, link in zip(tracks.mean.T.tolist(), tracks.link.tolist(), strict=True)]


def slow(old: Tracks, new: Tracks) -> tuple[list[tuple[float, ...]], set[tuple[float, ...]]]:
    """The table after a report, and the pairs (old mean, new mean) of successive versions, one after the other."""
    now = {int(i): (k, False) for k, i in enumerate(old.id.tolist())}
    pairs: set[tuple[float, ...]] = set()
    for at in sorted(range(len(new.id)), key=lambda k: (new.time[k], k)):
        i = int(new.id[at])
        if i in now:
            k, fresh = now[i]
            was = new if fresh else old
            if was.time[k] > new.time[at]:
                continue
            if new.updated[at] > was.updated[k] and new.origin[at] == was.origin[k] and i in set(old.id.tolist()):
                pairs.add((*was.mean[:, k].tolist(), *new.mean[:, at].tolist()))
        now[i] = (at, True)
    out = []
    for i, (k, fresh) in sorted(now.items()):
        there = np.flatnonzero(old.id == i)
        if not fresh:
            link = float(old.link[k])
        else:
            link = float(old.link[there[0]]) if len(there) and old.origin[there[0]] == new.origin[k] else 0.0
        out.append((*(new if fresh else old).mean[:, k].tolist(), link))
    return out, pairs


@pytest.mark.parametrize("twice", [False, True])
def test_a_report_makes_of_a_table_what_a_dictionary_makes_of_it(twice: bool) -> None:
    rng = np.random.default_rng([SEED, twice])
    print(f"seed {SEED}")
    seen = 0
    for _ in range(300):
        old = renewed(empty_tracks(4), by_id(report(rng, 8, twice=False))).new
        old = replace(old, link=rng.integers(0, 5, len(old.id)).astype(np.uint64))
        new = report(rng, 8, twice=twice)
        step = renewed(old, by_id(new), versions=True)
        whole = join_tracks([old.take(step.stays), step.new])
        whole = whole.take(np.argsort(whole.id))
        expected, pairs = slow(old, new)
        assert as_rows(whole) == expected
        found = set()
        if step.pair is not None:
            found = {(*a, *b) for a, b in zip(step.pair[0].mean.T.tolist(), step.pair[1].mean.T.tolist(), strict=True)}
        assert found == pairs
        seen += len(pairs)
    assert seen > 100


def test_the_same_ids_again_are_not_copied() -> None:
    ids, time = np.arange(1, 50, dtype=np.uint64), np.zeros(49, dtype=np.int64)
    old = replace(table(ids, time, time), link=ids)
    new = table(ids, time + 1, time + 1)
    step = renewed(old, by_id(new), versions=True)
    assert by_id(new) is new
    assert step.new.mean is new.mean
    assert all(getattr(step.new, name) is getattr(old, name) for name in LINKS)
    assert step.pair is not None
    assert step.pair[0] is old
    assert not step.stays.any()


def test_rows_are_taken_as_numpy_takes_them() -> None:
    rng = np.random.default_rng(SEED)
    ids = np.arange(30, dtype=np.uint64)
    one = table(ids, rng.integers(0, 9, 30), rng.integers(0, 9, 30))
    every = np.ones(30, dtype=np.bool_)
    for rows in (rng.random(30) < 0.5, every, ~every, np.array([3, 3, -1]), slice(2, 9)):
        got = taken(one, rows)
        for name in ("mean", "covariance", "part_covariance", "time", "id"):
            assert np.array_equal(getattr(got, name), getattr(one, name)[..., rows])
    assert taken(one, every) is one


def test_ids_are_found_where_a_search_finds_them() -> None:
    rng = np.random.default_rng(SEED)
    top = 2**64 - 1
    for first in (0, 1, 2**32 + 1, top - 400):
        for spread in (1, 3, 1000):
            step = rng.integers(1, 1 + spread, 200).astype(np.uint64)
            ids = np.unique(
                np.minimum(np.uint64(first) + np.cumsum(step, dtype=np.uint64) % np.uint64(400 * spread), top)
            )
            some = np.concatenate([rng.choice(ids, 300), np.array([0, first, top, top - 1], dtype=np.uint64)])
            assert np.array_equal(find_sorted(ids.astype(np.uint64), some), np.searchsorted(ids, some))
    nothing = np.zeros(0, dtype=np.uint64)
    assert not len(find_sorted(ids, nothing))
    assert find_sorted(nothing, np.full(100, 7, dtype=np.uint64)).tolist() == [0] * 100


MOTIONS = {
    "cv": Motion("cv", q=0.5),
    "ca": Motion("ca", q=0.5, sigma=0.1),
    "singer": Motion("singer", sigma=2.0, tau=20.0),
    "ou": Motion("ou", sigma=2.0, tau=20.0),
    "still": Motion("still", q=0.5, sigma=0.1),
    "ct": Motion("ct", q=0.5),
}


@pytest.mark.parametrize("kind", MOTIONS)
def test_a_gap_that_all_have_in_common_gives_the_bits_of_each_alone(kind: str) -> None:
    rng = np.random.default_rng(SEED)
    root = rng.normal(size=(4, 4, 40))
    means, covariances = rng.normal(size=(4, 40)), np.einsum("ikb,jkb->ijb", root, root)
    motion = MOTIONS[kind]
    together = predict(motion, SPACE, means, covariances, np.full(40, 0.7))
    mixed = predict(motion, SPACE, means, covariances, np.where(np.arange(40) % 2, 0.7, 0.3))
    for one, other in zip(together, mixed, strict=True):
        assert np.array_equal(one[..., 1::2], other[..., 1::2])
