"""Life of global tracks by data: tentative, confirmed, coasting, deleted.

A hit is a new measurement in a local track that is fused in the global one (a local track that its tracker only
predicts on, its `updated` standing still, gives none). A track is confirmed by hits in M of the last N reports that
were due, at the pace of its own sources, or at once by several sources. It coasts when the next report of every
contributor is overdue, and ends after `coast` seconds or `coast_periods` of the slowest contributor, whichever is
longer; a tentative one when N reports were due without a hit. One whose existence falls below `min_existence` is
tentative again, and ends when overdue. One that has lost its local tracks is overdue since the last step that had one;
and where the last was missing from a complete scan of a source that had judged its existence, it ends unless the next
report that is expected brings it back. How often the centre steps changes nothing of this.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import find_sorted
from fusion_service.centre.lineage import NOBODY
from fusion_service.centre.tracks import as_mixtures, join_tracks, no_parts, taken
from fusion_service.config import CentreConfig
from fusion_service.densities import Mixtures
from fusion_service.records import altered
from schemas.messages import COASTING, CONFIRMED, TENTATIVE

__all__ = ["WAYS", "Picture", "Support", "advance", "empty_picture", "newborn"]

WAYS = ("", "tracklet", "bar-shalom-campo derived", "bci derived", "bci declared", "ci", "cu")
"""What a track may be fused by: "" is the rule of the config."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """G global tracks sorted by id: mean (n, G), covariance (n, n, G), the rest (G,).

    log_weight (C, G), part_mean (n, C, G), part_covariance (n, n, C, G): components as in `tracks.Tracks`.
    id u64; status u8; time i64 of the density (-1: none yet); updated i64 of the last measurement in it;
    seen i64 time of the newest local track in it; born i64 of its first step; due i64 when its next report is
    overdue (of one that was dropped: so long ago that its time is up with the next report); interval i64 between
    reports, ns; hits u64, the last reports due as bits; last_hit i64 step of the last; existence, and opinion (NaN:
    none yet) and evidence, the log-odds it is made of; lineage i32 code of the sources whose data are in the density
    (-1: not known); motion i32 code (see `motions`); way u8 index into `WAYS` of what it was last fused by; extent
    (E, G), fused, E = 0 where nothing is known of any (see `extents`).
    """

    id: NDArray[np.uint64]
    status: NDArray[np.uint8]
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    log_weight: NDArray[np.float64]
    part_mean: NDArray[np.float64]
    part_covariance: NDArray[np.float64]
    time: NDArray[np.int64]
    updated: NDArray[np.int64]
    seen: NDArray[np.int64]
    born: NDArray[np.int64]
    due: NDArray[np.int64]
    interval: NDArray[np.int64]
    hits: NDArray[np.uint64]
    last_hit: NDArray[np.int64]
    existence: NDArray[np.float64]
    opinion: NDArray[np.float64]
    evidence: NDArray[np.float64]
    motion: NDArray[np.int32]
    way: NDArray[np.uint8]
    lineage: NDArray[np.int32]
    extent: NDArray[np.float64]

    def take(self, rows: Any) -> Picture:
        """The given rows (indices or a mask)."""
        return cast(Picture, taken(self, rows))

    def mixtures(self, rows: Any) -> Mixtures:
        """The densities of the given rows as mixtures."""
        return as_mixtures(self, rows)

    def find(self, ids: NDArray[np.uint64]) -> NDArray[np.intp]:
        """Rows of ids that are in the picture: where each would be inserted."""
        return find_sorted(self.id, ids)

    def join(self, other: Picture) -> Picture:
        """Both, one after the other: sorted where the ids of `other` are above all of these (see `order`)."""
        return join_tracks([self, other])

    def order(self) -> NDArray[np.intp] | None:
        """By which its rows are to be taken to be sorted by id; None where they are."""
        return None if (self.id[1:] > self.id[:-1]).all() else np.argsort(self.id)


def empty_picture(n: int) -> Picture:
    """No tracks, of n components."""
    return newborn(np.zeros(0, dtype=np.uint64), n, 0)


def newborn(ids: NDArray[np.uint64], n: int, time: int) -> Picture:
    """Tentative tracks without a density yet."""
    count = len(ids)
    parts = no_parts(n, count)
    never = np.full(count, -1, dtype=np.int64)
    return Picture(
        id=ids,
        status=np.full(count, TENTATIVE, dtype=np.uint8),
        mean=np.zeros((n, count)),
        covariance=np.zeros((n, n, count)),
        log_weight=parts[0],
        part_mean=parts[1],
        part_covariance=parts[2],
        time=never,
        updated=never,
        seen=never,
        born=np.full(count, time, dtype=np.int64),
        due=np.full(count, time, dtype=np.int64),
        interval=np.zeros(count, dtype=np.int64),
        hits=np.zeros(count, dtype=np.uint64),
        last_hit=never,
        existence=np.ones(count),
        opinion=np.full(count, np.nan),
        evidence=np.zeros(count),
        motion=np.full(count, -1, dtype=np.int32),
        way=np.zeros(count, dtype=np.uint8),
        lineage=np.full(count, NOBODY, dtype=np.int32),
        extent=np.zeros((0, count)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Support:
    """What feeds G global tracks in a step. sources (G,): how many sources whose next report is not overdue; hit (G,):
    whether a new measurement came in; due (G,): ns at which the next report of the last of them is overdue, -1 where
    none is believed; interval (G,): ns between reports of the slowest of them; left (G,): no local track is linked any
    more; dropped (G,): nor is it because a complete scan of this step, of a source that judged its existence, did not
    list the last of them. before: ns of the last step."""

    sources: NDArray[np.intp]
    hit: NDArray[np.bool_]
    due: NDArray[np.int64]
    interval: NDArray[np.int64]
    left: NDArray[np.bool_]
    dropped: NDArray[np.bool_]
    before: int


def advance(picture: Picture, time: int, support: Support, config: CentreConfig) -> tuple[Picture, NDArray[np.bool_]]:
    """Every life at the step at `time`, ns: the picture with new status, and which tracks end now."""
    linked = support.due >= 0
    due = np.where(linked, support.due, picture.due)
    due = np.where(support.left, np.minimum(due, support.before), due)
    interval = np.where(linked, support.interval, picture.interval)
    hits, last = _counted(picture, time, support, interval, config)
    overdue = time > due
    proven = (np.bitwise_count(hits) >= config.confirm_hits) | (support.sources >= config.confirm_sources)
    weak = picture.existence < config.min_existence
    confirm = ~overdue & ~weak & proven & (picture.existence >= config.confirm_existence)
    confirm &= support.sources >= config.min_sources
    status = np.where((picture.status == TENTATIVE) & ~confirm, TENTATIVE, np.where(overdue, COASTING, CONFIRMED))
    status = np.where(weak, TENTATIVE, status)
    coast = np.maximum(round(config.coast * 1e9), _times(interval, config.coast_periods))
    waiting = _times(interval, max(config.confirm_within - 1.5, 0.0))
    patience = np.where(status == TENTATIVE, waiting, coast)
    due = np.where(support.dropped, np.minimum(due, time + interval + interval // 2 - patience), due)
    ended = overdue & ((time - due > patience) | weak)
    status = status.astype(np.uint8)
    return altered(picture, status=status, hits=hits, last_hit=last, due=due, interval=interval), ended


def _counted(
    picture: Picture, time: int, support: Support, interval: NDArray[np.int64], config: CentreConfig
) -> tuple[NDArray[np.uint64], NDArray[np.int64]]:
    """The window of hits, moved on by as many reports as were due since the last hit, and the step of that."""
    pace = np.maximum(interval, round(config.period * 1e9))
    since = np.where(picture.last_hit >= 0, time - picture.last_hit, pace)
    shift = np.minimum(np.maximum((since + pace // 2) // pace, 1), 63).astype(np.uint64)
    window = np.uint64(2**config.confirm_within - 1)
    hits = np.where(support.hit, ((picture.hits << shift) | np.uint64(1)) & window, picture.hits)
    return hits, np.where(support.hit, time, picture.last_hit)


def _times(interval: NDArray[np.int64], factor: float) -> NDArray[np.int64]:
    return np.asarray(np.rint(interval * factor), dtype=np.int64)
