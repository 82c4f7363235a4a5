"""The weights of earlier steps, for the next one to begin with.

Covariances change little from step to step, and so do the best weights of covariance intersection. Those that were last
used are kept while their own certificate says that the criterion could be smaller by .1 % at most (`ci.KEPT`); else
better ones are sought from there, a step or two of Newton's method, until it says .0001 % (`ci.NEARER`). Any weights
give a conservative result: nothing that the rule promises depends on them.

Of each global track that three rows or more feed, by source. Where other sources feed it than the last time (a row
failed its gate in a step, and is back in the next), the last weights of the same ones are found, else those of them
that had any, brought to a sum of 1: whatever numbers stand here are tried by the certificate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats, Ints, all_of, among, from_bytes, marked, same_ids, to_bytes
from fusion_service.records import columns_of

__all__ = ["STEPS", "Ids", "KeptWeights"]

Ids = NDArray[np.uint64]
FEWEST = 3
"""Of two rows the best weights are found at once."""
STEPS = 10
"""Steps for which weights are kept that are not used."""
ENOUGH = 0.5
"""Of the weights that the sources now had then, below which they tell nothing."""


@dataclass(frozen=True, slots=True)
class _Kept:
    """Of G global tracks that N rows fed: id (G,), source (N, G) by its number, weight (N, G), age (G,) in steps."""

    id: Ids
    source: NDArray[np.int64]
    weight: Floats
    age: NDArray[np.int64]

    def take(self, at: Any) -> _Kept:
        return _Kept(*(column[..., at] for column in columns_of(self)))

    def by_id(self) -> _Kept:
        """Sorted."""
        return self if all_of(self.id[1:] > self.id[:-1]) else self.take(np.argsort(self.id, kind="stable"))

    def join(self, *others: _Kept) -> _Kept:
        if not others:
            return self
        columns = zip(*map(columns_of, (self, *others)), strict=True)
        return _Kept(*(np.concatenate(column, axis=-1) for column in columns))


class KeptWeights:
    """The weights, by the number of rows."""

    def __init__(self) -> None:
        self._last: dict[int, _Kept] = {}
        self._next: dict[int, list[_Kept]] = {}

    def of(self, ids: Ids, sources: Ints) -> Floats | None:
        """The weights (N, B) of global tracks (B,) that rows of `sources` (N, B) feed, NaN where there are none; None
        where there are none at all."""
        if len(sources) < FEWEST or not self._last:
            return None
        kept = self._last.get(len(sources))
        if kept is not None and _same(kept.id, ids) and all_of(kept.source == sources):
            return kept.weight.copy()
        out = np.full(sources.shape, np.nan)
        for count in sorted(self._last, key=lambda count: (count != len(sources), -count)):
            todo = marked(np.isnan(out[0]))
            if not len(todo):
                break
            kept = self._last[count]
            at = np.minimum(np.searchsorted(kept.id, ids[todo]), len(kept.id) - 1)
            there = kept.id[at] == ids[todo]
            at, todo = at[there], todo[there]
            if count == len(sources):
                same = (kept.source[:, at] == sources[:, todo]).all(axis=0)
                out[:, todo[same]] = kept.weight[:, at[same]]
                at, todo = at[~same], todo[~same]
            out[:, todo] = _brought(kept.source[:, at], kept.weight[:, at], sources[:, todo])
        return out

    def note(self, ids: Ids, sources: Ints, weights: Floats) -> None:
        """Weights (N, B) that were used in this step."""
        good = marked(~np.isnan(weights[0]))
        if len(weights) >= FEWEST and len(good):
            new = _Kept(ids[good], sources[:, good].astype(np.int64), weights[:, good], np.zeros(len(good), np.int64))
            self._next.setdefault(len(weights), []).append(new)

    def turn(self) -> None:
        """A step is over: what was noted in it takes the place of what there was."""
        after = {count: parts[0].join(*parts[1:]) for count, parts in self._next.items()}
        for count, old in self._last.items():
            new = after.get(count)
            if new is not None and _same(old.id, new.id):
                continue
            stays = old.age < STEPS if new is None else (old.age < STEPS) & ~among(old.id, new.id)
            if stays.any():
                kept = old.take(stays)
                kept = _Kept(kept.id, kept.source, kept.weight, kept.age + 1)
                after[count] = kept if new is None else new.join(kept)
        self._last = {count: kept.by_id() for count, kept in sorted(after.items())}
        self._next = {}

    def packed(self) -> list[list[Any]]:
        """As plain values."""
        return [[count, *map(to_bytes, columns_of(kept))] for count, kept in sorted(self._last.items())]

    def restore(self, packed: list[list[Any]]) -> None:
        """From what `packed` gave."""
        whole = np.zeros(0, dtype=np.int64)
        for count, ids, sources, weights, age in packed:
            names = from_bytes(ids, np.zeros(0, dtype=np.uint64))
            shape = count, len(names)
            self._last[count] = _Kept(
                names, from_bytes(sources, whole).reshape(shape), from_bytes(weights, np.zeros(0)).reshape(shape),
                from_bytes(age, whole),
            )  # fmt: skip


def _same(one: Ids, other: Ids) -> bool:
    return same_ids(one, other)


def _brought(known: Ints, weights: Floats, sources: Ints) -> Floats:
    """Weights (M, B) of `sources` (M, B) from those (N, B) of the sources `known` (N, B), with sum 1; NaN where the
    sources now had too little of it."""
    out = np.zeros(sources.shape)
    for source, weight in zip(known, weights, strict=True):
        out += np.where(sources == source, weight, 0.0)
    total = np.zeros(sources.shape[1])
    for row in out:
        total = total + row
    return np.where(total > ENOUGH, out / np.where(total > ENOUGH, total, 1.0), np.nan)
