"""`Meeting`: who may meet whom in one step, and what identity says for it: all that association asks, in one place.

It puts together operators' orders (`constraints`), origin and quarantine (`compartments`), and identities.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre.constraints import constraints
from fusion_service.centre.identity import TRUSTED, Terms
from fusion_service.centre.intake import Intake
from fusion_service.centre.labels import Labels
from fusion_service.centre.rows import Rows
from fusion_service.centre.words import NONE

__all__ = ["Meeting"]

Ints = NDArray[np.intp]
Ids = NDArray[np.uint64]
Mask = NDArray[np.bool_]


class Meeting:
    """For the rows and the global tracks (ids, sorted) of one step; names: all sources, sorted.

    held (M,): rows that neither start nor join a track. forced_row, forced_track (L,): pairs to be linked, gate or
    no gate. Links are those that the rows have when this is made.
    """

    def __init__(self, intake: Intake, labels: Labels, rows: Rows, ids: Ids, names: tuple[str, ...]) -> None:
        self._rows, self._ids, self._identities = rows, ids, labels.identities
        self._orders = constraints(intake.orders, rows, names)
        self._of_rows = labels.compartments.of_rows(rows, names)
        self._of_tracks = labels.compartments.of_tracks(ids, rows, names)
        self.held = self._orders.held
        self.forced_row, self.forced_track = self._orders.forced_row, self._orders.forced_track

    def with_tracks(self, row: Ints, at: Ints) -> Terms:
        """Of P pairs of a row and a global track (its place in `ids`): the log-likelihood ratio, by what they are said
        to be, of one object to two, and which are forbidden."""
        terms = self._identities.terms(self._rows, row, self._ids[at])
        forbidden = terms.forbidden | (self._of_rows[row] != self._of_tracks[at])
        return Terms(terms.ratio, forbidden | self._orders.forbids(row, self._ids[at]))

    def with_rows(self, i: Ints, j: Ints) -> Terms:
        """The same of P pairs of rows."""
        terms = self._identities.row_terms(self._rows, i, j)
        forbidden = terms.forbidden | (self._of_rows[i] != self._of_rows[j])
        return Terms(terms.ratio, forbidden | self._orders.parts(i, j))

    def of_tracks(self, a: Ints, b: Ints) -> Mask:
        """Of P pairs of global tracks (places in `ids`), those never to be merged."""
        forbidden: Mask = self._of_tracks[a] != self._of_tracks[b]
        code, p = self._identities.named(self._ids)
        both = (code[a] != NONE) & (code[b] != NONE) & (p[a] >= TRUSTED) & (p[b] >= TRUSTED)
        if both.any():
            schemes = self._identities.schemes()
            forbidden |= both & (schemes[code[a]] == schemes[code[b]]) & (code[a] != code[b])
        if len(self._orders.separate):
            low, high = np.minimum(self._ids[a], self._ids[b]), np.maximum(self._ids[a], self._ids[b])
            for first, second in self._orders.separate.tolist():
                forbidden |= (low == np.uint64(first)) & (high == np.uint64(second))
        return forbidden
