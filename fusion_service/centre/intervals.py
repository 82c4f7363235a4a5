"""How often a local track reports, measured from its own updates, and when it is stale by that.

One receiver may bring a ferry every 2 s and a ship at anchor every 3 min, so no one period of the source tells when
either is overdue. `interval` is the expected time to the next report: it begins with the period of the source, rises
at once to every longer gap, and falls half way to every shorter one,

    interval <- max(gap, interval - (interval - gap) / 2),

which is about the longest of the last few gaps. A track is stale `stale_periods` intervals and `lateness` after its
newest report. One that went stale is remembered for `remember` seconds, so that a report that comes after all tells
its interval.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import all_of, same_ids
from fusion_service.config import CentreConfig, SourceConfig

__all__ = [
    "NOTHING_REMEMBERED",
    "Pace",
    "Remembered",
    "follow",
    "intervals",
    "next_interval",
    "remember",
    "silence",
    "silence_of",
]

I64 = NDArray[np.int64]

MOST_GAPS = 8
"""Of one track's gaps in one batch the last so many count: older ones weigh 1/256."""


class Pace(NamedTuple):
    """Bounds of the intervals of one source, ns: first, of a track that is new; floor and cap."""

    first: int
    floor: int
    cap: int


class Remembered(NamedTuple):
    """R tracks that went stale, sorted by id: time of the newest report and interval, ns, and the global track that it
    was linked to, 0 for none, (R,)."""

    id: NDArray[np.uint64]
    time: I64
    interval: I64
    link: NDArray[np.uint64]

    def take(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Remembered:
        """The given rows."""
        return Remembered(self.id[rows], self.time[rows], self.interval[rows], self.link[rows])


_NONE = np.zeros(0, dtype=np.int64)
NOTHING_REMEMBERED = Remembered(np.zeros(0, dtype=np.uint64), _NONE, _NONE, np.zeros(0, dtype=np.uint64))


def follow(interval: int, gap: int, pace: Pace) -> int:
    """The interval after one more gap, ns."""
    return min(max(gap, interval - (interval - gap) // 2, pace.floor), pace.cap)


def silence(interval: I64, said: SourceConfig, config: CentreConfig) -> I64:
    """How long after its newest report a track, or source, of this interval, ns, is stale."""
    if said.stale is not None:
        return np.full_like(interval, round(said.stale * 1e9))
    return np.asarray(
        np.rint(config.stale_periods * interval).astype(np.int64) + round(config.lateness * 1e9), dtype=np.int64
    )


def silence_of(interval: int, said: SourceConfig, config: CentreConfig) -> int:
    """`silence` of one."""
    if said.stale is not None:
        return round(said.stale * 1e9)
    return round(config.stale_periods * interval) + round(config.lateness * 1e9)


def intervals(id: NDArray[np.uint64], time: I64, known: Remembered, pace: Pace) -> I64:
    """The interval (T,) of each of the reports of tracks `id` (T,) at `time` (T,), ns; `known`: what they were before.
    An id may be there several times: its newest report has what all of them give."""
    if all_of(id[1:] > id[:-1]):
        interval, before = _before(id, known, pace)
        return next_interval(interval, before, time, pace.floor, pace.cap)
    order = np.lexsort((time, id))
    ids, times = id[order], time[order]
    first = np.append(True, ids[1:] != ids[:-1])
    interval, before = _before(ids, known, pace)
    begin = np.flatnonzero(first)
    size = np.diff(np.append(begin, len(ids)))
    last = begin + size - 1
    previous = np.where(first, before, np.maximum(np.roll(times, 1), before))
    gap = np.where(previous >= 0, times - previous, 0)
    now = interval[begin]
    for back in range(min(int(size.max()), MOST_GAPS) - 1, -1, -1):
        there = size > back
        now = np.where(there, _after(now, gap[np.where(there, last - back, 0)], pace.floor, pace.cap), now)
    out = np.empty(len(ids), dtype=np.int64)
    out[order] = np.repeat(now, size)
    return out


def _before(ids: NDArray[np.uint64], known: Remembered, pace: Pace) -> tuple[I64, I64]:
    """Interval and time of the last report, -1 without, of tracks `ids`."""
    if same_ids(known.id, ids):
        return known.interval, known.time
    interval, before = np.full(len(ids), pace.first, dtype=np.int64), np.full(len(ids), -1, dtype=np.int64)
    if len(known.id) and len(ids):
        at = np.minimum(np.searchsorted(known.id, ids), len(known.id) - 1)
        was = known.id[at] == ids
        interval[was], before[was] = known.interval[at][was], known.time[at][was]
    return interval, before


def next_interval(interval: I64, before: I64, time: I64, floor: I64 | int, cap: I64 | int) -> I64:
    """The interval (T,) of tracks that had `interval`, after reports at `before`, -1 for none, and at `time`, ns."""
    return _after(interval, np.where(before >= 0, time - before, 0), floor, cap)


def _after(interval: I64, gap: I64, floor: I64 | int, cap: I64 | int) -> I64:
    """Intervals after one more gap each, ns; as they were where that is not positive."""
    longer = np.maximum(np.maximum(gap, interval - (interval - gap) // 2), floor)
    return np.where(gap > 0, np.minimum(longer, cap), interval)


def remember(known: Remembered, retired: Remembered, there: NDArray[np.uint64], oldest: int, most: int) -> Remembered:
    """What is remembered when `retired` have gone stale: not the ids `there`, nothing whose newest report is before
    `oldest`, ns, and at most the newest `most`."""
    if not len(retired.id) and not len(known.id):
        return known
    ids = np.concatenate([known.id, retired.id])
    times, gaps = np.concatenate([known.time, retired.time]), np.concatenate([known.interval, retired.interval])
    links = np.concatenate([known.link, retired.link])
    order = np.lexsort((times, ids))
    both = Remembered(ids[order], times[order], gaps[order], links[order])
    keep = np.append(both.id[1:] != both.id[:-1], True) & (both.time >= oldest) & ~np.isin(both.id, there)
    both = both.take(keep)
    if len(both.id) > most:
        newest = np.lexsort((both.id, -both.time))[:most]
        both = both.take(np.sort(newest))
    return both
