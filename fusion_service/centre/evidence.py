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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats, Ints
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.partial import Unknown
from fusion_service.centre.rows import Rows
from fusion_service.config import CentreConfig
from fusion_service.metrics import chi2_quantile

__all__ = ["LOW", "PairEvidence", "RivalLinks", "Tests", "chi2_by_size"]

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


def chi2_by_size(probability: float, n: int) -> Floats:
    """The chi-square quantile (n + 1,) by how many of n components are in common, 0 for none."""
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
        return np.clip((distance - keep) / (FAR * keep), 0.0, 1.0)

    def sameness(self, distance: Floats, size: Ints) -> Floats:
        """What a datum adds to the sum for a merge of two global tracks at d2 `distance`."""
        return np.clip(MERGE_SLOPE * (self.merge[size] - distance), -self.bound / 2, self.bound / 2)

    def weight(self, data: NDArray[np.integer]) -> Floats:
        """What a standing link weighs against an exchange, after so many data (M,)."""
        return np.asarray(self.bound * np.interp(data, *WEIGHT))


@dataclass(slots=True)
class PairEvidence:
    """Sums about pairs of global ids, for a merge: {(older, newer): (sum, newest datum of each when it was added)}.
    parted: those of them of which one was split from the other."""

    pairs: dict[tuple[int, int], tuple[float, int, int]] = field(default_factory=dict)
    parted: set[tuple[int, int]] = field(default_factory=set)

    def add(self, first: Ints, second: Ints, amount: Floats, picture: Picture, bound: float) -> None:
        """Add to the pairs of rows of the picture that are near now, where both have new data since the last time;
        every other pair is forgotten, but for those that were parted."""
        kept: dict[tuple[int, int], tuple[float, int, int]] = {}
        ids, seen = picture.id, picture.seen
        columns = (ids[first], ids[second], amount, seen[first], seen[second])
        for a, b, more, new_a, new_b in zip(*(column.tolist() for column in columns), strict=True):
            total, old_a, old_b = self.pairs.get((a, b), (0.0, -1, -1))
            if new_a > old_a and new_b > old_b:
                total = min(max(total + more, -bound), bound)
                old_a, old_b = new_a, new_b
            kept[a, b] = (total, old_a, old_b)
        there = set(ids.tolist()) if any(pair not in kept for pair in self.parted) else set()
        self.parted = {pair for pair in self.parted if pair in kept or there.issuperset(pair)}
        self.pairs = kept | {pair: self.pairs[pair] for pair in sorted(self.parted - kept.keys()) if pair in self.pairs}

    def part(self, old: int, new: int, bound: float) -> None:
        """`new` was split from `old`: to merge them again takes the way from the other end."""
        self.parted.add((old, new))
        self.pairs[old, new] = (-bound, -1, -1)

    def ripe(self, bound: float) -> list[tuple[int, int]]:
        """Pairs decided for a merge, most certain and then oldest first."""
        full = [(-total, pair) for pair, (total, _, _) in self.pairs.items() if total >= bound - 1e-9]
        return [pair for _, pair in sorted(full)]

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns: no datum is later."""
        self.pairs = {pair: (total, min(a, time), min(b, time)) for pair, (total, a, b) in self.pairs.items()}

    def forget(self, tracks: set[int]) -> None:
        """Drop the pairs of these global ids."""
        self.pairs = {pair: kept for pair, kept in self.pairs.items() if not tracks & set(pair)}
        self.parted = {pair for pair in self.parted if not tracks & set(pair)}

    def packed(self) -> list[Any]:
        """As plain values, in order."""
        return [[*pair, *kept, pair in self.parted] for pair, kept in sorted(self.pairs.items())]

    @classmethod
    def unpacked(cls, packed: list[Any]) -> PairEvidence:
        """From what `packed` gave."""
        made = cls()
        for a, b, total, first, second, parted in packed:
            made.pairs[int(a), int(b)] = (float(total), int(first), int(second))
            if parted:
                made.parted.add((int(a), int(b)))
        return made


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
