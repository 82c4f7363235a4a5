"""Which local tracks may belong to which global tracks in a step, and how far they are from what the others say.

Nodes are the global tracks, at the fusion of the local tracks that are believed in them (at their prediction where
there is none), and the loose rows: those with a new datum that have no link or have failed its gate. A row is compared
with a track as that track is without the row's own source, so that no source vouches for itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Floats, Ints, all_of, among, filled, marked, picked
from fusion_service.centre.association import CROWDED, overlap
from fusion_service.centre.evidence import Tests
from fusion_service.centre.gating import Judgement
from fusion_service.centre.identity import Terms
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.meeting import Meeting
from fusion_service.centre.neighbours import Neighbours
from fusion_service.centre.partial import Unknown, apart
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.densities import Mixtures
from fusion_service.records import altered, columns_of

__all__ = ["Candidates", "Pairs", "find_candidates"]

FEW = CROWDED
"""Tracks up to which it is looked first whether any of them are near each other."""
MOST_RIVALS = 32
"""Tracks near its own that a believed row may be exchanged to, the nearest: bounds a step where all tracks coincide."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """K pairs (first, second), in order, with d2 and log det of the sum of their covariances over the `size` components
    that both know, and the d2 within which they are a pair."""

    first: Ints
    second: Ints
    distance: Floats
    spread: Floats
    size: Ints
    gate: Floats

    def take(self, some: NDArray[np.bool_] | Ints) -> Pairs:
        """Those given; the same where a mask holds for all."""
        if some.dtype == np.bool_ and some.all():
            return self
        return Pairs(*(column[some] for column in columns_of(self)))


_NOBODY, _NOTHING = np.zeros(0, dtype=np.intp), np.zeros(0)
NO_PAIRS = Pairs(_NOBODY, _NOBODY, _NOTHING, _NOTHING, _NOBODY, _NOTHING)


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Pairs within the gate: of global tracks (rows of the picture); of loose rows and tracks; of believed rows and
    other tracks near theirs; of loose rows of different sources. own (M,): what a believed row's own track costs it,
    d2 + log det, NaN for others. loose: the loose rows. mean (n, G), covariance (n, n, G): the tracks now."""

    tracks: Pairs
    joins: Pairs
    rivals: Pairs
    births: Pairs
    own: Floats
    loose: Ints
    mean: Floats
    covariance: Floats


def find_candidates(
    rows: Rows, now: Picture, meeting: Meeting, judged: Judgement, tests: Tests, places: list[int], beside: Neighbours
) -> Candidates:
    """All that may meet. now: the picture predicted to the step; beside: who was near in the last one."""
    tracks, agreed = rows.tracks, judged.agreed
    mean, covariance = agreed.mean, agreed.covariance
    if len(agreed.labels) < len(now.id):
        mean, covariance, at = now.mean.copy(), now.covariance.copy(), now.find(agreed.labels)
        mean[:, at], covariance[:, :, at] = agreed.mean, agreed.covariance
    loose = marked(rows.fresh & ((tracks.link == NO_TRACK) | tracks.outside) & ~meeting.held)
    there = now.time >= 0
    if not len(loose) and all_of(there) and _far_apart(mean, covariance, now, tests, places, beside):
        own = np.full(len(tracks.id), np.nan)
        return Candidates(NO_PAIRS, NO_PAIRS, NO_PAIRS, NO_PAIRS, own, loose, mean, covariance)
    known = marked(there)
    means, covariances = (mean, covariance) if len(known) == len(now.id) else (mean[:, known], covariance[..., known])
    if len(loose):
        means = np.concatenate([means, picked(tracks.mean, loose)], axis=1)
        covariances = np.concatenate([covariances, picked(tracks.covariance, loose)], axis=2)
    source = np.concatenate([np.full(len(known), -1), rows.source[loose]])
    compartment = np.concatenate([meeting.compartment_of_tracks[known], meeting.compartment_of_rows[loose]])
    gates = np.concatenate([np.tile(tests.gate[:, None], len(known)), rows.gate[:, loose]], axis=1)
    seen = np.asarray(tests.unknown.known(covariances).all(axis=1))
    places = [place for place in places if seen[place]]  # where a height is not known, pairs are sought on the plane
    sigma = np.sqrt(sum(covariances[place, place] for place in places))
    reach = float(np.sqrt(gates.max(initial=tests.gate[-1])))
    i, j = beside.pairs(now.id[known], means[places], sigma, reach, source)
    if not len(i):
        own = np.full(len(tracks.id), np.nan)
        return Candidates(NO_PAIRS, NO_PAIRS, NO_PAIRS, NO_PAIRS, own, loose, mean, covariance)
    same = compartment[i] == compartment[j]
    i, j = i[same], j[same]
    first_row, second_row = i >= len(known), j >= len(known)
    node = np.concatenate([known, loose])
    both, none = ~second_row, first_row
    parts = _mixtures(now, known, rows, loose)
    pairs_gg = _gated(means, covariances, i[both], j[both], gates, parts, tests.unknown)
    pairs_rr = _gated(means, covariances, i[none], j[none], gates, parts, tests.unknown)
    mixed = ~both & ~none
    lookup = _Without(rows, now, judged, mean, covariance, tests.unknown)
    row, track = node[j[mixed]], node[i[mixed]]
    joins = lookup.pairs(row, track, _own_mixtures(now, rows))
    row, track = _near_own(rows, now, judged.inside, pairs_gg, known)
    rivals = lookup.pairs(row, track, None)
    own = np.full(len(tracks.id), np.nan)
    if len(rivals.first):
        mine = np.unique(rivals.first)
        own[mine] = lookup.cost(mine, now.find(tracks.link[mine]))
    gg = altered(pairs_gg, first=known[pairs_gg.first], second=known[pairs_gg.second])
    rr = altered(pairs_rr, first=node[pairs_rr.first], second=node[pairs_rr.second])
    return _said(Candidates(gg, joins, rivals, rr, own, loose, mean, covariance), rows, now, meeting)


