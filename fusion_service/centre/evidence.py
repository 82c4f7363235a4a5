"""When is it decided: sequential tests on new data, at the error rate that the config states.

For each standing link a sum of evidence, same target against another, is kept in [-A, A] with A = log(1 / rate) (Wald's
bound, both errors at the same rate; a sum that is held at its top is Page's test). A new datum adds, d2 being its
normalised distance to what the other sources say and q the chi-square quantile of `keep_gate`,

    min(slope (q - d2), A/4)  below q,     -A/2 min(1, ((d2 - q) / 3q)^2)  above it,

so that a constant bias of a few sigma never adds up to a break, however the errors of filters go together in time, and
a plain disagreement takes a quarter of the way from A to -A. A jump that no manoeuvre explains takes twice that. So a
link that has stood breaks after four plain disagreements or two jumps in a row, and never on one datum. Two global
tracks are merged when slope (q' - d2), summed over new data, reaches A, q' being the lower quantile `merge_gate`:
between the two lies the dead band in which a bias leaves things as they are.

Rival links are weighed by the likelihood ratio itself, half the difference of d2 + log det to the standing link,
summed over the row's new data with a memory of four reports and never below `-LOW`; of two mature links an exchange
needs `A` together, of young ones less. A link that was only just made breaks on one jump.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.partial import Unknown
from fusion_service.centre.rows import Rows
from fusion_service.config import CentreConfig
from fusion_service.metrics import chi2_quantile

__all__ = ["LOW", "PairEvidence", "RivalLinks", "Tests", "chi2_by_size"]

Ids = NDArray[np.uint64]
LOW = 12.0
"""Least sum of a rival: how much it must make good before it counts."""
SLOPE = 0.2
"""Of the sum of a standing link, per unit of d2 below the gate."""
FAR = 3.0
"""Gates beyond the gate at which a disagreement has its whole weight."""
MERGE_SLOPE = 0.3
WEIGHT = ((0, 10, 30), (0.0, 0.1, 0.5))
"""What a standing link weighs against an exchange, in units of A, after so many data: a young one next to nothing,
since the first pairing of a formation is mostly wrong; two mature ones A together."""


@lru_cache(maxsize=256)
def chi2_by_size(probability: float, n: int) -> Floats:
    """The chi-square quantile (n + 1,) by how many of n components are in common, 0 for none. Not to be written."""
    return np.array([0.0, *(chi2_quantile(probability, k) for k in range(1, n + 1))])


@dataclass(frozen=True, slots=True, eq=False)
class Tests:
    """The thresholds of a config: bound A of the sums; gate, keep and merge (n + 1,), d2 at the quantiles of the config
    by how many components are in common; unknown: which these are. A `size` (M,) is a number of them."""

    bound: float
    gate: Floats
    keep: Floats
    merge: Floats
    unknown: Unknown

    @classmethod
    def of(cls, config: CentreConfig) -> Tests:
        """Of a centre's settings."""
        n = len(config.space)
        gate, keep, merge = (chi2_by_size(p, n) for p in (config.gate, config.keep_gate, config.merge_gate))
        unknown = Unknown.of(config.space, config.unknown_speed, config.manoeuvre)
        return cls(float(-np.log(config.error_rate)), gate, keep, merge, unknown)

    def agreement(self, distance: Floats, size: Ints) -> Floats:
        """What a datum at d2 `distance` (M,) from the others adds to the sum of its link."""
        nearer = np.minimum(SLOPE * np.maximum(self.keep[size] - distance, 0.0), self.bound / 4)
        return nearer - self.bound / 2 * self._beyond(distance, size) ** 2

    def jump(self, distance: Floats, size: Ints) -> Floats:
        """What a datum at d2 `distance` (M,) beyond the gate of the prediction takes from the sum of its link."""
        return -self.bound * self._beyond(distance, size) ** 2

    def _beyond(self, distance: Floats, size: Ints) -> Floats:
        keep = self.keep[size]
        return np.minimum(np.maximum((distance - keep) / (FAR * keep), 0.0), 1.0)

    def sameness(self, distance: Floats, size: Ints) -> Floats:
        """What a datum adds to the sum for a merge of two global tracks at d2 `distance`."""
        return np.clip(MERGE_SLOPE * (self.merge[size] - distance), -self.bound / 2, self.bound / 2)

    def weight(self, data: NDArray[np.integer]) -> Floats:
        """What a standing link weighs against an exchange, after so many data (M,)."""
        return np.asarray(self.bound * np.interp(data, *WEIGHT))


