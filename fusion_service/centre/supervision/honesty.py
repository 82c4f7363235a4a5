"""Whether sources' covariances are right, from how their tracks of the same targets differ.

Of every pair of sources the normalised squares of the differences of their tracks are kept, for positions and for the
rest of the state apart, each pair of versions once, with what the covariances say unaltered; `hat` finds from their
scales by what factor each source's variances are too small. Their bounds allow for correlation in time: of differences
with a correlation rho from one to the next of a pair of tracks, only (1 - rho^2) / (1 + rho^2) count as independent
(the sum of squares of a first-order process), with rho measured and taken two of its own sigmas higher, and never fewer
than there are targets at one time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints, from_bytes, picked, to_bytes
from fusion_service.centre.partial import Unknown
from fusion_service.centre.rows import Rows
from fusion_service.centre.supervision.beside import Beside
from fusion_service.centre.supervision.deciding import (
    beyond,
    contradicted,
    mean_scale,
    pair_beyond,
    unexplained,
    with_innovations,
)  # fmt: skip
from fusion_service.centre.supervision.hat import Pairs, solved
from fusion_service.centre.supervision.scale import BINS, CUT, binned, high_bound, low_bound, robust_scale, sigmas
from fusion_service.centre.supervision.shared import Shared
from fusion_service.centre.supervision.sums import Sums
from fusion_service.centre.treatment import PLACES
from fusion_service.linalg import total

__all__ = ["BLOCKS", "Honesty", "Innovations", "Opinion"]

BLOCKS = ("positions", "velocities")
REMEMBERED = 600.0
"""Independent differences of a pair of sources that its sums hold about, or those of `SCANS` scans where it is more."""
SCANS = 30.0
LONGER = 10.0
"""How many times more at most, of differences that are correlated in time."""
MOST_SOURCE_PAIRS = 4096
MOST_NAMES = 2000
FEW = 3.0
"""Independent differences without which nothing is said of a pair."""
EXPLAINED = 0.05
"""Part of the scale of a pair's differences, from which a change of a correction makes them others."""
RECENT = 5.0
"""Steps that the recent mean is about."""
MENDED, FORGOTTEN = 0.4, 0.8
"""Part of a scale, below which the recent mean says that it is no more, and what is kept then, of what was before."""
CONSTANT = 0.5
"""Part of the mean square of a difference that is its mean squared, from which it is called constant."""

Innovations = Mapping[str, tuple[float, float]]
"""Of sources, by name: mean normalised square of their own innovations, and its degrees of freedom."""


@dataclass(frozen=True, slots=True)
class Opinion:
    """Of one source: how its tracks differ from those of others. consistency: mean normalised square of the difference
    of positions (NaN: none), with what it is within by chance; estimate: by what its variances are too small, for each
    of `BLOCKS`; factor: the same, 1 where nothing speaks against them; wrong: which of them are too small, beyond
    chance and `MATTERS`; decided: whether it is known that it is this source; contradiction: the largest scale of
    differences that are beyond chance, where it is not; compared: comparisons behind it; beside: whom with; constant:
    m by which its positions differ in the mean, where that is most of it, else 0; covers: the factor of positions is
    that of an error of clock or place, told and not taken off."""

    consistency: float = np.nan
    low: float = np.nan
    high: float = np.nan
    estimate: tuple[float, float] = (1.0, 1.0)
    factor: tuple[float, float] = (1.0, 1.0)
    wrong: tuple[bool, bool] = (False, False)
    decided: bool = True
    contradiction: float = 1.0
    compared: float = 0.0
    beside: tuple[str, ...] = ()
    constant: float = 0.0
    covers: bool = False


BASE = 2**20


