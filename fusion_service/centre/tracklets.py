"""`memory = "tracklet"`: a filter of the target's own that takes what successive versions of its local tracks add.

Each global track that capable rows feed (`memory` says which) has a filter, which begins with what the rule made of
its rows at birth. A version of a capable row is an equivalent measurement (`increments`) at its own time. What is no
such measurement enters as a whole, by covariance intersection with the filter at the step: a row that has just joined,
a version whose increment is not sound or comes too late, every new version of a row that is not capable. That is
conservative whatever it shares with the filter, and what comes after is independent of it again.

Operations are done in order of their time, not of their arrival. A source whose messages come after the step that
they belong to (`Source.lag`) is waited for: the filter is kept as it was before the time that is still open (`base`),
with the operations since, and in each step runs through these again.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints, among, from_bytes, to_bytes
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.motions import Motions, States
from fusion_service.records import altered, columns_of
from fusion_service.rules import fuse_last

__all__ = ["Filters", "Operations", "closed", "run"]

MOST_OPEN = 256
"""Operations of a filter that are done again in the next step, at most: beyond, the time of the oldest is closed."""


@dataclass(frozen=True, slots=True, eq=False)
class Operations:
    """K operations on filters: track u64 global id; time i64 ns; source (index into the sorted names) and id u64 of the
    row; whole: an estimate, with its covariance (n, n, K) in `matrix` and its mean (n, K) in `mean`; else an increment,
    its information in `matrix`, its vector in `vector`, and x_- in `mean` (see `increments`). row: of the step in which
    it is new, else -1."""

    track: NDArray[np.uint64]
    time: NDArray[np.int64]
    source: NDArray[np.int64]
    id: NDArray[np.uint64]
    whole: Bools
    mean: Floats
    vector: Floats
    matrix: Floats
    row: Ints

    @classmethod
    def none(cls, n: int) -> Operations:
        """No operations."""
        whole, ids = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.uint64)
        vectors = np.zeros((n, 0))
        return cls(ids, whole, whole, ids, np.zeros(0, np.bool_), vectors, vectors, np.zeros((n, n, 0)), whole)

    def take(self, at: Any) -> Operations:
        """The given ones (indices or a mask)."""
        return Operations(*(column[..., at] for column in columns_of(self)))

    def join(self, *others: Operations) -> Operations:
        """All of them, in order."""
        parts = [one for one in (self, *others) if len(one.track)]
        if not parts:
            return self
        if len(parts) > 1:
            columns = ([getattr(part, one.name) for part in parts] for one in fields(Operations))
            parts = [Operations(*(np.concatenate(column, axis=-1) for column in columns))]
        (whole,) = parts
        return whole.take(np.lexsort((whole.id, whole.source, whole.whole, whole.time, whole.track)))


@dataclass(slots=True)
class Filters:
    """What is kept between steps. names: that `pending.source` indexes; id (F,) sorted, and base (F): the filters as
    they were before the time that is still open; pending: the operations since."""

    names: tuple[str, ...]
    id: NDArray[np.uint64]
    base: States
    pending: Operations

    @classmethod
    def none(cls, n: int) -> Filters:
        """No filters."""
        never, code = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int32)
        base = States.of(never, np.zeros((n, 0)), np.zeros((n, n, 0)), code)
        return cls((), np.zeros(0, dtype=np.uint64), base, Operations.none(n))

    def rename(self, names: tuple[str, ...]) -> None:
        """Index other names from now on, of which these are some or all; both sorted."""
        if names != self.names:
            where = {name: at for at, name in enumerate(names)}
            new = np.array([where.get(name, -1) for name in self.names] or [-1], dtype=np.int64)
            if len(self.pending.source):
                source = new[self.pending.source]
                self.pending = altered(self.pending, source=source).take(source >= 0)
            self.names = names

    def bases(self, before: Picture) -> States:
        """The states that the picture's filters go on from; `before`: the picture as it was after the last step."""
        base = States.of(before.time.copy(), before.mean.copy(), before.covariance.copy(), before.motion)
        known = among(before.id, self.id)
        at = np.searchsorted(self.id, before.id[known])
        base.time[known] = self.base.time[at]
        base.mean[:, known], base.covariance[:, :, known] = self.base.mean[:, at], self.base.covariance[:, :, at]
        return base

    def packed(self) -> list[Any]:
        """As plain values: names, then columns."""
        base = (self.id, self.base.time, self.base.mean, self.base.covariance, self.base.motion)
        whole = self.pending
        columns = [*base, *(getattr(whole, one.name) for one in fields(whole))]
        return [len(self.base.mean), list(self.names), *(to_bytes(column) for column in columns)]

    @classmethod
    def unpacked(cls, packed: list[Any], n: int) -> Filters:
        """From what `packed` gave; none where the states have not n components."""
        none = cls.none(n)
        if packed[0] != n:
            return none
        like: list[Any] = [none.id, none.base.time, none.base.mean, none.base.covariance, none.base.motion]
        like += [getattr(none.pending, one.name) for one in fields(Operations)]
        columns: list[Any] = [
            from_bytes(part, one).reshape(*one.shape[:-1], -1) for part, one in zip(packed[2:], like, strict=True)
        ]
        return cls(tuple(packed[1]), columns[0], States.of(*columns[1:5]), Operations(*columns[5:]))

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns: nothing is later."""
        np.minimum(self.base.time, time, out=self.base.time)
        np.minimum(self.pending.time, time, out=self.pending.time)


def closed(cut: NDArray[np.int64], at: Ints, times: NDArray[np.int64]) -> NDArray[np.int64]:
    """Up to when (G,) nothing more is waited for: `cut`, or later where too much would be done again. at (K,): the
    state of each operation, in order of (at, `times` (K,))."""
    beyond = np.cumsum(np.bincount(at, minlength=len(cut))) - MOST_OPEN - 1
    cut, many = cut.copy(), np.bincount(at, minlength=len(cut)) > MOST_OPEN
    cut[many] = np.maximum(cut[many], times[beyond[many]])
    return cut


def run(
    base: States, at: Ints, operations: Operations, cut: NDArray[np.int64], time: int, motions: Motions
) -> tuple[States, States, Floats, Floats]:  # fmt: skip
    """Every filter's state at `time`, ns, its base for the next step, that is after all operations up to `cut` (G,),
    the share (K,) of each operation, trace(K)/n of its gain, and the innovation of each increment beside its filter
    and what it was to be expected to be (2, K).

    With s = vector + dY (x_- - m), whose covariance is S = dY + dY P dY if the increment is independent of the filter,
    E s'Ps = tr PS, with variance 2 tr (PS)^2: both are scaled so that the variance is twice the expectation.

    base (G,); at (K,): which state each operation is for; these in order of (at, time), and none before its base.
    """
    share, beside = np.zeros(len(at)), np.zeros((2, len(at)))
    if len(at):
        now = States.of(base.time.copy(), base.mean.copy(), base.covariance.copy(), base.motion)
        kept = States.of(base.time.copy(), base.mean.copy(), base.covariance.copy(), base.motion)
        begins = np.append(True, (at[1:] != at[:-1]) | (operations.time[1:] != operations.time[:-1]))
        first = np.flatnonzero(begins)
        size = np.diff(np.append(first, len(at)))
        new_track = np.append(True, at[first][1:] != at[first][:-1])
        turn = np.arange(len(first)) - np.maximum.accumulate(np.where(new_track, np.arange(len(first)), 0))
        for number in range(int(turn.max()) + 1):
            some = np.flatnonzero(turn == number)
            which = at[first[some]]
            state = _at(now.take(which), operations.time[first[some]], motions)
            state = _updated(state, first[some], size[some], operations, share, beside)
            _put(now, which, state)
            done = operations.time[first[some]] <= cut[which]
            _put(kept, which[done], state.take(done))
    else:
        now = kept = base
    return _at(now, np.full(len(now.time), time, dtype=np.int64), motions), kept, share, beside


def _put(into: States, at: Ints, states: States) -> None:
    into.time[at], into.mean[:, at], into.covariance[:, :, at] = states.time, states.mean, states.covariance


def _at(states: States, time: NDArray[np.int64], motions: Motions) -> States:
    """The states predicted to times that are not before theirs."""
    return altered(motions.moved(states, states.motion, np.maximum(time - states.time, 0) / 1e9), time=time)


def _updated(
    states: States,
    first: Ints,
    size: Ints,
    operations: Operations,
    share: Floats,
    beside: Floats,
) -> States:
    """States after operations of one time: those of state k are the `size[k]` from `first[k]` on, increments before
    whole estimates. Writes the shares, and the innovations `beside` the states."""
    mean, covariance = states.mean.copy(), states.covariance.copy()
    n = len(mean)
    added = np.zeros_like(covariance)
    pull = np.zeros_like(mean)
    for j in range(int(size.max(initial=0))):
        some = np.flatnonzero(size > j)
        some = some[~operations.whole[first[some] + j]]
        which = first[some] + j
        matrix = operations.matrix[:, :, which]
        added[:, :, some] += matrix
        away = operations.mean[:, which] - mean[:, some]
        innovation = operations.vector[:, which] + linalg.matvec(matrix, away)
        pull[:, some] += innovation
        beside[:, which] = _beside(covariance[:, :, some], matrix, innovation)
    with np.errstate(all="ignore"):
        spread = linalg.inverse(linalg.inverse(covariance) + added)
        moved = mean + linalg.matvec(spread, pull)
        good = linalg.is_positive_definite(spread) & np.isfinite(moved).all(axis=0)
    mean, covariance = np.where(good, moved, mean), np.where(good, spread, covariance)
    for j in range(int(size.max(initial=0))):
        some = np.flatnonzero(size > j)
        which = first[some] + j
        whole = operations.whole[which]
        inside = some[~whole]
        share[which[~whole]] = linalg.inner(covariance[:, :, inside], operations.matrix[:, :, which[~whole]]) / n
        some, which = some[whole], which[whole]
        if len(some):
            _intersect(mean, covariance, some, which, operations, share)
    return altered(states, mean=mean, covariance=covariance)


def _beside(covariance: Floats, matrix: Floats, innovation: Floats) -> Floats:
    with np.errstate(all="ignore"):
        gain = linalg.product(covariance, matrix)
        spread = gain + linalg.product(gain, gain)
        expected = linalg.trace(spread)
        scale = expected / linalg.total(linalg.total(spread * spread.swapaxes(0, 1)))
        found = linalg.total(innovation * linalg.matvec(covariance, innovation))
        out = np.stack([found * scale, expected * scale])
        return np.where(np.isfinite(out).all(axis=0) & (out[1] > 0), out, 0.0)


def _intersect(
    mean: Floats, covariance: Floats, some: Ints, which: Ints, operations: Operations, share: Floats,
) -> None:  # fmt: skip
    """Fuse the states `some` with the whole estimates `which`, whatever they share."""
    fused = fuse_last(
        "ci",
        np.stack([mean[:, some], operations.mean[:, which]]),
        np.stack([covariance[:, :, some], operations.matrix[:, :, which]]),
        influence=True,
    )
    good = linalg.is_positive_definite(fused.covariance) & np.isfinite(fused.mean).all(axis=0)
    at = some[good]
    mean[:, at], covariance[:, :, at] = fused.mean[:, good], fused.covariance[:, :, good]
    assert fused.influence is not None
    share[which[good]] = fused.influence[1, good]
