"""The targets that sources share in a step: pairs of local tracks of different sources in one global track."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_service.arrays import Ints
from fusion_service.centre.association import by_size
from fusion_service.centre.rows import NO_TRACK, Rows

__all__ = ["MOST_PAIRS", "Shared", "shared_pairs"]

MOST_PAIRS = 4000
"""Pairs of one step that are looked at; of more, every so many."""


@dataclass(frozen=True, slots=True, eq=False)
class Shared:
    """P pairs of rows (first, second), first < second, in the order of (first, second): linked to one global track, of
    different sources, and one of them at least with a datum that is new in this step."""

    first: Ints
    second: Ints

    def __len__(self) -> int:
        return len(self.first)


def shared_pairs(rows: Rows, step: int) -> Shared:
    """The pairs of a step; of more than `MOST_PAIRS` those that it is the turn of in this `step`."""
    linked = np.flatnonzero(rows.tracks.link != NO_TRACK)
    first, second = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
    for _, members in by_size(rows.tracks.link[linked]):
        i, j = np.triu_indices(members.shape[1], 1)
        first.append(linked[members[:, i]].ravel())
        second.append(linked[members[:, j]].ravel())
    one, two = np.concatenate(first), np.concatenate(second)
    new = (rows.fresh[one] | rows.fresh[two]) & (rows.source[one] != rows.source[two])
    one, two = one[new], two[new]
    order = np.lexsort((two, one))
    every = -(-len(order) // MOST_PAIRS)
    if every > 1:
        order = order[step % every :: every]
    return Shared(one[order], two[order])
