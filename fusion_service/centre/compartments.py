"""`Compartments`: which tracks may meet at all. Live, exercise, simulated and replayed tracks are never fused together
(unless `fuse_origins`), nor those of a source in quarantine with any other's.

A compartment is a number: that of the origin, and above it the source where it is in quarantine. A local track and a
global one, or two of either, of different compartments are no pair.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import among, any_of, filled, find_sorted, marked
from fusion_service.centre.intake import Intake
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.sources import Source
from fusion_service.centre.words import NONE, Codes, Words
from schemas import ORIGINS

__all__ = ["Compartments", "origin_codes"]

Ids = NDArray[np.uint64]
Numbers = NDArray[np.int64]
Origins = NDArray[np.uint8]


def origin_codes(names: tuple[str, ...], sources: Mapping[str, Source]) -> Origins:
    """The origin of what each source sent last, as index into `ORIGINS`. (The tracks' own is in their column.)"""
    return np.array([ORIGINS.index(sources[name].origin) for name in names], dtype=np.uint8)


class Compartments:
    """Origin and quarantine of every global track. track (G,) u64: those of the last step; origin (G,) u8; apart (G,)
    code of the source in quarantine that it is of, -1: of none."""

    def __init__(self, intake: Intake) -> None:
        self._intake = intake
        self._names = Words()
        self.track: Ids = np.zeros(0, dtype=np.uint64)
        self.origin: Origins = np.zeros(0, dtype=np.uint8)
        self.apart: Codes = np.zeros(0, dtype=np.int32)

    def of_rows(self, rows: Rows, names: tuple[str, ...]) -> Numbers:
        """(M,): compartment of each row; names: all sources, sorted."""
        return self._number(rows.tracks.origin, self._rows_apart(rows, names))

    def of_tracks(self, ids: Ids, rows: Rows, names: tuple[str, ...]) -> Numbers:
        """(G,): compartment of global tracks, sorted: that of the rows linked to them, else what it was."""
        return self._number(*self._now(ids, rows, names))

    def follow(self, ids: Ids, rows: Rows, names: tuple[str, ...]) -> None:
        """After a step: ids (G,) sorted, of its picture; rows with the links of the step."""
        origin, apart = self._now(ids, rows, names)
        still = self._quarantined()
        if len(still):
            apart = np.where(among(apart, still), apart, NONE).astype(np.int32)
        else:
            apart = filled(len(ids), NONE, np.int32)
        self.track, self.origin, self.apart = ids, origin, apart
        if not len(still) and len(self._names.texts) > len(ORIGINS):
            self._names = Words()

    def _number(self, origin: Origins, apart: Codes) -> Numbers:
        least = np.zeros_like(origin) if self._intake.config.fuse_origins else origin
        return least.astype(np.int64) + len(ORIGINS) * (apart.astype(np.int64) + 1)

    def _quarantined(self) -> Codes:
        return self._names.codes(sorted(self._intake.orders.about("quarantine")))

    def _rows_apart(self, rows: Rows, names: tuple[str, ...]) -> Codes:
        quarantined = self._intake.orders.about("quarantine")
        if not quarantined:
            return filled(len(rows.source), NONE, np.int32)
        codes = self._names.codes([name if name in quarantined else None for name in names])
        return codes[rows.source] if len(codes) else np.zeros(0, dtype=np.int32)

    def _now(self, ids: Ids, rows: Rows, names: tuple[str, ...]) -> tuple[Origins, Codes]:
        origin, apart = np.zeros(len(ids), dtype=np.uint8), filled(len(ids), NONE, np.int32)
        plain = not (self.origin.any() or rows.tracks.origin.any() or any_of(self.apart != NONE))
        if not len(ids) or (plain and not self._intake.orders.about("quarantine")):
            return origin, apart
        if len(self.track):
            at = np.minimum(find_sorted(self.track, ids), len(self.track) - 1)
            known = self.track[at] == ids
            origin[known], apart[known] = self.origin[at[known]], self.apart[at[known]]
        link = rows.tracks.link
        at = np.minimum(find_sorted(ids, link), len(ids) - 1)
        linked = marked((link != NO_TRACK) & (ids[at] == link))
        at = at[linked]
        origin[at], apart[at] = 0, np.iinfo(np.int32).max
        np.maximum.at(origin, at, rows.tracks.origin[linked])
        np.minimum.at(apart, at, self._rows_apart(rows, names)[linked])
        return origin, apart

    def kept(self) -> dict[str, Any]:
        """What a checkpoint holds of it, as plain values."""
        columns = {"track": self.track.astype("<u8"), "origin": self.origin, "apart": self.apart.astype("<i4")}
        return {"names": self._names.texts, **{name: column.tobytes() for name, column in columns.items()}}

    def restore(self, kept: Mapping[str, Any]) -> None:
        """Go on with what `kept` gave."""
        self._names = Words(kept["names"])
        self.track = np.frombuffer(kept["track"], "<u8").astype(np.uint64)
        self.origin = np.frombuffer(kept["origin"], np.uint8)
        self.apart = np.frombuffer(kept["apart"], "<i4").astype(np.int32)
        if not len(self.track) == len(self.origin) == len(self.apart):
            raise ValueError("columns of compartments of different lengths")
