"""The versions that local tracks have gone through since the last step, each beside the one before it.

What a local tracker has learnt between two versions of a track is told by what changed: the old version, predicted
with the source's declared motion to the time of the new one, beside the new one. `tracklets` and `derived` are made of
nothing else. A version in which there is no newer measurement, or that comes after a later one, is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from operator import attrgetter
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats, Ints, find_sorted
from fusion_service.centre.align import predict_tracks
from fusion_service.centre.intake import Intake
from fusion_service.centre.rows import Rows
from fusion_service.centre.tracks import Tracks, join_tracks, taken
from fusion_service.centre.treatment import Treatment
from fusion_service.records import altered, columns_of, names_of
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
    parts = [_predicted([*run], intake, time) for _, run in groupby(_by_source(intake, rows), key=_alike)]
    if not parts:
        none, whole = np.zeros((n, 0)), np.zeros(0, dtype=np.int64)
        return Versions(np.zeros(0, dtype=np.intp), whole, whole, none, np.zeros((n, n, 0)), none, np.zeros((n, n, 0)))
    joined = parts[0] if len(parts) == 1 else _joined(parts)
    later, same = joined.time[1:] > joined.time[:-1], joined.time[1:] == joined.time[:-1]
    if (later | same & (joined.row[1:] >= joined.row[:-1])).all():
        return joined
    return joined.take(np.lexsort((joined.row, joined.time)))


class _Part(NamedTuple):
    """What is new of a source: the old versions and the new ones, of rows `at`; how they move, in which space, what
    they were inflated by, and how they are treated."""

    old: _Densities
    new: _Densities
    at: Ints
    motion: Motion
    space: tuple[str, ...]
    inflation: float
    treatment: Treatment


def _alike(part: _Part) -> tuple[Any, ...]:
    """What parts that are predicted together have in common; of one whose states are corrected it is all its own."""
    alone = -1 if part.treatment.correction is None else int(part.at[0])
    return (
        part.motion,
        part.space,
        part.inflation,
        part.treatment.clock,
        alone,
        len(part.old.log_weight),
        len(part.new.log_weight),
    )


def _by_source(intake: Intake, rows: Rows) -> Iterator[_Part]:
    start = 0
    for name, count in rows.kept.items():
        source, ids = intake.sources[name], rows.tracks.id[start : start + count]
        if source.pairs and count:
            old, new = (_densities([pair[side] for pair in source.pairs]) for side in (0, 1))
            if len(new.id) == count and (new.id == ids).all():
                at: Ints = np.arange(count)
            else:
                at = np.minimum(find_sorted(ids, new.id), count - 1)
                known = ids[at] == new.id
                old, new, at = _thinned(old.take(known), new.take(known), at[known])
            said = intake.declared(source)
            if len(at):
                part = at + start, said.motion, source.space, said.inflation, intake.treatment(name)
                yield _Part(old, new, *part)
        start += count


def _predicted(parts: list[_Part], intake: Intake, latest: int) -> Versions:
    """The versions of parts that are alike."""
    first, wanted = parts[0], intake.config.space
    old, new = (
        _together([_as_said(side, first.inflation) for side in sides])
        for sides in zip(*(part[:2] for part in parts), strict=True)
    )
    gone, speed = (new.time - old.time) / 1e9, intake.config.unknown_speed
    before = predict_tracks(old, first.motion, first.space, wanted, gone, intake.frame, speed)
    now = predict_tracks(new, first.motion, first.space, wanted, np.zeros(len(new.time)), intake.frame)
    at = np.concatenate([part.at for part in parts])
    versions = Versions(at, new.time, old.time, before.mean, before.covariance, now.mean, now.covariance)
    return _registered(versions, first.treatment, latest)


def _registered(versions: Versions, treatment: Treatment, latest: int) -> Versions:
    """Versions of one source at their true times, its registration error taken off as it is now of both the old and the
    new ones; what remains uncertain of it is not added, since it is no error of a measurement (see `watch`)."""
    if treatment.clock:
        when, before = (np.minimum(at - treatment.clock, latest) for at in (versions.time, versions.before))
        versions = altered(versions, time=when, before=before)
    if treatment.correction is None:
        return versions
    old = treatment.correction.moved(versions.predicted_mean, versions.predicted_covariance)
    new = treatment.correction.moved(versions.mean, versions.covariance)
    return Versions(versions.row, versions.time, versions.before, *old, *new)


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


_DENSITIES = attrgetter(*names_of(_Densities))


def _densities(parts: list[Tracks]) -> _Densities:
    """One after the other."""
    return _together([_Densities(*_DENSITIES(part)) for part in parts])


def _together(parts: list[_Densities]) -> _Densities:
    return parts[0] if len(parts) == 1 else join_tracks(parts)


def _joined(parts: list[Versions]) -> Versions:
    return Versions(*(np.concatenate(column, axis=-1) for column in zip(*map(columns_of, parts), strict=True)))


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
    return altered(tracks, covariance=tracks.covariance / inflation, part_covariance=tracks.part_covariance / inflation)
