"""Which local tracks are compared with which in a step, and what the comparison was last.

The pairs of `shared` are, and for `HELD` more data those that were linked to one target before: a source whose
covariances are far too small loses its links, and what is seen of it in the links that it keeps is only what fits.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Floats, Ints, picked, to_bytes
from fusion_service.centre.derived import rows_of
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.supervision.shared import Shared

__all__ = ["Beside", "Met"]

HELD = 5
KINDS = ("<i8", "<u8", "<u8", "<i8", "<f8")


@dataclass(frozen=True, slots=True, eq=False)
class Met:
    """R pairs of rows that were compared: source (2, R) by number, epoch, id (2, R) u64; held (R,): data since they
    parted; difference (n, R), whitened, NaN where a component is not known."""

    source: Ints
    epoch: NDArray[np.uint64]
    id: NDArray[np.uint64]
    held: NDArray[np.int64]
    difference: Floats

    @classmethod
    def none(cls, n: int) -> Met:
        ids = np.zeros((2, 0), dtype=np.uint64)
        return cls(np.zeros((2, 0), dtype=np.intp), ids, ids, np.zeros(0, dtype=np.int64), np.zeros((n, 0)))

    def take(self, some: Any) -> Met:
        """Some of them."""
        return Met(*(picked(getattr(self, one.name), some) for one in fields(self)))


class Beside:
    """The pairs of the last step, of which rows (R,) of that there are in this one."""

    def __init__(self, n: int) -> None:
        self._n = n
        self._names: tuple[str, ...] = ()
        self._met = Met.none(n)

    def pairs(self, rows: Rows, names: tuple[str, ...], shared: Shared) -> tuple[Ints, Ints, NDArray[np.int64], Floats]:
        """The rows first, second (R,) to be compared, for how many data they are held (R,), and what their difference
        was last (n, R), NaN where there is none."""
        count, old = len(rows.source), self._met
        place = {name: i for i, name in enumerate(names)}
        number = np.array([*(place.get(name, -1) for name in self._names), -1], dtype=np.intp)
        one, two = (rows_of(rows, number[old.source[k]], old.epoch[k], old.id[k]) for k in (0, 1))
        parted = self._parted(rows, one, two)
        held = np.concatenate([np.zeros(len(shared), dtype=np.int64), old.held[parted] + 1])
        first, second = np.concatenate([shared.first, one[parted]]), np.concatenate([shared.second, two[parted]])
        there = (one >= 0) & (two >= 0)
        key = np.where(there, one * count + two, -1)
        order = np.argsort(key, kind="stable")
        asked = first * count + second
        at = np.minimum(np.searchsorted(key[order], asked), max(len(key) - 1, 0))
        last = np.full((self._n, len(asked)), np.nan)
        if len(key):
            known = key[order][at] == asked
            last[:, known] = picked(old.difference, order[at[known]])
        self._quiet = old.take(there & ~self._fresh(rows, one, two))
        self._names = names
        self._quiet = Met(number[self._quiet.source], *(getattr(self._quiet, f.name) for f in fields(Met)[1:]))
        return first, second, held, last

    @staticmethod
    def _fresh(rows: Rows, one: Ints, two: Ints) -> Bools:
        if not len(rows.source):
            return np.zeros(len(one), dtype=np.bool_)
        return np.asarray(rows.fresh[one] | rows.fresh[two])

    def _parted(self, rows: Rows, one: Ints, two: Ints) -> Bools:
        """Pairs that were together, are apart, and one of them has something new; not where one is now linked to
        another track of the other's source: an id went over to another target."""
        if not len(rows.source):
            return np.zeros(len(one), dtype=np.bool_)
        link = rows.tracks.link
        together = (link[one] == link[two]) & (link[one] != NO_TRACK)
        apart = (one >= 0) & (two >= 0) & ~together & (self._met.held < HELD)
        _, target = np.unique(link, return_inverse=True)
        size = int(rows.source.max()) + 1
        linked = np.flatnonzero(link != NO_TRACK)
        there = target[linked] * size + rows.source[linked]
        mine, its = target[one] * size + rows.source[two], target[two] * size + rows.source[one]
        return np.asarray(apart & self._fresh(rows, one, two) & ~np.isin(mine, there) & ~np.isin(its, there))

    def keep(self, rows: Rows, first: Ints, second: Ints, held: NDArray[np.int64], difference: Floats) -> None:
        """Remember the pairs of this step, and those of the last in which nothing is new."""
        both = np.stack([first, second])
        new = Met(rows.source[both], rows.epoch[both], rows.tracks.id[both], held, difference)
        quiet = self._quiet
        self._met = Met(*(np.concatenate([getattr(new, f.name), getattr(quiet, f.name)], axis=-1) for f in fields(Met)))

    def packed(self) -> dict[str, Any]:
        """As plain values."""
        met = self._met
        columns = (met.source.astype(np.int64), met.epoch, met.id, met.held, met.difference)
        return {"n": self._n, "names": list(self._names), "columns": [to_bytes(one) for one in columns]}

    def restore(self, packed: Mapping[str, Any]) -> None:
        """From what `packed` gave; with nothing, if that was in another space."""
        if packed.get("n") != self._n:
            return
        columns = zip(packed["columns"], KINDS, strict=True)
        source, epoch, ids, held, difference = (np.frombuffer(one, kind) for one, kind in columns)
        R = len(held)
        self._names = tuple(packed["names"])
        self._met = Met(
            source.reshape(2, R).astype(np.intp),
            epoch.reshape(2, R).astype(np.uint64),
            ids.reshape(2, R).astype(np.uint64),
            held.astype(np.int64),
            difference.reshape(self._n, R).astype(np.float64),
        )
