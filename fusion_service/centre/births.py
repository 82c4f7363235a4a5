"""Global tracks that begin: loose local tracks of different sources, grouped into what may be one target each."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Ints, among
from fusion_service.centre.candidates import Pairs
from fusion_service.centre.naming import LocalKey
from fusion_service.centre.rows import Rows
from fusion_service.metrics import assign_near

__all__ = ["group", "locals_of"]


def group(at: Ints, source: Ints, pairs: Pairs) -> Ints:
    """The group (A,) of each of the rows `at`, which are in order: 0, 1, ... by the first row of each.

    At most one row of each source is in a group, each two within the gate. Sources come one after the other; the rows
    of each are given to the groups so far by the optimal assignment of the mean of d2 + log det to their members, where
    staying apart costs the gate of a pair; for two sources that is the best of all groupings. source:
    (M,) of all rows, `pairs` of rows, (first, second) in order.
    """
    label = np.full(len(source), -1, dtype=np.intp)
    mine = np.zeros(len(source), dtype=np.bool_)
    mine[at] = True
    some = mine[pairs.first] & mine[pairs.second]
    first, second = pairs.first[some], pairs.second[some]
    top = pairs.spread[some].max(initial=-np.inf)
    gain = 1e-6 + (pairs.gate[some] - pairs.distance[some]) + (top - pairs.spread[some])
    size = np.zeros(len(at), dtype=np.intp)
    count = 0
    for name in np.unique(source[at]).tolist():
        rows = at[source[at] == name]
        near = (source[second] == name) & (label[first] >= 0)
        row, groups, worth = _by_group(second[near], label[first[near]], gain[near], size, len(at))
        kept = assign_near(np.searchsorted(rows, row), groups, worth, (len(rows), max(count, 1)))
        label[row[kept]] = groups[kept]
        size[groups[kept]] += 1
        alone = rows[label[rows] < 0]
        label[alone] = count + np.arange(len(alone))
        size[count : count + len(alone)] = 1
        count += len(alone)
    _, order, number = np.unique(label[at], return_index=True, return_inverse=True)
    rank = np.empty(len(order), dtype=np.intp)
    rank[np.argsort(order, kind="stable")] = np.arange(len(order))
    return np.asarray(rank[number])


def _by_group(
    row: Ints, groups: Ints, gain: NDArray[np.float64], size: Ints, width: int
) -> tuple[Ints, Ints, NDArray[np.float64]]:
    """The pairs (row, group) in which the row is near every member, and the mean gain."""
    if not len(row):
        return row, groups, gain
    key = row * width + groups
    order = np.argsort(key, kind="stable")
    unique, start, number = np.unique(key[order], return_index=True, return_counts=True)
    total = np.add.reduceat(gain[order], start)
    whole = number == size[unique % width]
    return unique[whole] // width, unique[whole] % width, total[whole] / number[whole]


def locals_of(rows: Rows, names: tuple[str, ...], at: Ints, groups: Ints, chosen: Ints) -> list[list[LocalKey]]:
    """The local tracks, in order, of each of the groups `chosen`, which are in order; groups (A,): of the rows `at`;
    names: of sources."""
    some = at[among(groups, chosen)]
    group_of = groups[among(groups, chosen)]
    order = np.argsort(group_of, kind="stable")
    some = some[order]
    whose = [names[source] for source in rows.source[some].tolist()]
    keys = [*zip(whose, rows.epoch[some].tolist(), rows.tracks.id[some].tolist(), strict=True)]
    ends = np.cumsum(np.bincount(np.searchsorted(chosen, group_of), minlength=len(chosen))).tolist()
    return [keys[begin:end] for begin, end in pairwise([0, *ends])]
