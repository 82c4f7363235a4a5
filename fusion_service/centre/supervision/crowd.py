"""What the tracks of many sources did between two steps, looked at together: of those sources that tell of the same
tracks as before, which nearly all do. Each gets what it would alone (see `moves`, `conduct`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Ints, marked
from fusion_service.centre.sources import Source
from fusion_service.centre.supervision.moves import Change, Moves, Snapshot, judged
from fusion_service.centre.tracks import Tracks
from fusion_service.centre.words import NONE
from fusion_service.config import CentreConfig
from schemas import Frame

__all__ = ["COLUMNS", "Seen", "Told", "counted", "seen_together"]

SMALL = 64
"""Tracks of a source up to which it is looked at with others: beyond, copies cost more than calls."""
COLUMNS: dict[str, type[np.generic]] = {
    "id": np.uint64, "repeats": np.int64, "varied": np.int64, "since": np.int64, "jumps": np.int64, "last": np.int64,
}  # fmt: skip
Counts = dict[str, NDArray[Any]]


class Told(NamedTuple):
    """A source that told of tracks: its table before, the counts of them (each of `COLUMNS`, (T,), by id), and m, one
    sigma of what it states of its place."""

    source: Source
    before: Snapshot
    counts: Counts
    shift: float


class Seen(NamedTuple):
    """What it did: moves (None: nothing of them calls for a look), counts as they are now; jumped (K,): of which it
    counts; named: whether a track says what it is."""

    moves: Moves | None
    counts: Counts
    jumped: Bools
    named: bool


def counted(counts: Counts, at: Ints, found: Moves, first: NDArray[np.int64], identity: Any, time: int, hold: int,
            varies: int) -> Bools:  # fmt: skip
    """Write the counts of the new versions `found`, `at` (K,), the ones before them being of `first` (K,), ns; jumped
    (K,) of those of which it counts: that have varied `varies` times, have jumped within `hold` ns, or say what they
    are."""
    ended, varied = counts["repeats"][at] > 0, counts["varied"][at]
    counts["since"][at] = np.where(found.again & ended, counts["since"][at], first)
    counts["repeats"][at] = np.where(found.again, counts["repeats"][at] + 1, 0)
    counts["varied"][at] = np.where(found.again, varied, np.where(ended, 1, varied + 1))
    if counts["jumps"].any():
        counts["jumps"][time - counts["last"] > hold] = 0
    settled = (varied >= varies) | (counts["jumps"][at] > 0) | (identity[at] != NONE)
    jumped: Bools = found.jumped & settled
    if found.jumped.any():
        counts["varied"][at[found.jumped]] = 0
        counts["jumps"][at[jumped]] += 1
        counts["last"][at[jumped]] = time
    return jumped


def seen_together(
    told: Sequence[Told], frame: Frame | None, config: CentreConfig, time: int, hold: int, varies: int, few: int
) -> dict[str, Seen]:
    """Of sources that tell of the tracks of before, in as many versions, what they did, by name; few: repeats from
    which a source is looked at for itself."""
    out: dict[str, Seen] = {}
    same = [one for one in told if _is_usual(one, frame)]
    for _, run in groupby(same, key=lambda one: (one.source.space, one.shift)):
        group = [*run]
        if len(group) > 1:
            out.update(_seen(group, config, time, hold, varies, few))
    return out


def _is_usual(one: Told, frame: Frame | None) -> bool:
    source, before, tracks = one.source, one.before, one.source.tracks
    count = len(tracks.id)
    return (
        0 < count <= SMALL
        and count == len(before.tracks.id) == len(one.counts["id"])
        and (before.epoch, before.space, before.frame) == (source.epoch, source.space, frame)
    )


def _seen(
    group: Sequence[Told], config: CentreConfig, time: int, hold: int, varies: int, few: int
) -> Iterator[tuple[str, Seen]]:
    old, new = [one.before.tracks for one in group], [one.source.tracks for one in group]
    sizes = np.array([len(table.id) for table in new])
    starts = np.cumsum(sizes) - sizes
    ids = _joined(new, "id")
    counts = {name: np.concatenate([one.counts[name] for one in group]) for name in COLUMNS}
    usual = np.logical_and.reduceat((_joined(old, "id") == ids) & (counts["id"] == ids), starts)
    stamp, was, identity = _joined(new, "time"), _joined(old, "time"), _joined(new, "identity")
    later = (stamp > was) & (_joined(new, "updated") > _joined(old, "updated"))
    at = marked(later & (_joined(old, "origin") == _joined(new, "origin")) & np.repeat(usual, sizes))
    x, y, P, R = (_joined(side, name).take(at, axis=-1) for name in ("mean", "covariance") for side in (old, new))
    change = Change(x, y, P, R, (stamp[at] - was[at]) / 1e9, _joined(old, "interval")[at])
    found = Moves(at, *judged(change, group[0].source.space, group[0].shift, config), at)
    jumped = counted(counts, at, found, was[at], identity, time, hold, varies)
    calls = np.zeros(len(ids), dtype=np.bool_)
    calls[at] = (counts["repeats"][at] >= few) | jumped
    restless, named = (np.logical_or.reduceat(mask, starts) for mask in (calls, identity != NONE))
    edges = np.searchsorted(at, np.append(starts, len(ids))).tolist()
    flags = zip(usual.tolist(), restless.tolist(), named.tolist(), strict=True)
    for k, (one, start, size, (fits, rests, says)) in enumerate(
        zip(group, starts.tolist(), sizes.tolist(), flags, strict=True)
    ):
        if not fits:
            continue
        mine = {name: column[start : start + size].copy() for name, column in counts.items()}
        part = slice(edges[k], edges[k + 1])
        moves: Moves | None = None
        if rests or says:
            mine_at, again, speed, sigma, leapt, away, _ = found
            here = mine_at[part] - start
            moves = Moves(here, again[part], speed[part], sigma[part], leapt[part], away[part], here)
        yield one.source.name, Seen(moves, mine, jumped[part], says)


def _joined(tables: Sequence[Tracks], name: str) -> NDArray[Any]:
    return np.concatenate([getattr(table, name) for table in tables], axis=-1)
