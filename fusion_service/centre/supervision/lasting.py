"""How much less successive data of a source tell than they seem to: its errors last, and may be larger than it says.

Information is divided, for each source, by the ratio of the variance of a long mean of its errors to that of a mean of
as many independent ones of the size that it claims. That ratio is measured. With q_k the whitened residual of a row
beside the others of its target, of two successive blocks of N data with sums Q1 and Q2,

    t = (|Q1|^2 + |Q2|^2 + 4 Q1'Q2) / (4 N)

has the expectation of that ratio but for terms that fall off with N as the autocorrelation does (twice the mean square
of the sum of 2 N less that of N: what the ends of a block miss cancels). A row counts by its share in the variance of
its residual, so that what is found is put down to the source that it comes from. Until blocks are full, the mean square
of residuals and the autocorrelation phi of successive ones stand for it: E |q|^2 / 2 (1 + phi) / (1 - phi).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Floats, Ints, from_bytes, to_bytes
from fusion_service.centre.supervision.estimate import Group, inverse_2x2

__all__ = ["Followed", "Lasting", "match_rows", "robust"]

BLOCK = 16
"""Data of a row."""
FIRST_PHI, FIRST_DATA = 0.6, 25.0
"""Autocorrelation that is supposed, and from how many data."""
FIRST_BLOCKS = 10.0
LEAST, MOST = 0.05, 1e4
REMEMBERED = 500.0
"""Blocks that a ratio is made of at most; older ones fade."""
MOST_FOLLOWED = 10_000
FAR = 16.0
"""d2 of a residual beyond which a row counts less."""


class Followed:
    """Columns of the rows that are followed: source (R,) index into the names of the estimate, id u64, updated i64 of
    the version last used, last (2, R) residual, block (2, 2, R) sums of two blocks, data (R,) in them."""

    def __init__(self, columns: list[NDArray[Any]] | None = None) -> None:
        none = np.zeros(0, dtype=np.int64)
        whole = columns or [none, none.astype(np.uint64), none, np.zeros((2, 0)), np.zeros((2, 2, 0)), none]
        self.source, self.id, self.updated, self.last, self.block, self.data = whole

    def columns(self) -> list[NDArray[Any]]:
        """All of them."""
        return [self.source, self.id, self.updated, self.last, self.block, self.data]

    def take(self, at: Any) -> Followed:
        """The given rows."""
        return Followed([column[..., at] for column in self.columns()])


class Lasting:
    """Of the sources of an estimate (S,): first, second, count: sums of |q|^2 and of products of successive q, and how
    many; found, blocks: sum of ratios, weighted, and of weights."""

    def __init__(self, count: int = 0) -> None:
        self.first, self.second, self.count = np.zeros(count), np.zeros(count), np.zeros(count)
        self.found, self.blocks = np.zeros(count), np.zeros(count)
        self.rows = Followed()

    @property
    def ratio(self) -> Floats:
        """(S,): by what the information of each is divided."""
        phi = (self.second + 2.0 * FIRST_PHI * FIRST_DATA) / (self.first + 2.0 * FIRST_DATA)
        phi = np.clip(phi, 0.0, 0.95)
        level = (self.first + 2.0 * FIRST_DATA) / (2.0 * (self.count + FIRST_DATA))
        supposed = level * (1.0 + phi) / (1.0 - phi)
        return np.clip((self.found + FIRST_BLOCKS * supposed) / (self.blocks + FIRST_BLOCKS), LEAST, MOST)

    def arrange(self, to: Ints, count: int) -> None:
        """Sources move: that at k is at to[k] now, or gone (-1)."""
        stays = np.flatnonzero(to >= 0)
        for name in ("first", "second", "count", "found", "blocks"):
            new = np.zeros(count)
            new[to[stays]] = getattr(self, name)[stays]
            setattr(self, name, new)
        source = to[self.rows.source] if len(to) else np.zeros(0, dtype=np.int64)
        rows = self.rows.take(source >= 0)
        rows.source = source[source >= 0]
        self.rows = rows.take(np.lexsort((rows.id, rows.source)))

    def forget(self, at: int) -> None:
        """A new run of the source `at` begins: its rows are others."""
        self.rows = self.rows.take(self.rows.source != at)

    def unused(self, source: Ints, ids: NDArray[np.uint64], updated: NDArray[np.int64]) -> Bools:
        """Which of these rows (M,) are versions that were not used yet."""
        at = match_rows(self.rows, source, ids)
        known = at >= 0
        out = np.ones(len(source), dtype=np.bool_)
        out[known] = updated[known] > self.rows.updated[at[known]]
        return out

    def learn(
        self, group: Group, ids: NDArray[np.uint64], updated: NDArray[np.int64], residual: Floats, certain: Bools
    ) -> None:
        """Take the residuals z - H theta (2, M) of the rows of one step; certain (M,): of these the estimate itself
        adds nothing that matters to them."""
        q, share = _beside(group, residual)
        before = self.rows
        at = match_rows(before, group.source, ids)
        known, count = at >= 0, len(ids)
        last, block, data = np.zeros((2, count)), np.zeros((2, 2, count)), np.zeros(count, dtype=np.int64)
        last[:, known], block[..., known] = before.last[:, at[known]], before.block[..., at[known]]
        data[known] = before.data[at[known]]
        had = known & certain
        ratio, size = self.ratio, len(self.first)
        scale = ratio[group.source[had]]
        squares, products = (q**2).sum(axis=0)[had] * scale, (q * last).sum(axis=0)[had] * scale
        self.first += np.bincount(group.source[had], squares.clip(0, 50), minlength=size)
        self.second += np.bincount(group.source[had], products.clip(-50, 50), minlength=size)
        self.count += np.bincount(group.source[had], minlength=size)
        kept = np.minimum(1.0, 2.0 * BLOCK * REMEMBERED / np.maximum(self.count, 1.0))
        self.first, self.second, self.count = kept * self.first, kept * self.second, kept * self.count
        data = np.where(certain, data + 1, 0)
        half = np.where(data > BLOCK, 1, 0)
        block[:, half, np.arange(count)] += q
        block[..., ~certain] = 0.0
        full = data >= 2 * BLOCK
        one, two = block[:, 0, full], block[:, 1, full]
        found = ((one**2).sum(axis=0) + (two**2).sum(axis=0) + 4.0 * (one * two).sum(axis=0)) / (4.0 * BLOCK)
        whose, part = group.source[full], share[full]
        self.found += np.bincount(whose, part * ratio[whose] * found, minlength=size)
        self.blocks += np.bincount(whose, part, minlength=size)
        kept = np.minimum(1.0, REMEMBERED / np.maximum(self.blocks, 1.0))
        self.found, self.blocks = kept * self.found, kept * self.blocks
        data[full], block[..., full] = 0, 0.0
        self._keep(at, Followed([group.source.astype(np.int64), ids, updated, q, block, data]))

    def _keep(self, at: Ints, new: Followed) -> None:
        rest = np.ones(len(self.rows.id), dtype=np.bool_)
        rest[at[at >= 0]] = False
        old = self.rows.take(rest)
        if len(old.id) + len(new.id) > MOST_FOLLOWED:
            recent = np.argsort(-old.updated, kind="stable")[: max(MOST_FOLLOWED - len(new.id), 0)]
            old = old.take(np.sort(recent))
        joined = Followed([np.concatenate(both, axis=-1) for both in zip(old.columns(), new.columns(), strict=True)])
        self.rows = joined.take(np.lexsort((joined.id, joined.source)))

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns."""
        self.rows.updated = np.minimum(self.rows.updated, time)

    def packed(self) -> list[bytes]:
        """As plain values."""
        sums = self.first, self.second, self.count, self.found, self.blocks
        return [to_bytes(one) for one in (*sums, *self.rows.columns())]

    @classmethod
    def unpacked(cls, packed: list[bytes]) -> Lasting:
        """From what `packed` gave."""
        made = cls()
        parts = [from_bytes(part, made.first) for part in packed[:5]]
        made.first, made.second, made.count, made.found, made.blocks = parts
        like = made.rows.columns()
        columns = [
            from_bytes(part, one).reshape(*one.shape[:-1], -1) for part, one in zip(packed[5:], like, strict=True)
        ]
        made.rows = Followed(columns)
        return made


