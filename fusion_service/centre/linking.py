"""Which local track belongs to which global track: keep, break, link, start, merge and split, on evidence."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from fusion_service.centre.association import (
    by_size,
    candidate_pairs,
    cluster,
    leave_one_out,
    overlap,
    pair_distance,
    uniform_ci,
)
from fusion_service.centre.ids import Ids
from fusion_service.centre.journal import Journal
from fusion_service.centre.lifecycle import Picture, newborn
from fusion_service.centre.meeting import Meeting
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.config import CentreConfig
from fusion_service.densities import Mixtures
from schemas import Entry, messages

__all__ = ["Linker"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
MOST_BYTES = 12_000_000
"""Global tracks are not started beyond what one message can carry with room to spare."""
Agreement = tuple[int, int, float]
"""Two global ids and their d2."""


class Linker:
    """The decisions about links, and the evidence gathered over steps.

    agreeing: pairs of global ids, and for how many steps in a row they have agreed.
    """

    def __init__(self, config: CentreConfig, ids: Ids) -> None:
        self.config = config
        self._ids = ids
        self.agreeing: dict[tuple[int, int], int] = {}
        gates = chi2.ppf([config.gate, config.keep_gate], len(config.space))
        self._gate, self._keep_gate = float(gates[0]), float(gates[1])
        n = len(config.space)
        self._most = MOST_BYTES // (8 * (n + n * (n + 1) // 2) + 200)
        self._places = [config.space.index(axis) for axis in ("x", "y", "z") if axis in config.space]

    def check(self, rows: Rows, journal: Journal) -> None:
        """Keep a standing link while its track agrees with the fusion of the others; break it on evidence."""
        tracks, linked = rows.tracks, rows.linked()
        if not len(linked):
            return
        links = tracks.link[linked]
        distance = leave_one_out(links, tracks.mean[:, linked], tracks.covariance[:, :, linked])
        failed = distance > self._keep_gate
        tracks.fails[linked] = np.where(failed, tracks.fails[linked] + 1, 0)
        journal.decide(messages.GATE_FAILED, rows, linked[failed], links[failed], distance[failed])
        ripe = np.flatnonzero(tracks.fails[linked] >= self.config.break_after)
        if len(ripe):
            # of one global track only the worst leaves at a time: farthest, then youngest, then last in order
            order = np.lexsort((-ripe, -tracks.since[linked[ripe]], -distance[ripe], links[ripe]))
            first = np.append(True, links[ripe][order][1:] != links[ripe][order][:-1])
            worst = ripe[order][first]
            journal.broke(rows, linked[worst], links[worst], distance[worst])
            tracks.link[linked[worst]] = NO_TRACK
            tracks.fails[linked] = np.where(np.isin(links, links[worst]), 0, tracks.fails[linked])
        stays = (tracks.link[linked] != NO_TRACK) & ~failed
        journal.decide(messages.KEPT, rows, linked[stays], links[stays], distance[stays])

    def link(
        self, rows: Rows, picture: Picture, now: Picture, meeting: Meeting, step: int, time: int, journal: Journal
    ) -> tuple[Picture, list[Agreement]]:
        """Link free tracks to global tracks or to each other, and start new ones.

        now: the picture predicted to `time`; where local tracks stand in a global track their fusion takes its
        place. Returns the picture with its new tracks, and the pairs of global tracks that agree and share no
        source.
        """
        mean, covariance, masks, bits = self._nodes(rows, picture, now.mean, now.covariance)
        free = np.flatnonzero((rows.tracks.link == NO_TRACK) & ~meeting.held)
        known = np.flatnonzero(picture.time >= 0)
        count = len(known)
        mean = np.concatenate([mean[:, known], rows.tracks.mean[:, free]], axis=1)
        covariance = np.concatenate([covariance[:, :, known], rows.tracks.covariance[:, :, free]], axis=2)
        masks = np.concatenate([masks[known], bits[free]])
        source = np.concatenate([np.full(count, -1), rows.source[free]])
        parts = _components(now, known, rows, free)
        i, j, distance, spread = self._gated(mean, covariance, masks, source, parts)
        i, j, distance, spread = _meeting(meeting, i, j, distance, spread, known, free)
        both = j < count
        agreements = [
            (int(picture.id[known[a]]), int(picture.id[known[b]]), float(d))
            for a, b, d in zip(i[both], j[both], distance[both], strict=True)
        ]
        if len(free):
            nodes = np.arange(len(source))
            root = np.array(cluster(i[~both], j[~both], (distance + spread)[~both], masks, nodes < count)[0])
            key, wanted = i * len(nodes) + j, (root * len(nodes) + nodes)[count:]
            at = np.minimum(np.searchsorted(key, wanted), max(len(key) - 1, 0))
            to_root = np.full(len(free), np.nan)
            if len(key):
                to_root = np.where(key[at] == wanted, distance[at], np.nan)
            picture = self._settle(rows, free, picture, known, root, to_root, step, time, journal)
        return picture, agreements

    def _nodes(
        self, rows: Rows, picture: Picture, mean: Floats, covariance: Floats
    ) -> tuple[Floats, Floats, NDArray[Any], NDArray[Any]]:
        """State of every global track and the sources in it as bits; the bit of every row's source."""
        tracks, linked = rows.tracks, rows.linked()
        bits = _bits(rows.source)
        masks = np.zeros(len(picture.id), dtype=bits.dtype)
        mean, covariance = mean.copy(), covariance.copy()
        for ids, members in by_size(tracks.link[linked]):
            at, chosen = picture.find(ids), linked[members]
            mean[:, at], covariance[:, :, at] = uniform_ci(
                np.moveaxis(tracks.mean[:, chosen], 2, 0), np.moveaxis(tracks.covariance[:, :, chosen], 3, 0)
            )
            masks[at] = np.bitwise_or.reduce(bits[chosen], axis=1)
        return mean, covariance, masks, bits

    def _gated(
        self, mean: Floats, covariance: Floats, masks: NDArray[Any], source: Ints, parts: Mixtures | None
    ) -> tuple[Ints, Ints, Floats, Floats]:
        """Pairs i < j within the gate that share no source, in order, with d2 and log det; of mixtures, the d2
        of their nearest components and what d2 + log det would be for their overlap, less that d2."""
        sigma = np.sqrt(sum(covariance[place, place] for place in self._places))
        i, j = candidate_pairs(mean[self._places], sigma, float(np.sqrt(self._gate)), source)
        disjoint = (masks[i] & masks[j]) == 0
        i, j = i[disjoint], j[disjoint]
        distance, spread = pair_distance(mean, covariance, i, j)
        if parts is not None:
            several = np.isfinite(parts.log_weights).sum(axis=0) > 1
            at = np.flatnonzero(several[i] | several[j])
            distance[at], spread[at] = overlap(parts.take(i[at]), parts.take(j[at]))
        near = distance <= self._gate
        return i[near], j[near], distance[near], spread[near]

    def _settle(
        self,
        rows: Rows,
        free: Ints,
        picture: Picture,
        known: Ints,
        root: Ints,
        distance: Floats,
        step: int,
        time: int,
        journal: Journal,
    ) -> Picture:
        """Give every free track of a cluster its global track, a new one where the cluster has none."""
        tracks, count = rows.tracks, len(known)
        roots = root[count:]
        starting = np.unique(roots[(roots >= count) & rows.may_start[free]])
        room = max(0, self._most - len(picture.id))
        if len(starting) > room:
            journal.refuse(Entry("", 0, 0, 0, "too-many-tracks", len(starting) - room))
            starting = starting[:room]
        new_ids = self._ids.allot(len(starting))
        ids = np.zeros(len(root), dtype=np.uint64)
        ids[:count] = picture.id[known]
        ids[starting] = new_ids
        given = ids[roots]
        takes = given != NO_TRACK
        tracks.link[free] = given
        tracks.since[free[takes]] = step
        tracks.fails[free[takes]] = 0
        tracks.used[free[takes]] = -1
        journal.decide(messages.LINKED, rows, free[takes], given[takes], distance[takes])
        journal.birth(new_ids)
        born = set(new_ids.tolist())
        for row, old in journal.broken.items():
            link = int(tracks.link[row])
            if link in born:
                journal.split(link, old)
        return picture.join(newborn(new_ids, len(self.config.space), time))

    def merge(self, rows: Rows, agreements: list[Agreement], step: int, journal: Journal) -> dict[int, int]:
        """Join global tracks that have agreed for several steps in a row: {id that ends: older id that goes on}."""
        self.agreeing = {(a, b): self.agreeing.get((a, b), 0) + 1 for a, b, _ in agreements}
        ripe = [(d, a, b) for a, b, d in agreements if self.agreeing[a, b] >= self.config.merge_after]
        merged: dict[int, int] = {}
        taken: set[int] = set()
        for distance, old, new in sorted(ripe):
            if not taken & {old, new}:
                taken |= {old, new}
                merged[new] = old
                journal.merge(old, new, distance)
                moved = rows.tracks.link == np.uint64(new)
                rows.tracks.link[moved] = np.uint64(old)
                rows.tracks.since[moved] = step
        self.agreeing = {pair: count for pair, count in self.agreeing.items() if not taken & set(pair)}
        return merged