def _far_apart(
    mean: Floats, covariance: Floats, now: Picture, tests: Tests, places: list[int], beside: Neighbours
) -> bool:
    """Whether few global tracks, between which and no row there is anything to decide, are too far from each other to
    meet: what `find_candidates` would find, without the rest of its work."""
    count = len(now.id)
    if not 0 < count < FEW or not all_of(tests.unknown.known(covariance)):
        return False
    sigma = np.sqrt(sum(covariance[place, place] for place in places))
    reach = float(np.sqrt(tests.gate.max()))
    return not len(beside.pairs(now.id, mean[places], sigma, reach, filled(count, -1, np.intp))[0])


def _said(near: Candidates, rows: Rows, now: Picture, meeting: Meeting) -> Candidates:
    """Those of them that orders and identities allow, and what these say of one target against two counted as the
    states are: minus twice the log-likelihood ratio in what a pair costs."""
    own, joins, rivals = near.own, near.joins, near.rivals
    mine = marked(np.isfinite(own))
    if len(mine):
        own = own.copy()
        own[mine] -= 2.0 * meeting.with_tracks(mine, now.find(rows.tracks.link[mine])).ratio
    if len(meeting.forced_row):
        joins, rivals = (pairs.take(~among(pairs.first, meeting.forced_row)) for pairs in (joins, rivals))
    return altered(
        near,
        tracks=near.tracks.take(~meeting.of_tracks(near.tracks.first, near.tracks.second)),
        joins=_allowed(joins, meeting.with_tracks),
        rivals=_allowed(rivals, meeting.with_tracks),
        births=_allowed(near.births, meeting.with_rows),
        own=own,
    )


def _allowed(pairs: Pairs, say: Callable[[Ints, Ints], Terms]) -> Pairs:
    if not len(pairs.first):
        return pairs
    terms = say(pairs.first, pairs.second)
    return altered(pairs, spread=pairs.spread - 2.0 * terms.ratio).take(~terms.forbidden)


class _Without:
    """Global tracks without a given source: the fusion of the others where there are others, else the prediction."""

    def __init__(
        self, rows: Rows, now: Picture, judged: Judgement, mean: Floats, covariance: Floats, unknown: Unknown
    ) -> None:
        self._rows, self._now, self._judged, self._unknown = rows, now, judged, unknown
        self._mean, self._covariance = mean, covariance
        self._width = max(len(now.id), 1)

    @cached_property
    def _sorted(self) -> tuple[Ints, Ints]:
        """Keys of (source, track) of the believed rows, in order, and which rows these are."""
        inside = self._judged.inside
        keys = self._rows.source[inside] * self._width + self._now.find(self._rows.tracks.link[inside])
        order = np.argsort(keys, kind="stable")
        return keys[order], order

    def state(self, row: Ints, track: Ints) -> tuple[Floats, Floats]:
        """Mean (n, K) and covariance (n, n, K) of the tracks without the sources of the rows."""
        mean, covariance = picked(self._mean, track), picked(self._covariance, track)
        keys, order = self._sorted
        if len(keys):
            key = self._rows.source[row] * self._width + track
            at = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
            mine = marked(keys[at] == key)
            place = order[at[mine]]
            agreed = self._judged.agreed
            others = agreed.size[place] > 1
            some, alone = mine[others], mine[~others]
            mean[:, some] = picked(agreed.others_mean, place[others])
            covariance[:, :, some] = picked(agreed.others_covariance, place[others])
            mean[:, alone] = picked(self._now.mean, track[alone])
            covariance[:, :, alone] = picked(self._now.covariance, track[alone])
        return mean, covariance

    def _distances(self, row: Ints, track: Ints) -> tuple[Floats, Floats, Ints]:
        distance, size, count = np.empty(len(row)), np.empty(len(row)), np.empty(len(row), dtype=np.intp)
        for part in linalg.blocks(len(self._mean), len(row)):
            mean, covariance = self.state(row[part], track[part])
            spread = covariance + picked(self._rows.tracks.covariance, row[part])
            offset = picked(self._rows.tracks.mean, row[part]) - mean
            distance[part], size[part], count[part] = apart(spread, offset, self._unknown)
        return distance, size, count

    def cost(self, row: Ints, track: Ints) -> Floats:
        """d2 + log det (K,)."""
        distance, spread, _ = self._distances(row, track)
        return distance + spread

    def pairs(self, row: Ints, track: Ints, mixtures: tuple[Mixtures, Mixtures] | None) -> Pairs:
        """Those of the pairs within the gate of the row, in order; of mixtures the d2 of their nearest components."""
        if not len(row):
            return NO_PAIRS
        order = np.lexsort((track, row))
        row, track = row[order], track[order]
        distance, spread, size = self._distances(row, track)
        if mixtures is not None:
            mine, its = mixtures
            several = np.isfinite(mine.log_weights).sum(axis=0)[row] > 1
            several |= np.isfinite(its.log_weights).sum(axis=0)[track] > 1
            at = marked(several)
            distance[at], spread[at] = _overlap(mine.take(row[at]), its.take(track[at]), self._unknown)
        gate = self._rows.gate[size, row]
        return Pairs(row, track, distance, spread, size, gate).take(distance <= gate)


