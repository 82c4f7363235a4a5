"""`Neighbours`: the pairs of `association.candidate_pairs`, found by what was near in the steps before.

Of the global tracks a list is kept of all pairs that were nearer than B_i + B_j when it was made, B = `WIDE` r, r being
`reach` sigma. A track is settled as long as

    |x - x'| + SEEN r <= B'

(' as it was then), and by the triangle inequality every pair of settled tracks within SEEN (r_i + r_j), of which the
pairs asked for are some, is in the list. What is not settled, is new or is loose is sought in a strip beside it. The
list is made anew when many are no more settled; where it would not last, and in crowds, in which `candidate_pairs`
bounds its pairs by rules of its own, it is asked itself. So the result is that of `candidate_pairs` to the last pair,
whatever was kept: nothing of this is in a checkpoint.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Floats, Ints, all_of
from fusion_service.centre.association import CROWDED, candidate_pairs, near_pairs, within

__all__ = ["Neighbours"]

WIDE = 3.0
SEEN = 2.02
"""What `candidate_pairs` counts as near for the sake of crowds, in r_i + r_j, and a little more."""
FEW_MOVERS = 0.05
"""Of the tracks, that may be unsettled before the list is made anew."""
LASTS = 4
"""Steps that a list has to last, ..."""
RESTS = 32
"""... or it is not made for so many."""
MOST_BESIDE = 20
"""Rows in strips, for each row, beyond which all are sought at once."""

Ids = NDArray[np.uint64]


@cache
def _all_pairs(count: int) -> tuple[Ints, Ints]:
    """Of fewer than `CROWDED`. Not to be written."""
    i, j = np.triu_indices(count, 1)
    return i, j


class _List(NamedTuple):
    """ids (L,), sorted, position (d, L) and bound B (L,) of the tracks; first < second (K,): the pairs; number (L,)
    of those of each."""

    ids: Ids
    position: Floats
    bound: Floats
    first: Ints
    second: Ints
    number: Ints


class Neighbours:
    """The list, and for how many steps it has stood, or is not to be made."""

    def __init__(self) -> None:
        self._list: _List | None = None
        self._age = self._rest = 0

    def pairs(self, ids: Ids, positions: Floats, sigma: Floats, reach: float, source: Ints) -> tuple[Ints, Ints]:
        """As `candidate_pairs` of the rows (d, M), the first of which are the global tracks `ids` (G,), sorted."""
        count = len(sigma)
        if not (all_of(np.isfinite(positions)) and all_of(np.isfinite(sigma)) and np.isfinite(reach)):
            return candidate_pairs(positions, sigma, reach, source)
        if count < CROWDED:
            i, j = _all_pairs(count)
            near = within(positions, np.maximum(sigma, 1e-9), reach, source, i, j)
            return i[near], j[near]
        r = reach * np.maximum(sigma, 1e-9)
        settled = self._settled(ids, positions, r)
        if settled is None:
            return candidate_pairs(positions, sigma, reach, source)
        listed, place = settled
        movers = np.append(~listed, np.ones(count - len(ids), dtype=np.bool_))
        found = self._beside(positions, r, np.flatnonzero(movers))
        kept = self._list
        if found is None or kept is None:
            return candidate_pairs(positions, sigma, reach, source)
        number = np.zeros(count, dtype=np.intp)
        number[place[place >= 0]] = kept.number[place >= 0]
        number += np.bincount(found[0], minlength=count) + np.bincount(found[1], minlength=count)
        if number.max(initial=0) >= CROWDED - 1:
            self._list, self._rest = None, RESTS
            return candidate_pairs(positions, sigma, reach, source)
        one, two = place[kept.first], place[kept.second]
        fixed = np.append(listed, False)  # the last: a track that is no more
        both = fixed[one] & fixed[two]
        one, two = np.concatenate([one[both], found[0]]), np.concatenate([two[both], found[1]])
        near = within(positions, np.maximum(sigma, 1e-9), reach, source, one, two)
        one, two = one[near], two[near]
        key = np.unique(np.minimum(one, two) * count + np.maximum(one, two))
        return key // count, key % count

    def _settled(self, ids: Ids, positions: Floats, r: Floats) -> tuple[Bools, Ints] | None:
        """Which tracks (G,) are settled, and where those of the list (L,) are among them, -1: gone. None where there is
        no list."""
        self._rest -= self._rest > 0
        for _ in range(2):
            kept = self._list
            if kept is not None and len(ids) and len(kept.position) == len(positions):
                place = self._place(kept, ids)
                there = place >= 0
                at, of = place[there], slice(None) if there.all() else there
                away = np.sqrt(((positions[:, at] - kept.position[:, of]) ** 2).sum(axis=0))
                settled = np.zeros(len(ids), dtype=np.bool_)
                settled[at] = away + SEEN * r[at] <= kept.bound[of]
                if len(ids) - int(settled.sum()) <= FEW_MOVERS * len(ids) + 8:
                    self._age += 1
                    return settled, place
                if self._age < LASTS:
                    self._rest = RESTS
                self._list = None
            if self._rest or len(ids) < CROWDED:
                return None
            self._make(ids, positions[:, : len(ids)], r[: len(ids)])
        return None

    @staticmethod
    def _place(kept: _List, ids: Ids) -> Ints:
        if len(kept.ids) == len(ids) and np.array_equal(kept.ids, ids):
            return np.arange(len(ids))
        at = np.minimum(np.searchsorted(ids, kept.ids), len(ids) - 1)
        return np.where(ids[at] == kept.ids, at, -1)

    def _make(self, ids: Ids, positions: Floats, r: Floats) -> None:
        bound = WIDE * r
        first, second, crowded = near_pairs(positions, bound, float(np.sqrt(2.0)), np.full(len(ids), -1))
        number = np.bincount(first, minlength=len(ids)) + np.bincount(second, minlength=len(ids))
        if crowded or number.max(initial=0) >= CROWDED - 8:
            self._rest = RESTS
            return
        self._list, self._age = _List(ids.copy(), positions.copy(), bound, first, second, number), 0

    @staticmethod
    def _beside(positions: Floats, r: Floats, movers: Ints) -> tuple[Ints, Ints] | None:
        """Pairs (mover, other), within `SEEN` r of both; None where strips hold too many."""
        if not len(movers):
            return movers, movers
        axis = positions[int(np.argmax(np.ptp(positions, axis=1)))]
        order = np.argsort(axis, kind="stable")
        wide = SEEN * (r[movers] + r.max(initial=0.0)) * (1.0 + 1e-9)
        low = np.searchsorted(axis[order], axis[movers] - wide, "left")
        number = np.searchsorted(axis[order], axis[movers] + wide, "right") - low
        if int(number.sum()) > MOST_BESIDE * len(r):
            return None
        one = np.repeat(movers, number)
        two = order[np.arange(len(one)) - np.repeat(np.cumsum(number) - number, number) + np.repeat(low, number)]
        away = ((positions[:, one] - positions[:, two]) ** 2).sum(axis=0)
        near = (away <= (SEEN * (r[one] + r[two])) ** 2) & (one != two)
        return one[near], two[near]