class Honesty:
    """The differences of all pairs of sources, and what follows from them."""

    def __init__(self, space: tuple[str, ...]) -> None:
        self._space = space
        place = np.array([name in PLACES for name in space])
        self._blocks = (np.flatnonzero(place), np.flatnonzero(~place))
        self._unknown = Unknown.of(space)
        self._names: list[str] = []
        self._sums = Sums.none()
        self._factors = np.ones((2, 0))
        self._beside = Beside(len(space))

    def observe(self, rows: Rows, names: tuple[str, ...], shared: Shared, inflation: Floats) -> None:
        """Learn from the differences of a step. inflation (2, S): by what the covariances of the sources were
        multiplied, for each of `BLOCKS`."""
        first, second, held, last = self._beside.pairs(rows, names, shared)
        if rows.kin is not None and len(first):
            fine = ~(rows.kin.echo[first] | rows.kin.echo[second])
            first, second, held, last = first[fine], second[fine], held[fine], last[:, fine]
        number = self._numbers(names)
        key = number[rows.source[first]] * BASE + number[rows.source[second]]
        pair = self._places(key)
        fine = pair >= 0
        first, second, held, last, pair = first[fine], second[fine], held[fine], last[:, fine], pair[fine]
        difference = picked(rows.tracks.mean, first) - picked(rows.tracks.mean, second)
        known = self._unknown.known(rows.tracks.covariance)
        whitened = np.full_like(difference, np.nan)
        for block, index in enumerate(self._blocks):
            if not len(index):
                continue
            some = np.flatnonzero((known[index][:, first] & known[index][:, second]).all(axis=0))
            one, two = first[some], second[some]
            P, Q = (
                picked(rows.tracks.covariance[index[:, None], index[None], :], at) / inflation[block, rows.source[at]]
                for at in (one, two)
            )
            r = difference[index][:, some]
            u, share = _whitened(P, Q, r)
            self._count(block, len(index), pair[some], u, share, last[index][:, some], r if block == 0 else None)
            whitened[index[:, None], some] = u
        self._beside.keep(rows, first, second, held, whitened)

    def _count(
        self, block: int, k: int, pair: Ints, u: Floats, share: Floats, last: Floats, difference: Floats | None
    ) -> None:
        """Add the differences of a step: whitened u (k, R), shares (R,), the last ones (k, R), and, of positions,
        themselves (k, R)."""
        sums, K = self._sums, len(self._sums.key)
        square = total(u * u) / k
        good = np.isfinite(square) & np.isfinite(share)
        pair, u, share, last, square = pair[good], u[:, good], share[good], last[:, good], square[good]
        count = np.bincount(pair, minlength=K).astype(np.float64)
        rho = _correlation(sums.moved[:, block], sums.square[:, block], sums.moves[:, block], k, 0.0)
        most = np.maximum(REMEMBERED * np.minimum((1.0 + rho**2) / (1.0 - rho**2), LONGER), SCANS * count)
        weight = sums.weight[:, block]
        kept = np.where(count > 0, np.minimum(1.0, most / np.maximum(weight + count, 1.0)), 1.0)
        below, part = binned(square)
        flat = [
            np.bincount(pair * BINS + b, weights=w, minlength=K * BINS)
            for b, w in ((below, 1 - part), (below + 1, part))
        ]
        sums.histogram[:, block] = kept[:, None] * (sums.histogram[:, block] + (flat[0] + flat[1]).reshape(K, BINS))
        scale = robust_scale(sums.histogram[:, block], k)
        cut = CUT * 2.0 * scale[pair]
        product, both = total(u * last) / k, 0.5 * (square + total(last * last) / k)
        usual = np.isfinite(both) & (square < cut) & (both < cut)
        more = (
            ("weight", count),
            ("share", np.bincount(pair, weights=share, minlength=K)),
            ("updates", (count > 0).astype(np.float64)),
            ("moved", np.bincount(pair[usual], weights=product[usual], minlength=K)),
            ("square", np.bincount(pair[usual], weights=both[usual], minlength=K)),
            ("moves", np.bincount(pair[usual], minlength=K).astype(np.float64)),
        )
        for name, new in more:
            column = getattr(sums, name)
            column[:, block] = kept * (column[:, block] + new)
        self._mended(block, scale, count, np.bincount(pair, np.minimum(square, cut), K).astype(float))
        if difference is None:
            return
        usual = square < cut
        for axis, r in enumerate(difference[:3, good][:, usual]):
            for column, value in ((sums.offset, r), (sums.squared, r * r)):
                column[:, axis] = kept * (column[:, axis] + np.bincount(pair[usual], weights=value, minlength=K))

    def _mended(self, block: int, scale: Floats, count: Floats, square: Floats) -> None:
        """Forget soon what is no more: of pairs (K,) whose differences, `count` new ones with the sum `square`, have
        become far smaller than their `scale` says. What has been mended is to be seen before it fades by itself."""
        sums, there = self._sums, count > 0
        mean = square / np.maximum(count, 1.0)
        recent = sums.recent[:, block]
        begun = np.where(sums.updates[:, block] > 1.0, recent + (mean - recent) / RECENT, mean)
        sums.recent[:, block] = np.where(there, begun, recent)
        gone = np.flatnonzero(there & (scale > 1.0 / MENDED) & (sums.recent[:, block] < MENDED * scale))
        for name in ("histogram", "weight", "share", "updates", "moved", "square", "moves"):
            getattr(sums, name)[gone, block] *= FORGOTTEN
        if block == 0:
            for column in (sums.offset, sums.squared):
                column[gone] *= FORGOTTEN

    def _numbers(self, names: tuple[str, ...]) -> Ints:
        """The number that each source has here."""
        full = len(self._names) > MOST_NAMES or len(self._sums.key) >= MOST_SOURCE_PAIRS
        if full and not set(self._names) <= set(names):
            self._rename(sorted(set(self._names) & set(names)))
        place = {name: i for i, name in enumerate(self._names)}
        new = [name for name in names if name not in place]
        self._names += new
        place |= {name: len(place) + i for i, name in enumerate(new)}
        self._factors = np.concatenate([self._factors, np.ones((2, len(new)))], axis=1)
        return np.array([place[name] for name in names], dtype=np.intp)

    def _rename(self, kept: list[str]) -> None:
        """Forget all sources but these."""
        place = {name: i for i, name in enumerate(kept)}
        new = np.array([*(place.get(name, -1) for name in self._names), -1], dtype=np.intp)
        one, two = new[self._sums.key // BASE], new[self._sums.key % BASE]
        there = (one >= 0) & (two >= 0)
        sums = self._sums.take(there)
        sums.key = one[there] * BASE + two[there]
        self._sums = sums.take(np.argsort(sums.key, kind="stable"))
        self._factors = self._factors[:, [self._names.index(name) for name in kept]]
        self._names = kept

    def _places(self, key: Ints) -> Ints:
        """Where the sums of pairs with these keys (R,) are, made where there is room; -1 where there is none."""
        sums = self._sums
        new = np.setdiff1d(key, sums.key)[: MOST_SOURCE_PAIRS - len(sums.key)]
        if len(new):
            more = Sums.none(len(new))
            more.key = new
            sums = sums.join(more)
            self._sums = sums = sums.take(np.argsort(sums.key, kind="stable"))
        if not len(sums.key):
            return np.full(len(key), -1, dtype=np.intp)
        at = np.minimum(np.searchsorted(sums.key, key), len(sums.key) - 1)
        return np.where(sums.key[at] == key, at, -1)

    def opinions(self, chance: float, own: Innovations) -> dict[str, Opinion]:
        """What is to be thought of every source that was compared with others. chance: of a false alarm about one of
        them, at this look."""
        z = sigmas(chance / 2)
        sums, first, second = self._sums, self._sums.key // BASE, self._sums.key % BASE
        S = len(self._names)
        wrong, doubted = np.zeros((2, S), dtype=np.bool_), np.ones((2, S))
        consistency, count = np.full(S, np.nan), np.zeros(S)
        for block, index in enumerate(self._blocks):
            k = len(index)
            if not k or not len(first):
                continue
            pairs, some = self._pairs(block, k)
            enough = pairs.count >= FEW
            pairs, some = pairs.take(enough), some[enough]
            pairs, sure = with_innovations(pairs, S, self._innovations(own), z)
            found = solved(pairs, self._factors[block])
            self._factors[block] = found.value
            beside = pairs.first != pairs.second
            suspect = pair_beyond(pairs, z) & beside
            sure = sure & ~unexplained(pairs, found.value, suspect)
            wrong[block] = sure & beyond(found, z, contradicted(pairs, suspect, S))
            for side in (pairs.first, pairs.second):
                np.maximum.at(doubted[block], side[suspect], pairs.scale[suspect])
            doubted[block, sure] = 1.0
            if block == 0:
                consistency, count = mean_scale(pairs, S)
        return self._told(wrong, doubted, consistency, count, z, first, second, sums)

    def _told(
        self, wrong: Bools, doubted: Floats, consistency: Floats, count: Floats, z: float, first: Ints, second: Ints,
        sums: Sums,
    ) -> dict[str, Opinion]:  # fmt: skip
        k = max(len(self._blocks[0]), 1)
        low, high = low_bound(k * count, z), high_bound(k * count, z)
        told = {}
        either = wrong | (doubted > 1.0)
        for i in np.unique(np.concatenate([first, second])).tolist():
            mine = np.flatnonzero((first == i) | (second == i))
            compared = float(sums.weight[mine].max(axis=1).sum())
            estimate = float(self._factors[0, i]), float(self._factors[1, i])
            factor = [estimate[b] if wrong[b, i] else 1.0 for b in (0, 1)]
            told[self._names[i]] = Opinion(
                float(consistency[i]), float(low[i]), float(high[i]), estimate, (factor[0], factor[1]),
                (bool(either[0, i]), bool(either[1, i])), bool(wrong[:, i].any() or (doubted[:, i] == 1.0).all()),
                float(doubted[:, i].max()), compared,
                tuple(sorted(self._names[j] for j in np.where(first[mine] == i, second[mine], first[mine]).tolist())),
                self._constant(mine, np.where(first[mine] == i, 1.0, -1.0)),
            )  # fmt: skip
        return told

    def _constant(self, mine: Ints, sign: Floats) -> float:
        """Of pairs (K,), seen from one source: m by which it differs in the mean, 0 where that is not most of it."""
        offset = total(sign[:, None] * self._sums.offset[mine])
        squared, weight = float(self._sums.squared[mine].sum()), float(self._sums.weight[mine, 0].sum())
        size = float(total(offset * offset))
        return float(np.sqrt(size) / weight) if weight > 0 and size > CONSTANT * weight * squared else 0.0

    def _pairs(self, block: int, k: int) -> tuple[Pairs, Ints]:
        """The pairs with the scales of their differences, and how many of them count as independent."""
        sums = self._sums
        some = np.flatnonzero(sums.weight[:, block] > 0.0)
        weight, moves = sums.weight[some, block], sums.moves[some, block]
        rho = _correlation(sums.moved[some, block], sums.square[some, block], moves, k, 2.0)
        count = np.maximum(
            weight * (1.0 - rho**2) / (1.0 + rho**2), weight / np.maximum(sums.updates[some, block], 1.0)
        )
        key = sums.key[some]
        scale = robust_scale(sums.histogram[some, block], k)
        share = np.clip(sums.share[some, block] / weight, 0.0, 1.0)
        return Pairs(key // BASE, key % BASE, scale, share, count, k), some

    def _innovations(self, own: Innovations) -> list[tuple[int, float, float]]:
        place = {name: i for i, name in enumerate(self._names)}
        return [(place[name], *value) for name, value in sorted(own.items()) if name in place]

    def forget(self, size: Mapping[str, float]) -> None:
        """What these sources say is from now on another thing: it is corrected, or no more. size: mean square of what
        has changed, beside the errors that it says; pairs of which that is little of their differences are kept."""
        sums = self._sums
        by_number = np.array([size.get(name, 0.0) for name in self._names])
        weight = sums.weight[:, 0]
        share = np.clip(sums.share[:, 0] / np.where(weight > 0.0, weight, 1.0), 0.0, 1.0)
        first, second = sums.key // BASE, sums.key % BASE
        with np.errstate(invalid="ignore"):
            part = np.fmax(by_number[first] * share, by_number[second] * (1.0 - share))
        scale = robust_scale(sums.histogram[:, 0], max(len(self._blocks[0]), 1))
        self._sums = sums.take(part <= EXPLAINED * scale)

    def rebase(self) -> None:
        """A new era begins: tracks of before are not compared with those of after."""
        self._beside = Beside(len(self._space))

    def packed(self) -> dict[str, Any]:
        """As plain values."""
        columns = [to_bytes(getattr(self._sums, one.name)) for one in fields(Sums)]
        return {
            "space": list(self._space), "names": list(self._names), "count": len(self._sums.key), "sums": columns,
            "factors": to_bytes(self._factors), "beside": self._beside.packed(),
        }  # fmt: skip

    def restore(self, packed: Mapping[str, Any]) -> None:
        """From what `packed` gave; with nothing, if that was in another space."""
        if packed.get("space") != list(self._space):
            return
        empty = Sums.none(packed["count"])
        like = [getattr(empty, one.name) for one in fields(Sums)]
        self._sums = Sums(*(from_bytes(b, x).reshape(x.shape) for b, x in zip(packed["sums"], like, strict=True)))
        self._names = [str(name) for name in packed["names"]]
        self._factors = from_bytes(packed["factors"], self._factors).reshape(2, len(self._names))
        self._beside.restore(packed["beside"])


def _correlation(moved: Floats, square: Floats, moves: Floats, k: int, sigmas: float) -> Floats:
    """From one difference of a pair of tracks to the next, (K,): as measured, and so many of its sigmas more."""
    rho = np.maximum(moved / np.maximum(square, 1e-300), 0.0)
    return np.asarray(np.clip(rho + sigmas / np.sqrt(k * moves + 1.0), 0.0, 0.99))


def _whitened(P: Floats, Q: Floats, r: Floats) -> tuple[Floats, Floats]:
    """L^-1 r (k, R), L L' = P + Q, and the share (R,) of P in it, tr((P + Q)^-1 P) / k."""
    S = P + Q
    L, d = linalg.ldl(S)
    y = np.array(r)
    for row in range(1, len(y)):
        for column in range(row):
            y[row] -= L[row, column] * y[column]
    with np.errstate(all="ignore"):
        return y / np.sqrt(d), linalg.inner(linalg.inverse(S), P) / len(r)
