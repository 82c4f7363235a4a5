"""How the tracks of an intensity follow its components: how many stand on each, which, and how each of them lives.

A component of weight w stands for w targets on the average. How many tracks it carries is decided by evidence, not
anew in every step. Where the expected number is w = n + x, 0 <= x < 1, the two numbers with that mean, n and n + 1,
have the odds x / (1 - x). From n tracks the log odds of one more, less `UNDECIDED`, are summed over new data, from 0
up (Page's cumulative sum with the allowance UNDECIDED); from ln((1 - e) / e) on, e the rate of error in the config, it
is one more. The same downwards. So a weight that moves between n + 0.4 and n + 0.6 never changes anything, one that
stays at n + 0.9 changes the number at the second datum, and n + 1 at once. Where no track was, it is round(w).

Lives go by data. A report is evidence in the step that first uses it, and never again: a step without new data of any
source that supports a track, or would if it saw it, changes no count of its life.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.config import CentreConfig
from schemas.messages import COASTING, CONFIRMED, TENTATIVE

__all__ = ["HOLD", "Memory", "assign", "carried", "live", "next_number", "ranked"]


UNDECIDED = float(np.log(0.6 / 0.4))
"""Log odds within which a weight speaks for neither number."""
HOLD = 0.25
"""By rank: how much weight a standing second or further track of a component is worth more than a new one."""


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """What is remembered of G tracks beside the picture, sorted by id (G,) u64: hits u64, the last chances as bits;
    supported i64, time of the last step with support, ns; held: it stood on a component in the last step; shared: with
    others; lean: the evidence for one more (positive) or one less there."""

    id: NDArray[np.uint64]
    hits: NDArray[np.uint64]
    supported: NDArray[np.int64]
    held: Bools
    shared: Bools
    lean: Floats

    @classmethod
    def blank(cls, ids: NDArray[np.uint64], time: int) -> Memory:
        """Of tracks that nothing is known of."""
        count = len(ids)
        none, never = np.zeros(count, dtype=np.uint64), np.zeros(count, dtype=np.bool_)
        return cls(ids, none, np.full(count, time, dtype=np.int64), never, never, np.zeros(count))

    def of(self, ids: NDArray[np.uint64], time: int) -> Memory:
        """That of these tracks, sorted; blank of those that are not here."""
        out = Memory.blank(ids, time)
        known = np.isin(ids, self.id)
        at = np.searchsorted(self.id, ids[known])
        values = {}
        for one in fields(self)[1:]:
            column = getattr(out, one.name).copy()
            column[known] = getattr(self, one.name)[at]
            values[one.name] = column
        return replace(out, **values)

    def pack(self) -> dict[str, list[Any]]:
        """Plain values, for a checkpoint."""
        return {one.name: getattr(self, one.name).tolist() for one in fields(self)}

    @classmethod
    def unpack(cls, packed: Mapping[str, Any]) -> Memory:
        """The inverse of `pack`. `ValueError`, `KeyError`, `TypeError` or `OverflowError` if it is none."""
        like = cls.blank(np.zeros(0, dtype=np.uint64), 0)
        columns = [np.array(packed[one.name], dtype=getattr(like, one.name).dtype) for one in fields(cls)]
        if any(column.shape != columns[0].shape or column.ndim != 1 for column in columns):
            raise ValueError("columns of different lengths")
        return cls(*columns)


def next_number(number: Ints, lean: Floats, weight: Floats, error: float) -> tuple[Ints, Floats]:
    """Numbers of tracks (C,) and the evidence (C,) after a new datum that expects `weight` (C,), at the rate of error
    `error`."""
    settled = np.where(weight >= number + 1, np.floor(weight), np.where(weight <= number - 1, np.ceil(weight), number))
    lean, number = np.where(settled == number, lean, 0.0), settled.astype(np.intp)
    x = weight - number
    size, side = np.abs(x), np.sign(x)
    with np.errstate(divide="ignore"):
        odds = np.log(size) - np.log1p(-size)
    gain = np.sign(odds) * np.maximum(np.abs(odds) - UNDECIDED, 0.0)
    total = np.maximum(0.0, np.where(np.sign(lean) == side, np.abs(lean), 0.0) + gain)
    over = total >= np.log((1.0 - error) / error)
    return number + np.where(over, side, 0).astype(np.intp), np.where(over, 0.0, side * total)


def assign(i: Ints, j: Ints, cost: Floats, memory: Memory, weight: Floats) -> Ints:
    """The component (G,) of each track, -1 for none, from pairs (track i, component j), cheapest first.

    A component takes round(w) tracks, one at least; those that shared one before may stay with it while it is not
    sure that they are fewer, ceil(w) at most.
    """
    room = np.maximum(1, np.floor(weight + 0.5)).astype(np.intp)
    place = _matched(i, j, cost, len(memory.id), room)
    taken = np.bincount(place[place >= 0], minlength=len(weight))
    left = np.maximum(np.ceil(weight).astype(np.intp) - taken, 0)
    more = (place[i] < 0) & memory.shared[i] & (left[j] > 0)
    again = _matched(i[more], j[more], cost[more], len(memory.id), left)
    return np.where(place < 0, again, place)


def _matched(i: Ints, j: Ints, cost: Floats, tracks: int, room: Ints) -> Ints:
    """The one of C components, with `room` (C,) each, that each track gets when pairs are taken in order of cost.

    By deferred acceptance: every track asks for its cheapest, every component refuses those beyond its room, and both
    rank by the same cost, so that it ends where taking pair by pair would.
    """
    order = np.lexsort((j, i, cost))
    i, j = i[order], j[order]
    free = np.ones(len(order), dtype=np.bool_)
    while True:
        open_pairs = np.flatnonzero(free)
        _, first = np.unique(i[open_pairs], return_index=True)
        asked = np.sort(open_pairs[first])
        asked = asked[np.argsort(j[asked], kind="stable")]
        wanted, start = np.unique(j[asked], return_index=True)
        counts = np.diff(np.append(start, len(asked)))
        rank = np.arange(len(asked)) - np.repeat(start, counts)
        lost = asked[rank >= room[j[asked]]]
        if not len(lost):
            break
        last = np.full(len(room), len(order))
        full = counts >= room[wanted]
        last[wanted[full]] = np.where(
            room[wanted[full]] > 0, asked[start[full] + np.maximum(room[wanted[full]], 1) - 1], -1
        )
        free &= np.arange(len(order)) <= last[j]
    out = np.full(tracks, -1, dtype=np.intp)
    out[i[asked]] = j[asked]
    return out


def ranked(weight: Floats, held: Ints, total: int) -> Ints:
    """How many of `total` states each component (C,) gets: the k-th state of one weighs w - (k - 1), and `HOLD` more
    if it is a second or further one that stands already (held (C,)); the heaviest get them."""
    most = np.ceil(weight).astype(np.intp)
    owner = np.repeat(np.arange(len(weight)), most)
    k = np.arange(len(owner)) - np.repeat(np.cumsum(most) - most, most)
    key = weight[owner] - k + np.where((k > 0) & (k < held[owner]), HOLD, 0.0)
    best = np.lexsort((owner, k, -key))[: max(total, 0)]
    return np.bincount(owner[best], minlength=len(weight))


def carried(place: Ints, number: Ints, memory: Memory) -> Ints:
    """The component (G,) of each track again, where each carries no more than `number` (C,): those that stood there
    first, then the older."""
    there = np.flatnonzero(place >= 0)
    there = there[np.lexsort((there, ~memory.held[there], place[there]))]
    _, start, counts = np.unique(place[there], return_index=True, return_counts=True)
    rank = np.arange(len(there)) - np.repeat(start, counts)
    out = np.full(len(place), -1, dtype=np.intp)
    stays = there[rank < number[place[there]]]
    out[stays] = place[stays]
    return out


def live(
    status: NDArray[np.uint8],
    existence: Floats,
    memory: Memory,
    supporting: Bools,
    may_speak: Bools,
    new: Bools,
    time: int,
    config: CentreConfig,
) -> tuple[NDArray[np.uint8], Memory, Bools]:
    """One step of every life: status, memory, and which end (G,).

    supporting (N, G): which sources feed a track; may_speak (N, G): whose silence is a missed chance of it; new (N,):
    which sources brought data that no step has used. Rules as in `lifecycle`, but a chance is a step with new data of
    a supporting source, or, without support, of one that may speak.
    """
    supported, news = supporting.any(axis=0), supporting & new[:, None]
    fresh = news.any(axis=0)
    chance = fresh | (~supported & (may_speak & new[:, None]).any(axis=0))
    window = np.uint64(2**config.confirm_within - 1)
    shifted = ((memory.hits << np.uint64(1)) | fresh.astype(np.uint64)) & window
    hits = np.where(chance, shifted, memory.hits)
    proven = (np.bitwise_count(hits) >= config.confirm_hits) | (news.sum(axis=0) >= config.confirm_sources)
    weak = existence < config.min_existence
    confirm = supported & ~weak & proven & (existence >= config.confirm_existence)
    after = np.where((status == TENTATIVE) & ~confirm, TENTATIVE, np.where(supported, CONFIRMED, COASTING))
    after = np.where(weak, TENTATIVE, after).astype(np.uint8)
    last = np.where(supported, time, memory.supported)
    overdue = time - last > round(config.coast * 1e9)
    ended = ~supported & (overdue | weak | ((after == TENTATIVE) & (hits == 0)))
    return after, replace(memory, hits=hits, supported=last), ended