def _overlap(first: Mixtures, second: Mixtures, unknown: Unknown) -> tuple[Floats, Floats]:
    """`association.overlap` of K pairs over what both know."""
    distance, spread = overlap(first, second)
    return distance, spread + unknown.common(first.covariances[:, :, 0] + second.covariances[:, :, 0])[1]


def _gated(
    means: Floats, covariances: Floats, i: Ints, j: Ints, gates: Floats, parts: Mixtures | None, unknown: Unknown
) -> Pairs:
    if not len(i):
        return NO_PAIRS
    distance, spread, size = np.empty(len(i)), np.empty(len(i)), np.empty(len(i), dtype=np.intp)
    for part in linalg.blocks(len(means), len(i)):
        a, b = i[part], j[part]
        both, offset = picked(covariances, a) + picked(covariances, b), picked(means, a) - picked(means, b)
        distance[part], spread[part], size[part] = apart(both, offset, unknown)
    if parts is not None:
        several = np.isfinite(parts.log_weights).sum(axis=0) > 1
        at = marked(several[i] | several[j])
        distance[at], spread[at] = _overlap(parts.take(i[at]), parts.take(j[at]), unknown)
    gate = np.maximum(gates[size, i], gates[size, j])
    return Pairs(i, j, distance, spread, size, gate).take(distance <= gate)


def _near_own(rows: Rows, now: Picture, inside: Ints, near: Pairs, known: Ints) -> tuple[Ints, Ints]:
    """Every believed row with a new datum, and each track near its own, `MOST_RIVALS` at most: (row, track)."""
    fresh = inside[rows.fresh[inside]]
    if not len(near.first) or not len(fresh):
        return fresh[:0], fresh[:0]
    a, b = known[near.first], known[near.second]
    one, other = np.concatenate([a, b]), np.concatenate([b, a])
    distance = np.concatenate([near.distance, near.distance])
    order = np.lexsort((other, distance, one))
    begins = marked(np.diff(one[order], prepend=-1))
    rank = np.arange(len(order)) - np.repeat(begins, np.diff(np.append(begins, len(order))))
    order = np.sort(order[rank < MOST_RIVALS])
    order = order[np.lexsort((other[order], one[order]))]
    one, other = one[order], other[order]
    own = now.find(rows.tracks.link[fresh])
    first, last = np.searchsorted(one, own, "left"), np.searchsorted(one, own, "right")
    number = last - first
    row = np.repeat(fresh, number)
    at = np.arange(len(row)) - np.repeat(np.cumsum(number) - number, number) + np.repeat(first, number)
    return row, other[at]


def _mixtures(now: Picture, known: Ints, rows: Rows, loose: Ints) -> Mixtures | None:
    """The densities of the nodes as mixtures, where any of them is one."""
    if not len(now.log_weight) and not len(rows.tracks.log_weight):
        return None
    return Mixtures.joined([now.mixtures(known), rows.tracks.mixtures(loose)])


def _own_mixtures(now: Picture, rows: Rows) -> tuple[Mixtures, Mixtures] | None:
    if not len(now.log_weight) and not len(rows.tracks.log_weight):
        return None
    return rows.tracks.mixtures(slice(None)), now.mixtures(slice(None))