class PairSums(NamedTuple):
    """K pairs (older, newer) of global ids, sorted: total, the sum; first, second: the newest datum of each when it was
    added, ns, -1: none; parted: one was split from the other."""

    older: Ids
    newer: Ids
    total: Floats
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    parted: Bools

    def take(self, some: Any) -> PairSums:
        """Those given."""
        return PairSums(*(column[some] for column in self))

    def join(self, other: PairSums) -> PairSums:
        """Both, sorted."""
        both = PairSums(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))
        return both.take(np.lexsort((both.newer, both.older)))

    @classmethod
    def of(cls, pairs: list[tuple[int, int, float, int, int, bool]]) -> PairSums:
        """From rows, sorted."""
        columns = list(zip(*pairs, strict=True)) or [()] * len(_KINDS)
        return cls(*(np.array(column, dtype=kind) for column, kind in zip(columns, _KINDS, strict=True)))


_KINDS = (np.uint64, np.uint64, np.float64, np.int64, np.int64, np.bool_)


@dataclass(slots=True)
class PairEvidence:
    """Sums about pairs of global ids, for a merge."""

    sums: PairSums = field(default_factory=lambda: PairSums.of([]))

    def add(self, first: Ints, second: Ints, amount: Floats, picture: Picture, bound: float) -> None:
        """Add to the pairs (first, second), in order, of rows of the picture that are near now, where both have new
        data since the last time; every other pair is forgotten, but for those that were parted, while both live."""
        old, ids, width = self.sums, picture.id, max(len(picture.id), 1)
        if not len(first) and not len(old.older):
            return
        at, to = (np.minimum(picture.find(one), width - 1) for one in (old.older, old.newer))
        alive = (ids[at] == old.older) & (ids[to] == old.newer) if len(ids) else np.zeros(len(at), dtype=np.bool_)
        old, known, asked = old.take(alive), at[alive] * width + to[alive], first * width + second
        place = np.minimum(np.searchsorted(known, asked), max(len(known) - 1, 0))
        there = known[place] == asked if len(known) else np.zeros(len(asked), dtype=np.bool_)
        total, new_a, new_b = np.zeros(len(asked)), picture.seen[first], picture.seen[second]
        old_a, old_b = np.full((2, len(asked)), -1, dtype=np.int64)
        parted = np.zeros(len(asked), dtype=np.bool_)
        for column, kept in ((total, old.total), (old_a, old.first), (old_b, old.second), (parted, old.parted)):
            column[there] = kept[place[there]]
        both = (new_a > old_a) & (new_b > old_b)
        total = np.where(both, np.clip(total + amount, -bound, bound), total)
        old_a, old_b = np.where(both, new_a, old_a), np.where(both, new_b, old_b)
        near = np.zeros(len(known), dtype=np.bool_)
        near[place[there]] = True
        self.sums = PairSums(ids[first], ids[second], total, old_a, old_b, parted).join(old.take(old.parted & ~near))

    def part(self, old: int, new: int, bound: float) -> None:
        """`new` was split from `old`: to merge them again takes the way from the other end."""
        others = self.sums.take((self.sums.older != np.uint64(old)) | (self.sums.newer != np.uint64(new)))
        self.sums = others.join(PairSums.of([(old, new, -bound, -1, -1, True)]))

    def ripe(self, bound: float) -> list[tuple[int, int]]:
        """Pairs decided for a merge, most certain and then oldest first."""
        full = self.sums.take(self.sums.total >= bound - 1e-9)
        full = full.take(np.lexsort((full.newer, full.older, -full.total)))
        return list(zip(full.older.tolist(), full.newer.tolist(), strict=True))

    def open(self, pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Those of these pairs of which the sum says no more that they are two than that they are one."""
        if not pairs:
            return []
        against = self.sums.take(self.sums.total < 0.0)
        two = set(zip(against.older.tolist(), against.newer.tolist(), strict=True))
        return [pair for pair in pairs if pair not in two]

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns: no datum is later."""
        first, second = np.minimum(self.sums.first, time), np.minimum(self.sums.second, time)
        self.sums = self.sums._replace(first=first, second=second)

    def forget(self, tracks: set[int]) -> None:
        """Drop the pairs of these global ids."""
        if tracks:
            gone = np.array(sorted(tracks), dtype=np.uint64)
            self.sums = self.sums.take(~(np.isin(self.sums.older, gone) | np.isin(self.sums.newer, gone)))

    def packed(self) -> list[Any]:
        """As plain values, in order."""
        return list(zip(*(column.tolist() for column in self.sums), strict=True))

    @classmethod
    def unpacked(cls, packed: list[Any]) -> PairEvidence:
        """From what `packed` gave."""
        return cls(PairSums.of([tuple(one) for one in packed]))


@dataclass(slots=True)
class RivalLinks:
    """The sums of links that rival the standing ones, by source: local id, global id and sum, each (K,), in the order
    of (local id, global id)."""

    by_source: dict[str, tuple[NDArray[np.uint64], NDArray[np.uint64], Floats]] = field(default_factory=dict)

    def sums(self, rows: Rows, picture: Picture, row: Ints, track: Ints) -> Floats:
        """The sum so far of each pair (row of `rows`, row of `picture`), 0 where there is none. Pairs are in order."""
        known_row, known_track, value = self.known(rows, picture)
        width = max(len(picture.id), 1)
        known, asked = known_row * width + known_track, row * width + track
        at = np.minimum(np.searchsorted(known, asked), max(len(known) - 1, 0))
        return np.where(known[at] == asked, value[at], 0.0) if len(known) else np.zeros(len(asked))

    def known(self, rows: Rows, picture: Picture) -> tuple[Ints, Ints, Floats]:
        """All sums as (row, track, sum), in order; those of rows or tracks that are gone are left out."""
        parts: list[tuple[Ints, Ints, Floats]] = []
        start = 0
        for name, count in rows.kept.items():
            ids, tracks, value = self.by_source.get(name, (None, None, None))
            if ids is not None and tracks is not None and value is not None and count and len(picture.id):
                own = rows.tracks.id[start : start + count]
                at = np.minimum(np.searchsorted(own, ids), count - 1)
                to = np.minimum(np.searchsorted(picture.id, tracks), len(picture.id) - 1)
                there = (own[at] == ids) & (picture.id[to] == tracks)
                parts.append((start + at[there], to[there], value[there]))
            start += count
        if not parts:
            none = np.zeros(0, dtype=np.intp)
            return none, none, np.zeros(0)
        return (
            np.concatenate([part[0] for part in parts]),
            np.concatenate([part[1] for part in parts]),
            np.concatenate([part[2] for part in parts]),
        )

    def keep(self, rows: Rows, picture: Picture, row: Ints, track: Ints, value: Floats) -> None:
        """These sums, and no others, from now on. Pairs are in order."""
        self.by_source = {}
        start = 0
        for name, count in rows.kept.items():
            first, last = np.searchsorted(row, [start, start + count])
            if last > first:
                part = slice(first, last)
                self.by_source[name] = (rows.tracks.id[row[part]], picture.id[track[part]], value[part])
            start += count

    def packed(self) -> list[Any]:
        """As plain values, in order."""
        return [
            [name, *(np.ascontiguousarray(part, part.dtype.newbyteorder("<")).tobytes() for part in parts)]
            for name, parts in sorted(self.by_source.items())
        ]

    @classmethod
    def unpacked(cls, packed: list[Any]) -> RivalLinks:
        """From what `packed` gave."""
        made = cls()
        for name, ids, tracks, value in packed:
            made.by_source[str(name)] = (
                np.frombuffer(ids, "<u8").astype(np.uint64),
                np.frombuffer(tracks, "<u8").astype(np.uint64),
                np.frombuffer(value, "<f8").astype(np.float64),
            )
        return made
