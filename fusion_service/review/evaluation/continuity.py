"""How well tracks hold on to what they follow: SIAP metrics and OSPA(2).

SIAP (Votruba et al., 2001), each track belonging to the nearest true object closer than the cut-off at that time, if
there is one. J true objects, JT of them with a track, N tracks, NA of them with an object, at each time:

    completeness  sum JT / sum J       ambiguity  sum NA / sum JT       spuriousness  sum (N - NA) / sum N
    positional and velocity accuracy   mean error of the NA tracks, m and m/s
    rate of track number changes       sum_j (NU_j - 1) / sum_j TT_j, 1/s
    longest track segment              sum_j TL_j / sum_j T_j

NU_j the least number of tracks that follow object j as long as any does, TT_j the time it is followed, TL_j the
longest time one track follows it without a break, T_j its life, each between scored times.

OSPA(2) (Beard, Vo, Vo, 2020): OSPA between the tracks and the paths of true objects in a window of scored times. The
distance of a track and a path is the mean, over the times in the window at which either is there, of their distance cut
off at c, and c where one of them is not there.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.metrics import assign_near
from fusion_service.review.snapshots import Indices

__all__ = ["Following", "Instant", "Siap", "ospa2", "siap_of"]


class Instant(NamedTuple):
    """One time: the J true objects there, the N tracks there, and the pairs (K,) of both that are closer than the
    cut-off, as numbers that mean the same at all times, with their distances (K,)."""

    objects: Indices
    tracks: Indices
    i: Indices
    j: Indices
    d: Floats


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Siap:
    """The metrics over the whole mission, NaN where there is nothing to take them of; velocity_accuracy also where
    truth or tracks have no velocity."""

    completeness: float
    ambiguity: float
    spuriousness: float
    position_accuracy: float
    velocity_accuracy: float
    track_number_changes: float
    longest_segment: float


class Following:
    """Which track followed which object from when to when, gathered time after time."""

    def __init__(self, objects: int) -> None:
        self._objects = max(objects, 1)
        self._now = np.zeros(0, dtype=np.int64)
        self._since = np.zeros(0, dtype=np.int64)
        self._over: list[NDArray[np.int64]] = []

    def add(self, k: int, objects: Indices, tracks: Indices) -> None:
        """At the k-th time `tracks` (K,) follow `objects` (K,)."""
        now = np.sort(tracks.astype(np.int64) * self._objects + objects)
        if np.array_equal(now, self._now):
            return
        stays = np.isin(self._now, now, assume_unique=True)
        self._end(~stays, k - 1)
        since = np.full(len(now), k)
        since[np.searchsorted(now, self._now[stays])] = self._since[stays]
        self._now, self._since = now, since

    def segments(self, last: int) -> NDArray[np.int64]:
        """All segments (R, 4), those that last until the time `last` too: object, track, first and last time, by
        object and first time."""
        self._end(np.ones(len(self._now), dtype=np.bool_), last)
        self._now, self._since = self._now[:0], self._since[:0]
        rows = np.concatenate(self._over or [np.zeros((0, 3), dtype=np.int64)])
        found = np.column_stack([rows[:, 0] % self._objects, rows[:, 0] // self._objects, rows[:, 1:]])
        return found[np.lexsort((found[:, 1], found[:, 2], found[:, 0]))]

    def _end(self, which: NDArray[np.bool_], k: int) -> None:
        if which.any():
            over = np.column_stack([self._now[which], self._since[which], np.full(int(which.sum()), k)])
            self._over.append(over)


def siap_of(
    segments: NDArray[np.int64],
    times: NDArray[np.int64],
    lives: Floats,
    counts: tuple[float, float, float, float],
    accuracy: tuple[float, float],
) -> Siap:
    """The metrics of `segments` (R, 4) at `times` (K,) ns; lives (J,): T_j, s; counts: the sums of J, JT, N and NA;
    accuracy: mean errors of position and of velocity."""
    changes, followed, longest = 0, 0.0, 0.0
    for one in np.split(segments, np.flatnonzero(np.diff(segments[:, 0])) + 1) if len(segments) else ():
        begin, end = one[:, 2], one[:, 3]
        longest += float((times[end] - times[begin]).max()) / 1e9
        latest = np.maximum.accumulate(end)
        before = np.append(begin[0], latest[:-1])
        followed += float(np.maximum(times[end] - times[np.maximum(begin, np.minimum(before, end))], 0).sum()) / 1e9
        changes += _needed(begin, end) - 1
    objects, tracked, tracks, assigned = counts
    life = float(lives.sum())
    return Siap(
        completeness=_ratio(tracked, objects),
        ambiguity=_ratio(assigned, tracked),
        spuriousness=_ratio(tracks - assigned, tracks),
        position_accuracy=accuracy[0],
        velocity_accuracy=accuracy[1],
        track_number_changes=_ratio(changes, followed),
        longest_segment=_ratio(longest, life),
    )


def _needed(begin: NDArray[np.int64], end: NDArray[np.int64]) -> int:
    """How many segments, given by their begin, it takes to be there at all times at which one is: each time the one
    that lasts longest of those that are there."""
    count, covered, best, at = 0, -1, -1, 0
    while True:
        while at < len(begin) and begin[at] <= covered + 1:
            best, at = max(best, int(end[at])), at + 1
        if best > covered:
            count, covered = count + 1, best
        elif at < len(begin):
            covered = int(begin[at]) - 1
        else:
            return count


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole > 0 else float("nan")


def ospa2(window: deque[Instant], c: float, p: float = 2.0) -> float:
    """OSPA(2) over the instants of a window."""
    objects, at_object, there = _presence([instant.objects for instant in window])
    tracks, at_track, shown = _presence([instant.tracks for instant in window])
    most = max(len(objects), len(tracks))
    if not most:
        return 0.0
    i = np.searchsorted(objects, np.concatenate([instant.i for instant in window]))
    j = np.searchsorted(tracks, np.concatenate([instant.j for instant in window]))
    d = np.concatenate([instant.d for instant in window])
    pairs, at = np.unique(i * max(len(tracks), 1) + j, return_inverse=True)
    i, j = np.divmod(pairs, max(len(tracks), 1))
    close, apart = np.bincount(at, minlength=len(pairs)), np.bincount(at, weights=d, minlength=len(pairs))
    both = (there[:, i] & shown[:, j]).sum(axis=0)
    either = at_object[i] + at_track[j] - both
    gain = c**p - ((apart + c * (either - close)) / np.maximum(either, 1)) ** p
    kept = assign_near(i, j, gain, (len(objects), len(tracks)))
    return float((max(most * c**p - float(gain[kept].sum()), 0.0) / most) ** (1 / p))


def _presence(numbers: list[Indices]) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """Those that occur (M,), at how many of the W times (M,), and at which (W, M)."""
    some, at, counts = np.unique(np.concatenate(numbers), return_inverse=True, return_counts=True)
    there = np.zeros((len(numbers), len(some)), dtype=np.bool_)
    there[np.repeat(np.arange(len(numbers)), [len(one) for one in numbers]), at] = True
    return some, counts, there
