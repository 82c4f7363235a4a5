"""`Meeting`: who may meet whom in one step, and what identity says for it: all that association asks, in one place.

It puts together operators' orders (`constraints`), origin and quarantine (`compartments`), and identities.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Ints, among
from fusion_service.centre.constraints import constraints
from fusion_service.centre.identity import TRUSTED, Terms
from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.labels import Labels
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.tracks import set_links
from fusion_service.centre.words import NONE, Codes
from schemas import messages

__all__ = ["Meeting"]

Ids = NDArray[np.uint64]
Mask = NDArray[np.bool_]
MOST_NAMESAKES = 4
"""Tracks that are trusted to be one and the same thing, which a row that says so is compared with."""


NOWHERE: Ints = np.zeros(0, dtype=np.intp)
NOBODY: Ids = np.zeros((0, 2), dtype=np.uint64)


class Meeting:
    """For the rows and the global tracks (ids, sorted) of one step; names: all sources, sorted; unmerged (K, 2): ids of
    tracks that are not to be merged in it.

    held (M,): rows that neither start nor join a track. forced_row, forced_track (L,): pairs to be linked, gate or
    no gate. compartment_of_rows (M,), compartment_of_tracks (G,): those of different ones are no pair. Links are
    those that the rows have when this is made.
    """

    def __init__(
        self, intake: Intake, labels: Labels, rows: Rows, ids: Ids, names: tuple[str, ...], unmerged: Ids = NOBODY
    ) -> None:
        self._rows, self._ids, self._identities, self._names = rows, ids, labels.identities, names
        self._said = intake.said.identity
        self._orders = constraints(intake.orders, rows, names)
        self.compartment_of_rows = labels.compartments.of_rows(rows, names)
        self.compartment_of_tracks = labels.compartments.of_tracks(ids, rows, names)
        self.held = self._orders.held
        self._separate = [*self._orders.separate.tolist(), *unmerged.tolist()]
        there = among(self._orders.forced_track, ids)
        self.forced_row, self.forced_track = self._orders.forced_row[there], self._orders.forced_track[there]

    def settle(self, step: int, journal: Journal) -> None:
        """Make at once the links that are ordered, and break those that must not be."""
        tracks = self._rows.tracks
        bad = self._unwanted()
        if not len(bad) and not len(self.forced_row):
            return
        journal.broke(self._rows, bad, tracks.link[bad], np.full(len(bad), np.nan))
        set_links(tracks, bad, NO_TRACK, step)
        other = tracks.link[self.forced_row] != self.forced_track
        row, track = self.forced_row[other], self.forced_track[other]
        journal.decide(messages.LINKED, self._rows, row, track, np.full(len(row), np.nan))
        set_links(tracks, row, track, step)

    def _unwanted(self) -> Ints:
        """The rows whose standing links an order forbids, or another row of the track that is trusted to be another
        object. Of two rows that are never to be together the second leaves, unless it is linked by order."""
        linked, link, orders = self._rows.linked(), self._rows.tracks.link, self._orders
        if not (len(orders.apart_i) or len(orders.forbidden_row)) and (self._rows.tracks.identity == NONE).all():
            return linked[:0]
        together = (link[orders.apart_i] == link[orders.apart_j]) & (link[orders.apart_i] != NO_TRACK)
        i, j = orders.apart_i[together], orders.apart_j[together]
        leaves = np.where(among(j, self.forced_row), i, j)
        stays = np.setdiff1d(np.concatenate([i, j]), leaves)
        bad = orders.forbids(linked, link[linked]) & ~among(linked, stays)
        odd = self._identities.contradicted(self._rows, linked, self.forced_row)
        bad |= among(linked, odd)
        return linked[bad & ~among(linked, self.forced_row)]

    def with_tracks(self, row: Ints, at: Ints) -> Terms:
        """Of P pairs of a row and a global track (its place in `ids`): the log-likelihood ratio, by what they are said
        to be, of one object to two, and which are forbidden."""
        terms = self._identities.terms(self._rows, row, self._ids[at])
        forbidden = terms.forbidden | self._identities.denied(self._rows, row, self._ids[at])
        forbidden |= self.compartment_of_rows[row] != self.compartment_of_tracks[at]
        return Terms(terms.ratio, forbidden | self._orders.forbids(row, self._ids[at]))

    def with_rows(self, i: Ints, j: Ints) -> Terms:
        """The same of P pairs of rows."""
        terms = self._identities.row_terms(self._rows, i, j)
        forbidden = terms.forbidden | (self.compartment_of_rows[i] != self.compartment_of_rows[j])
        return Terms(terms.ratio, forbidden | self._orders.parts(i, j))

    def of_tracks(self, a: Ints, b: Ints) -> Mask:
        """Of P pairs of global tracks (places in `ids`), those never to be merged."""
        if not len(a):
            return np.zeros(0, dtype=np.bool_)
        forbidden: Mask = self.compartment_of_tracks[a] != self.compartment_of_tracks[b]
        code, p = self._identities.named(self._ids)
        both = (code[a] != NONE) & (code[b] != NONE) & (p[a] >= TRUSTED) & (p[b] >= TRUSTED)
        if both.any():
            schemes = self._identities.schemes()
            forbidden |= both & (schemes[code[a]] == schemes[code[b]]) & (code[a] != code[b])
        if self._separate:
            low, high = np.minimum(self._ids[a], self._ids[b]), np.maximum(self._ids[a], self._ids[b])
            for first, second in self._separate:
                forbidden |= (low == np.uint64(first)) & (high == np.uint64(second))
        return forbidden

    def taken(self, row: Ints, at: Ints) -> Mask:
        """Of P pairs of a row and a global track (its place in `ids`), those whose place another row of the source has
        by order."""
        if not len(self.forced_row):
            return np.zeros(len(row), dtype=np.bool_)
        source, width = self._rows.source, max(len(self._ids), 1)
        keys = source[self.forced_row] * width + np.searchsorted(self._ids, self.forced_track)
        return among(source[row] * width + at, keys) & ~among(row, self.forced_row)

    def key_of(self, row: int) -> tuple[str, int, int]:
        """Source, epoch and local id of a row."""
        rows = self._rows
        return self._names[int(rows.source[row])], int(rows.epoch[row]), int(rows.tracks.id[row])

    def identity_texts(self, code: Codes) -> list[str]:
        """Identities by code."""
        return [text or "" for text in self._said.said(code)]

    def namesakes(self, row: Ints) -> tuple[Ints, Ints, Codes]:
        """Pairs (K,) of one of these rows and a global track (its place in `ids`) that both are trusted to be the same
        thing, and may be; of each thing the `MOST_NAMESAKES` oldest tracks. And what that is."""
        said, code = self._identities.trusted_rows(self._rows, row)
        if not len(said):
            return said, said, code
        track, of = self._known()
        low, high = np.searchsorted(of, code, "left"), np.searchsorted(of, code, "right")
        many = np.minimum(high - low, MOST_NAMESAKES)
        pair = np.repeat(np.arange(len(said)), many)
        place = np.repeat(low - (np.cumsum(many) - many), many) + np.arange(len(pair))
        mine, at = said[pair], track[place]
        allowed = ~self.with_tracks(mine, at).forbidden & ~self.held[mine]
        return mine[allowed], at[allowed], code[pair][allowed]

    def namesake_tracks(self, most: int) -> tuple[Ints, Ints]:
        """Pairs (K,) of global tracks (places in `ids`) that are trusted to be the same thing, and may be: the oldest
        with each other one; at most so many."""
        if not self._identities.believes:
            return NOWHERE, NOWHERE
        track, of = self._known()
        oldest = track[np.searchsorted(of, of, "left")] if len(of) else track
        other = np.flatnonzero(track != oldest)[:most]
        first, second = oldest[other], track[other]
        allowed = ~self.of_tracks(first, second)
        return first[allowed], second[allowed]

    def _known(self) -> tuple[Ints, Codes]:
        """The global tracks (places in `ids`) that are trusted to be something, by code and then by age; and the
        codes."""
        ids, code = self._identities.trusted_tracks()
        there = among(ids, self._ids)
        at, code = np.searchsorted(self._ids, ids[there]), code[there]
        order = np.lexsort((at, code))
        return at[order], code[order]