def _meeting(
    meeting: Meeting, i: Ints, j: Ints, distance: Floats, spread: Floats, known: Ints, free: Ints
) -> tuple[Ints, Ints, Floats, Floats]:
    """The pairs that may meet, ranked by what they are said to be too."""
    count, forbidden, spread = len(known), np.zeros(len(i), dtype=np.bool_), spread.copy()
    pairs, mixed, ours = i >= count, (i < count) & (j >= count), j < count
    for mask, terms in (
        (pairs, meeting.with_rows(free[i[pairs] - count], free[j[pairs] - count])),
        (mixed, meeting.with_tracks(free[j[mixed] - count], known[i[mixed]])),
    ):
        spread[mask] -= 2.0 * terms.ratio
        forbidden[mask] = terms.forbidden
    forbidden[ours] = meeting.of_tracks(known[i[ours]], known[j[ours]])
    return i[~forbidden], j[~forbidden], distance[~forbidden], spread[~forbidden]


def _components(now: Picture, known: Ints, rows: Rows, free: Ints) -> Mixtures | None:
    """The densities of the global tracks and the free rows as mixtures, where any of them is one."""
    if not len(now.log_weight) and not len(rows.tracks.log_weight):
        return None
    return Mixtures.joined([now.mixtures(known), rows.tracks.mixtures(free)])


def _bits(source: Ints) -> NDArray[Any]:
    """One bit per source: int64 while they fit, Python integers beyond."""
    if source.max(initial=0) < 62:
        return np.left_shift(1, source)
    wide = np.empty(len(source), dtype=object)
    wide[:] = [1 << int(index) for index in source]
    return wide
