"""Tables of columns made over, and what is picked of columns, against what they stand for."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from fusion_service.arrays import all_of, among, any_of, filled, finite, same_ids, subset
from fusion_service.centre.association import by_size
from fusion_service.centre.gating import _newest_other
from fusion_service.centre.tracks import LINKS, Tracks, empty_tracks, renewed, unlinked
from fusion_service.records import altered, columns_of, names_of


@dataclasses.dataclass(frozen=True, slots=True)
class Table:
    record: int
    name: str


@dataclasses.dataclass(frozen=True)
class One:
    only: int


def test_a_record_is_made_over_as_by_the_standard_library() -> None:
    table = Table(1, "a")
    assert altered(table, record=2) == dataclasses.replace(table, record=2) == Table(2, "a")
    assert columns_of(table) == (1, "a")
    assert columns_of(One(3)) == (3,)
    assert names_of(Table) == ("record", "name")
    assert altered(One(3)) == One(3)
    with pytest.raises(TypeError):
        altered(table, other=1)


@pytest.mark.parametrize("seed", range(20))
def test_among_is_isin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 12, rng.integers(0, 30)).astype(np.uint64)
    some = rng.integers(0, 12, rng.integers(0, 9)).astype(np.uint64) + np.uint64(2**63 * int(rng.integers(0, 2)))
    np.testing.assert_array_equal(among(values, some), np.isin(values, some), err_msg=f"seed {seed}")


def test_a_subset_that_is_all_is_no_copy() -> None:
    array = np.arange(12.0).reshape(2, 6)
    assert subset(array, np.arange(6)) is array
    np.testing.assert_array_equal(subset(array, np.array([1, 4])), array[:, [1, 4]])


@pytest.mark.parametrize("seed", range(20))
def test_groups_and_the_newest_datum_of_the_others(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 25))
    labels = rng.integers(1, rng.integers(2, 20), count).astype(np.uint64)
    if seed % 4 == 0:
        labels = np.repeat(np.arange(count // 3, dtype=np.uint64), 3)
    updated = rng.integers(0, 4, len(labels))
    groups = list(by_size(labels))
    assert [rows.shape[1] for _, rows in groups] == sorted({int((labels == one).sum()) for one in labels}), seed
    for names, rows in groups:
        assert (np.diff(names.astype(np.int64)) > 0).all(), seed
        for name, row in zip(names, rows, strict=True):
            assert row.tolist() == np.flatnonzero(labels == name).tolist(), seed
    found = _newest_other([rows for _, rows in groups], updated)
    for k, one in enumerate(found.tolist()):
        others = updated[(labels == labels[k]) & (np.arange(len(labels)) != k)]
        assert one == max(others.tolist(), default=-1), seed


def test_a_report_of_the_same_tracks_is_as_one_that_lists_another_beside_them() -> None:
    rng = np.random.default_rng(5)
    print("seed 5")

    def table(ids: list[int], time: int, origin: list[int]) -> Tracks:
        count, none = len(ids), empty_tracks(2)
        columns = {name: np.zeros((*column.shape[:-1], count), column.dtype) for name, column in _columns(none).items()}
        columns |= unlinked(count) | {"id": np.array(ids, dtype=np.uint64), "mean": rng.normal(size=(2, count))}
        columns |= {"time": np.full(count, time), "updated": np.full(count, time) - np.arange(count) % 2 * time}
        columns |= {
            "origin": np.array(origin, dtype=np.uint8),
            "link": np.arange(count, dtype=np.uint64) + np.uint64(9),
        }
        return dataclasses.replace(none, **columns)

    old = table([1, 2, 3, 4], 5, [0, 0, 0, 1])
    new = table([1, 2, 3, 4], 7, [0, 0, 1, 1])
    more = table([1, 2, 3, 4, 5], 7, [0, 0, 1, 1, 0])
    more = dataclasses.replace(more, mean=np.append(new.mean, np.zeros((2, 1)), axis=1))
    alike, longer = renewed(old, new, True), renewed(old, more, True)
    assert not alike.stays.any()
    assert alike.pair is not None
    assert longer.pair is not None
    assert alike.new.link.tolist()[:2] == [9, 10]
    assert len(alike.pair[0].id) == 1
    for name in ("id", "mean", "time", *LINKS):
        np.testing.assert_array_equal(getattr(alike.new, name), getattr(longer.new, name)[..., :4])
        for side in (0, 1):
            np.testing.assert_array_equal(getattr(alike.pair[side], name), getattr(longer.pair[side], name))


def _columns(table: Tracks) -> dict[str, NDArray[Any]]:
    return dict(zip(names_of(Tracks), columns_of(table), strict=True))


def test_a_record_of_many_kinds_is_made_over() -> None:
    @dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
    class Named:
        kind: str
        new: int
        old: int = 3

    named = Named(kind="a", new=1)
    assert altered(named, old=4, kind="b") == Named(kind="b", new=1, old=4)
    assert altered(altered(named, new=7), new=8, old=9) == Named(kind="a", new=8, old=9)
    assert altered(named) == named
    assert altered(named) is not named


@pytest.mark.parametrize("shape", [(0,), (1,), (40,), (3, 5), (0, 4)])
def test_masks_are_looked_at_by_their_bytes(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(len(shape))
    for share in (0.0, 0.1, 0.9, 1.0):
        mask = rng.random(shape) < share
        for one in (mask, ~mask, mask[..., ::2], mask.T):
            assert all_of(one) is bool(one.all())
            assert any_of(one) is bool(one.any())


def test_columns_that_are_the_same_filled_and_finite() -> None:
    ids = np.arange(9, dtype=np.uint64)
    assert same_ids(ids, ids.copy())
    assert same_ids(ids[:0], ids[:0])
    assert same_ids(ids[::2], ids[::2].copy())
    assert not same_ids(ids, ids[:-1])
    assert not same_ids(ids, ids[::-1])
    np.testing.assert_array_equal(filled((2, 3), -1, np.int64), np.full((2, 3), -1))
    values = np.array([1.0, np.nan, np.inf, -np.inf])
    np.testing.assert_array_equal(finite(values), np.nan_to_num(values))
    assert finite(values[:1]).base is values