def robust(group: Group, residual: Floats, factor: Floats) -> Group:
    """The group, its weights by `factor` (M,), and less where a row's residual (2, M) is beyond `FAR` of the others."""
    scaled = replace(group, weight=group.weight * factor)
    q, _ = _beside(scaled, residual)
    square = (q**2).sum(axis=0)
    return replace(group, weight=scaled.weight * np.where(square > FAR, FAR / np.maximum(square, FAR), 1.0))


def _beside(group: Group, residual: Floats) -> tuple[Floats, Floats]:
    """Whitened residuals (2, M) of rows beside the others of their targets, and the share (M,) of each in the variance
    of its own."""
    weighed = np.stack([group.weight[k, 0] * residual[0] + group.weight[k, 1] * residual[1] for k in (0, 1)])
    rest = group.total(group.weight)[..., group.group] - group.weight
    spread = inverse_2x2(rest)
    away = group.total(weighed)[:, group.group] - weighed
    others = np.stack([spread[k, 0] * away[0] + spread[k, 1] * away[1] for k in (0, 1)])
    own = inverse_2x2(group.weight)
    S = own + spread
    u = residual - others
    a = np.sqrt(np.maximum(S[0, 0], 1e-300))
    b = S[1, 0] / a
    c = np.sqrt(np.maximum(S[1, 1] - b**2, 1e-300))
    q0 = u[0] / a
    inverse = inverse_2x2(S)
    share = 0.5 * sum(own[i, j] * inverse[j, i] for i in (0, 1) for j in (0, 1))
    return np.stack([q0, (u[1] - b * q0) / c]), np.clip(np.asarray(share), 0.0, 1.0)


def match_rows(rows: Followed, source: Ints, ids: NDArray[np.uint64]) -> Ints:
    """Where the rows (source, id) are among those followed; -1 for none."""
    count, size = len(ids), len(rows.id)
    if not size or not count:
        return np.full(count, -1, dtype=np.intp)
    key_source = np.concatenate([rows.source, source])
    key_id = np.concatenate([rows.id, ids])
    order = np.lexsort((np.arange(size + count), key_id, key_source))
    same = (key_source[order][1:] == key_source[order][:-1]) & (key_id[order][1:] == key_id[order][:-1])
    out = np.full(count, -1, dtype=np.intp)
    first, second = order[:-1][same], order[1:][same]
    there = (first < size) & (second >= size)
    out[second[there] - size] = first[there]
    return out
