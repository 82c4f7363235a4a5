"""`Labels`: what a centre knows of its tracks beside their densities: what they are, whose, and how they are called.

It stands beside the picture, follows it step by step, and says what it means for pairs (its parts do) and for what
is published (`columns`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import any_of, find_sorted
from fusion_service.centre.alarms import Twice
from fusion_service.centre.compartments import Compartments
from fusion_service.centre.identity import TRUSTED, Identities
from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.rows import Rows
from fusion_service.centre.words import NONE
from schemas import ORIGINS
from schemas.messages import APART, IDENTITY_ORDERED, IDENTITY_TWICE

__all__ = ["Labels"]

Ids = NDArray[np.uint64]


class Labels:
    """Identities, compartments, alarms and given names of the global tracks."""

    def __init__(self, intake: Intake) -> None:
        self._intake = intake
        self.identities = Identities(intake)
        self.compartments = Compartments(intake)
        self.twice = Twice()
        self._places = [intake.config.space.index(axis) for axis in ("x", "y", "z") if axis in intake.config.space]

    def follow(
        self,
        rows: Rows,
        picture: Picture,
        names: tuple[str, ...],
        heirs: Mapping[int, int],
        time: int,
        journal: Journal,
    ) -> None:
        """After a step at `time`, ns, from its rows with their links and its picture; names: all sources, sorted;
        heirs: {id that ended: id that goes on for it}."""
        self.identities.follow(rows, picture.id, heirs)
        self.compartments.follow(picture.id, rows, names)
        if not (self.identities.believes or self.identities.ordered() or self.twice.standing):
            self.identities.compact()
            return
        code, p = self.identities.named(picture.id)
        trusted = (code != NONE) & (p >= TRUSTED)
        if trusted.any() or self.twice.standing:
            said = self._intake.said.identity.said(code)
            meets = self.compartments.of_tracks(picture.id, rows, names)
            self.twice.follow(picture, said, trusted, meets, self._places, time, journal)
        self.identities.compact()

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns: nothing that is known is later."""
        self.twice.rebase(time)

    def columns(self, ids: Ids, origin: str) -> dict[str, Any]:
        """The optional columns of `GlobalTracks` for some tracks of the last step, sorted; without those that say
        nothing. origin: of the message."""
        identity, identity_p = self.identities.named(ids)
        kind, kind_p = self.identities.classed(ids)
        at = find_sorted(self.compartments.track, ids)
        said, marks = self._intake.said, self._marks(ids, at)
        number, callsign = self._called(ids)
        # an intensity is of all sources, and so are its tracks
        own = self.compartments.origin[at] if self._intake.config.kind == "tracks" else np.zeros(0, dtype=np.uint8)
        called: dict[str, Any] = {}
        if any_of(identity != NONE):
            called |= {"identity": said.identity.said(identity), "identity_p": identity_p}
        if any_of(kind != NONE):
            called |= {"kind": said.kind.said(kind), "kind_p": kind_p}
        return {
            **called,
            **_if(any_of(own != ORIGINS.index(origin)), track_origin=own),
            **_if(marks.any(), marks=marks),
            **_if(number.any(), number=number),
            **_if(any(callsign), callsign=tuple(callsign)),
        }

    def _marks(self, ids: Ids, at: NDArray[np.intp]) -> NDArray[np.uint8]:
        twice, ordered = ([*some] for some in (self.twice.tracks(), self.identities.ordered()))
        marks = np.zeros(len(ids), dtype=np.uint8)
        marks[self.compartments.apart[at] != NONE] = APART
        for tracks, bit in ((twice, IDENTITY_TWICE), (ordered, IDENTITY_ORDERED)):
            if tracks:
                marks[np.isin(ids, np.array(tracks, dtype=np.uint64))] |= bit
        return marks

    def _called(self, ids: Ids) -> tuple[NDArray[np.uint32], list[str | None]]:
        number = np.zeros(len(ids), dtype=np.uint32)
        if not self._intake.orders.about("rename"):
            return number, []
        callsign: list[str | None] = [None] * len(ids)
        for one in self._intake.orders.standing.values():
            if one.order.what == "rename" and one.order.track is not None:
                for at in np.flatnonzero(ids == np.uint64(one.order.track)).tolist():
                    number[at], callsign[at] = one.order.shown, one.order.name or None
        return number, callsign

    def numbers(self) -> dict[str, int]:
        """Counts for the status, those that are not nought."""
        counts = {
            "identity_twice": len(self.twice.standing),
            "apart": int((self.compartments.apart != NONE).sum()),
            "orders": len(self._intake.orders.standing),
        }
        return {name: count for name, count in counts.items() if count}

    def kept(self) -> dict[str, Any]:
        """What a checkpoint holds of it, as plain values."""
        return {
            "identities": self.identities.kept(),
            "compartments": self.compartments.kept(),
            "twice": self.twice.kept(),
        }

    def restore(self, kept: Mapping[str, Any]) -> None:
        """Go on with what `kept` gave."""
        self.identities.restore(kept["identities"])
        self.compartments.restore(kept["compartments"])
        self.twice.restore(kept["twice"])


def _if(said: bool | np.bool_, **columns: Any) -> dict[str, Any]:
    return columns if said else {}
