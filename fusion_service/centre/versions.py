"""The versions that local tracks have gone through since the last step, each beside the one before it.

What a local tracker has learnt between two versions of a track is told by what changed: the old version, predicted
with the source's declared motion to the time of the new one, beside the new one. `tracklets` and `derived` are made of
nothing else. A version in which there is no newer measurement, or that comes after a later one, is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats, Ints
from fusion_service.centre.align import predict_tracks
from fusion_service.centre.intake import Intake
from fusion_service.centre.rows import Rows
from fusion_service.centre.tracks import Pair, Tracks, join_tracks, taken
from fusion_service.centre.treatment import Treatment
from schemas import Motion

__all__ = ["Versions", "versions_of"]

MOST_VERSIONS = 64
"""Of one row in a step; where there are more, several in a row are taken as one."""


@dataclass(frozen=True, slots=True, eq=False)
class Versions:
    """K new versions of rows, in order of (time, row). row (K,): index into the step's `Rows`; time, before (K,) ns of
    the new and of the old one; predicted_mean (n, K) and predicted_covariance (n, n, K): the old one predicted to
    `time`; mean, covariance: the new one; both in the centre's space and frame, as the source said them (neither
    inflated nor with its registration error added), but for what is corrected of that."""

    row: Ints
    time: NDArray[np.int64]
    before: NDArray[np.int64]
    predicted_mean: Floats
    predicted_covariance: Floats
    mean: Floats
    covariance: Floats

    def take(self, at: Any) -> Versions:
        """The given ones (indices or a mask)."""
        return cast(Versions, taken(self, at))


def versions_of(intake: Intake, rows: Rows, time: int) -> Versions:
    """All versions that came in with the step at `time`, ns, of rows that are used in it; none is later, whatever the
    clock of its source was thought to be when it came."""
    n = len(intake.config.space)
    parts = [part for name, part in _by_source(intake, rows, time) if len(part.row)]
    if not parts:
        none, whole = np.zeros((n, 0)), np.zeros(0, dtype=np.int64)
        return Versions(np.zeros(0, dtype=np.intp), whole, whole, none, np.zeros((n, n, 0)), none, np.zeros((n, n, 0)))
    joined = Versions(
        *(np.concatenate([getattr(part, one.name) for part in parts], axis=-1) for one in fields(Versions))
    )
    later, same = joined.time[1:] > joined.time[:-1], joined.time[1:] == joined.time[:-1]
    if (later | same & (joined.row[1:] >= joined.row[:-1])).all():
        return joined
    return joined.take(np.lexsort((joined.row, joined.time)))


def _by_source(intake: Intake, rows: Rows, time: int) -> Iterator[tuple[str, Versions]]:
    start = 0
    for name, count in rows.kept.items():
        source, ids = intake.sources[name], rows.tracks.id[start : start + count]
        if source.pairs and count:
            said = intake.declared(source)
            part = _versions(source.pairs, said.motion, said.inflation, source.space, intake, ids, start)
            yield name, _registered(part, intake.treatment(name), time)
        start += count


def _registered(versions: Versions, treatment: Treatment, latest: int) -> Versions:
    """Versions of one source at their true times, its registration error taken off as it is now of both the old and the
    new ones; what remains uncertain of it is not added, since it is no error of a measurement (see `watch`)."""
    if treatment.clock:
        when, before = (np.minimum(at - treatment.clock, latest) for at in (versions.time, versions.before))
        versions = replace(versions, time=when, before=before)
    if treatment.correction is None:
        return versions
    old = treatment.correction.moved(versions.predicted_mean, versions.predicted_covariance)
    new = treatment.correction.moved(versions.mean, versions.covariance)
    return Versions(versions.row, versions.time, versions.before, *old, *new)


def _versions(
    pairs: list[Pair], motion: Motion, inflation: float, space: tuple[str, ...], intake: Intake, ids: Any, start: int
) -> Versions:
    """Those of one source, whose rows have these ids (sorted), the first of them being row `start`."""
    old, new = (_densities([pair[side] for pair in pairs]) for side in (0, 1))
    if len(ids) == len(new.id) and (ids == new.id).all():
        at = np.arange(len(ids))
    else:
        at = np.minimum(np.searchsorted(ids, new.id), len(ids) - 1)
        known = ids[at] == new.id
        old, new, at = _thinned(old.take(known), new.take(known), at[known])
    old, new = _as_said(old, inflation), _as_said(new, inflation)
    wanted = intake.config.space
    gone, speed = (new.time - old.time) / 1e9, intake.config.unknown_speed
    predicted = predict_tracks(old, motion, space, wanted, gone, intake.frame, speed)
    now = predict_tracks(new, motion, space, wanted, np.zeros(len(new.time)), intake.frame)
    return Versions(at + start, new.time, old.time, predicted.mean, predicted.covariance, now.mean, now.covariance)


@dataclass(frozen=True, slots=True, eq=False)
class _Densities:
    """What of tracks is looked at here: the columns of `Tracks` of these names."""

    id: NDArray[np.uint64]
    time: NDArray[np.int64]
    mean: Floats
    covariance: Floats
    log_weight: Floats
    part_mean: Floats
    part_covariance: Floats

    def take(self, at: Any) -> _Densities:
        """The given ones (indices or a mask)."""
        return cast(_Densities, taken(self, at))


def _densities(parts: list[Tracks]) -> _Densities:
    """One after the other."""
    some = [_Densities(*(getattr(part, one.name) for one in fields(_Densities))) for part in parts]
    return some[0] if len(some) == 1 else join_tracks(some)


def _thinned(old: _Densities, new: _Densities, at: Any) -> tuple[_Densities, _Densities, Any]:
    """At most `MOST_VERSIONS` of each row `at` (K,): the old version of the first of some in a row, and the new one of
    the last. What is between two of them is process noise over a small part of a step."""
    if not len(at) or np.bincount(at).max() <= MOST_VERSIONS:
        return old, new, at
    order = np.lexsort((new.time, at))
    row = at[order]
    begin, end = np.searchsorted(row, row, "left"), np.searchsorted(row, row, "right")
    part = (np.arange(len(row)) - begin) * np.minimum(MOST_VERSIONS, end - begin) // (end - begin)
    first = np.append(True, (row[1:] != row[:-1]) | (part[1:] != part[:-1]))
    last = np.append(first[1:], True)
    return old.take(order[first]), new.take(order[last]), row[last]


def _as_said(tracks: _Densities, inflation: float) -> _Densities:
    """Covariances before they were inflated."""
    if inflation == 1.0:
        return tracks
    return replace(tracks, covariance=tracks.covariance / inflation, part_covariance=tracks.part_covariance / inflation)
