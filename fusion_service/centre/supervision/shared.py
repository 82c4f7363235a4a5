"""The targets that sources share in a step: pairs of local tracks of different sources in one global track."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Ints
from fusion_service.centre.association import by_size
from fusion_service.centre.rows import NO_TRACK, Rows

__all__ = ["MOST_PAIRS", "Shared", "shared_pairs"]

MOST_PAIRS = 4000
"""Pairs of one step that are looked at; of more, those of every so many global tracks."""
TURN = 32
"""Steps for which the same ones are looked at: what a pair says in one step is compared with what it said before."""


@dataclass(frozen=True, slots=True, eq=False)
class Shared:
    """P pairs of rows (first, second), first < second, in the order of (first, second): linked to one global track, of
    different sources, and one of them at least with a datum that is new in this step."""

    first: Ints
    second: Ints

    def __len__(self) -> int:
        return len(self.first)


def shared_pairs(rows: Rows, step: int, label: NDArray[np.uint64] | None = None) -> Shared:
    """The pairs of a step; of more than about `MOST_PAIRS` those of the global tracks that it is the turn of in this
    `step`. label (M,): the target of each row, where it is another than its link says; 0: none."""
    target = rows.tracks.link if label is None else label
    linked = np.flatnonzero(target != NO_TRACK)
    size = np.unique(target[linked], return_counts=True)[1]
    every = 1
    while every * MOST_PAIRS < int((size * (size - 1) // 2).sum()):
        every *= 2
    turn = (target[linked] + np.uint64(step // TURN)) % np.uint64(every) == 0
    linked = linked[turn]
    first, second = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
    for _, members in by_size(target[linked]):
        i, j = np.triu_indices(members.shape[1], 1)
        first.append(linked[members[:, i]].ravel())
        second.append(linked[members[:, j]].ravel())
    one, two = np.concatenate(first), np.concatenate(second)
    new = (rows.fresh[one] | rows.fresh[two]) & (rows.source[one] != rows.source[two])
    one, two = one[new], two[new]
    order = np.lexsort((two, one))[: 2 * MOST_PAIRS]
    return Shared(one[order], two[order])
