"""Which id a track takes that begins in a step made again: the one it has been published under, if it has.

A global id stays with its target, and is never given to another. Where steps are made again (`history`), the tracks
that begin in them are known already under ids that were given in the first course of these steps, to groups of the same
local tracks. A group takes the id that one of its local tracks is linked to at the end of the first course; else
that of a track that one of them founded; else a new one. Only ids of tracks that are not there in the state from which
the steps are made again, and that have not ended since, may be taken, each once: an id that has ended never returns. A
track of that state that has ended in the first course, and is there after the second, goes on under a new id.

The components of an intensity have no ids: their tracks take the id of the nearest birth of the first course within
the gate.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Floats

__all__ = ["Birth", "Book", "LocalKey", "Places", "Table"]

MOST_BIRTHS = 200_000
"""Births that are remembered; the oldest are forgotten."""
LocalKey = tuple[str, int, int]
"""Source, epoch and id of a local track."""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """The links of one source: its epoch, local ids (T,) u64, global ids (T,) u64."""

    epoch: int
    id: NDArray[np.uint64]
    link: NDArray[np.uint64]


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where B tracks begin: mean (p, B), covariance (p, p, B), the d2 within which two may be the same."""

    mean: Floats
    covariance: Floats
    gate: float


class Birth(NamedTuple):
    """A global id as it was given: in which step, to which local track, or where (mean, covariance)."""

    step: int
    id: int
    founder: LocalKey | None
    place: tuple[Floats, Floats] | None = None


@dataclass(slots=True)
class Book:
    """The births of the steps that may be made again. step: the one that is being made.

    born: those of the present course, in order; other: the id that a track goes on under that ended, and was there
    after all, and the step since when.
    """

    step: int = 0
    born: list[Birth] = field(default_factory=list)
    other: dict[int, tuple[int, int]] = field(default_factory=dict)
    _free: dict[int, Birth] = field(default_factory=dict)
    _links: dict[LocalKey, int] = field(default_factory=dict)
    _founded: dict[LocalKey, list[int]] = field(default_factory=dict)

    def clear(self) -> None:
        """Nothing will be made again of what was made so far."""
        self.born, self.other = [], {}

    def forget(self, before: int) -> None:
        """No step before `before` will be made again."""
        if (self.born and self.born[0].step < before) or len(self.born) > MOST_BIRTHS:
            self.born = [one for one in self.born if one.step >= before][-MOST_BIRTHS:]
        if self.other and min(step for _, step in self.other.values()) < before:
            self.other = {one: new for one, new in self.other.items() if new[1] >= before}

    def again(self, step: int, tables: Mapping[str, Table], ids: Collection[int]) -> None:
        """The steps after `step` are made again. tables: the links until now, by source; ids: of the picture."""
        free = [one for one in self.born if one.step > step and one.id in ids]
        self.born = [one for one in self.born if one.step <= step]
        self._free, self._links, self._founded = {one.id: one for one in free}, {}, {}
        ids = np.array(sorted(self._free), dtype=np.uint64)
        for name, table in sorted(tables.items()):
            mine = np.isin(table.link, ids)
            for local, track in zip(table.id[mine].tolist(), table.link[mine].tolist(), strict=True):
                self._links[name, max(table.epoch, 0), local] = track
        for one in free:
            if one.founder is not None:
                self._founded.setdefault(one.founder, []).append(one.id)

    def done(self, ids: Iterable[int], before: Collection[int], fresh: Callable[[int], list[int]]) -> dict[int, int]:
        """They are made. ids: of the tracks that there are; before: of those before, and all that are above. The other
        id {old: new} of each that is there again: the one it has gone on under, if that is there, else a new one."""
        self._free, self._links, self._founded = {}, {}, {}
        new: dict[int, int] = {}
        ids = list(ids)
        for one in ids:
            if one not in before:
                known = self.other.get(one, (0, 0))[0]
                new[one] = known if known in before and known not in ids else fresh(1)[0]
                self.other[one] = new[one], self.step
        return new

    def allot(
        self,
        whom: Sequence[Sequence[LocalKey]] | Places,
        fresh: Callable[[int], list[int]],
        known: Sequence[int | None] = (),
    ) -> list[int]:
        """An id for each group of local tracks that begins a track, or each place; fresh: gives new ones; known: those
        that have one already, none where it is empty."""
        count = whom.mean.shape[1] if isinstance(whom, Places) else len(whom)
        known = list(known) or [None] * count
        for one in known:
            self._free.pop(one or 0, None)
        if isinstance(whom, Places):
            known = self._nearest(whom) if self._free else known
        elif self._free:
            open_ = [group if one is None else () for group, one in zip(whom, known, strict=True)]
            known = [two if one is None else one for one, two in zip(known, self._linked(open_), strict=True)]
        new = iter(fresh(known.count(None)))
        ids = [next(new) if one is None else one for one in known]
        step = self.step
        if isinstance(whom, Places):
            where = ((whom.mean[:, place], whom.covariance[:, :, place]) for place in range(count))
            self.born += [Birth(step, one, None, place) for one, place in zip(ids, where, strict=True)]
        else:
            self.born += [Birth(step, one, next(iter(group), None)) for one, group in zip(ids, whom, strict=True)]
        return ids

    def _take(self, ids: Iterable[int | None]) -> int | None:
        found = next((one for one in ids if one is not None and one in self._free), None)
        if found is not None:
            del self._free[found]
        return found

    def _linked(self, whom: Sequence[Sequence[LocalKey]]) -> list[int | None]:
        known = [self._take(self._links.get(local) for local in group) for group in whom]
        for place, group in enumerate(whom):
            if known[place] is None:
                known[place] = self._take(one for local in group for one in self._founded.get(local, ()))
        return known

    def _nearest(self, where: Places) -> list[int | None]:
        known: list[int | None] = [None] * where.mean.shape[1]
        free = [one for one in self._free.values() if one.place is not None]
        if not free or not known:
            return known
        means = np.stack([one.place[0] for one in free if one.place is not None], axis=-1)
        spreads = np.stack([one.place[1] for one in free if one.place is not None], axis=-1)
        pairs = []
        for place in range(len(known)):
            away = means - where.mean[:, place, None]
            distance = linalg.quadratic(spreads + where.covariance[:, :, place, None], away)
            near = np.flatnonzero(distance <= where.gate)
            pairs += [(float(distance[i]), place, i) for i in near.tolist()]
        for _, place, i in sorted(pairs):
            if known[place] is None:
                known[place] = self._take([free[i].id])
        return known
