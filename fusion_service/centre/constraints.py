"""What operators' orders allow and force in one step, as arrays over its rows and global ids.

An order about a local track holds for the row it has in this step, if any. Pairs come sorted by row, then track.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Ints
from fusion_service.centre.orders import Orders
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.order import LocalId

__all__ = ["Constraints", "constraints", "find_rows"]

Ids = NDArray[np.uint64]
Kind = TypeVar("Kind", bound=np.generic)


@dataclass(frozen=True, slots=True, eq=False)
class Constraints:
    """held (M,): rows that neither start nor join a track. forbidden_row, forbidden_track (K,): pairs never to be
    linked. forced_row, forced_track (L,): pairs to be linked, gate or no gate. apart_i < apart_j (A,): rows never in
    one track. separate (S, 2), sorted: global ids never to be merged, first below second."""

    held: NDArray[np.bool_]
    forbidden_row: Ints
    forbidden_track: Ids
    forced_row: Ints
    forced_track: Ids
    apart_i: Ints
    apart_j: Ints
    separate: Ids

    def forbids(self, row: Ints, track: Ids) -> NDArray[np.bool_]:
        """Of the pairs (row, global id), each (P,), those that are forbidden."""
        return _among(row, track, self.forbidden_row, self.forbidden_track)

    def parts(self, i: Ints, j: Ints) -> NDArray[np.bool_]:
        """Of the pairs of rows (i, j), each (P,), those that are never in one track."""
        low, high = np.minimum(i, j), np.maximum(i, j)
        return _among(low, high.astype(np.uint64), self.apart_i, self.apart_j.astype(np.uint64))


def constraints(orders: Orders, rows: Rows, names: tuple[str, ...]) -> Constraints:
    """What the standing orders mean for `rows`; names: all sources, sorted, as `rows.source` counts them."""
    if not orders.standing:
        row, ids = np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.uint64)
        nobody = np.zeros(len(rows.source), dtype=np.bool_)
        return Constraints(nobody, row, ids, row, ids, row, row, ids.reshape(0, 2))
    held: list[LocalId] = []
    never: list[tuple[LocalId, int]] = []
    forced: list[tuple[LocalId, int]] = []
    beside: list[tuple[LocalId, LocalId]] = []
    for _, one in sorted(orders.standing.items()):
        order = one.order
        held += one.locals
        if order.local is None:
            continue
        if order.against is not None:
            beside.append((order.local, order.against))
        elif order.track is not None:
            (forced if order.what == "link" else never).append((order.local, order.track))
    mask = np.zeros(len(rows.source), dtype=np.bool_)
    at = find_rows(rows, names, held)
    mask[at[at >= 0]] = True
    i, j = (find_rows(rows, names, [pair[k] for pair in beside]) for k in (0, 1))
    both = (i >= 0) & (j >= 0)
    i, j = np.minimum(i, j)[both], np.maximum(i, j)[both]
    link = rows.tracks.link
    row, track = _pairs(rows, names, never)
    # a row never joins the track in which the other one is
    row = np.concatenate([row, i, j])
    track = np.concatenate([track, link[j], link[i]])
    row, track = _sorted(row[track != NO_TRACK], track[track != NO_TRACK])
    own = link[row]
    separate = np.sort(np.stack([own, track], axis=1)[(own != NO_TRACK) & (own != track)], axis=1)
    i, j = _sorted(i, j)
    return Constraints(mask, row, track, *_sorted(*_pairs(rows, names, forced)), i, j, np.unique(separate, axis=0))


def find_rows(rows: Rows, names: tuple[str, ...], wanted: Iterable[LocalId]) -> Ints:
    """Row of each local track, -1 where it has none in this step."""
    index = {name: k for k, name in enumerate(names)}
    found = []
    for local in wanted:
        source = index.get(local.source, -1)
        low, high = np.searchsorted(rows.source, [source, source + 1]).tolist()
        at = low + int(np.searchsorted(rows.tracks.id[low:high], np.uint64(local.id)))
        there = at < high and int(rows.tracks.id[at]) == local.id and int(rows.epoch[at]) == local.epoch
        found.append(at if there else -1)
    return np.array(found, dtype=np.intp)


def _pairs(rows: Rows, names: tuple[str, ...], pairs: list[tuple[LocalId, int]]) -> tuple[Ints, Ids]:
    at = find_rows(rows, names, [local for local, _ in pairs])
    track = np.array([track for _, track in pairs], dtype=np.uint64)
    return at[at >= 0], track[at >= 0]


def _sorted(row: Ints, other: NDArray[Kind]) -> tuple[Ints, NDArray[Kind]]:
    """Pairs sorted, each once."""
    order = np.lexsort((other, row))
    row, other = row[order], other[order]
    new = np.ones(len(row), dtype=np.bool_)
    new[1:] = (row[1:] != row[:-1]) | (other[1:] != other[:-1])
    return row[new], other[new]


def _among(row: Ints, other: Ids, rows: Ints, others: Ids) -> NDArray[np.bool_]:
    """Which of the pairs are among the few sorted ones (rows, others)."""
    if not len(rows):
        return np.zeros(len(row), dtype=np.bool_)
    values = np.unique(others)
    width = len(values)
    place = np.minimum(np.searchsorted(values, other), width - 1)
    key = rows * width + np.searchsorted(values, others)
    wanted = np.where(values[place] == other, row * width + place, -1)
    at = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
    same: NDArray[np.bool_] = key[at] == wanted
    return same
