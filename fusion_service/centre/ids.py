"""Global ids: (generation, counter), 32 bits each in one u64; an id is given once and never again."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre.naming import Book, LocalKey, Places
from fusion_service.centre.promised import Promised
from fusion_service.centre.whereabouts import Begun

__all__ = ["Ids"]


class Ids:
    """The ids that are given from now on, in order. next: the first of them. book: the births that may be made again;
    None where none is. promised: ids that wait for the local tracks that they were given for;
    waiting: those of suspended tracks, sorted."""

    def __init__(self) -> None:
        self.next = 1
        self.book: Book | None = None
        self.promised = Promised()
        self.waiting: NDArray[np.uint64] = np.zeros(0, dtype=np.uint64)

    def begin(self, generation: int) -> None:
        """Go on with the ids of a generation that was never used."""
        self.next = (generation << 32) + 1

    def allot(
        self,
        count: int,
        whom: Callable[[], Sequence[Sequence[LocalKey]] | Places] | None = None,
        begun: Callable[[], Begun] | None = None,
    ) -> NDArray[np.uint64]:
        """So many ids, new ones in order, but for tracks that begin again: in a step made again, or after a restart.
        whom: the groups of local tracks that they are for, or the places; begun: what these groups begin with."""
        if whom is None or not count or (self.book is None and not self.promised):
            first, self.next = self.next, self.next + count
            return np.arange(first, self.next, dtype=np.uint64)
        groups = whom()
        known: list[int | None] = [None] * count
        if self.promised and not isinstance(groups, Places):
            known = self.promised.take(groups, begun() if begun is not None else None)
        if self.book is not None:
            return np.array(self.book.allot(groups, self.fresh, known), dtype=np.uint64)
        new = iter(self.fresh(known.count(None)))
        return np.array([next(new) if one is None else one for one in known], dtype=np.uint64)

    def known(self, there: NDArray[np.uint64]) -> NDArray[np.uint64]:
        """The ids `there`, sorted, and those that may come back."""
        if not len(self.waiting) and not self.promised:
            return there
        return np.unique(np.concatenate([there, self.waiting, self.promised.ids]))

    def fresh(self, count: int) -> list[int]:
        """So many new ones."""
        first, self.next = self.next, self.next + count
        return list(range(first, self.next))
