"""What is drawn now of one entity: places of tracks, or of the components of their mixtures, and how much each holds.

`mass` is the number of objects expected there: the existence of a track, the weight of a component. It is drawn as
one of `LEVELS` opacities and as a width; what is tentative is fainter.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.recording.drawing.geometry import Place
from schemas import STATUSES, GlobalTracks, LocalIntensity, LocalTracks

__all__ = ["COASTING", "LEVELS", "Table", "drawn_components", "hold", "levels", "remember", "tabulate"]

U64 = NDArray[np.uint64]
Codes = NDArray[np.uint8]
T = TypeVar("T")

TENTATIVE, COASTING = STATUSES.index("tentative"), STATUSES.index("coasting")
LEVELS = 16
FAINTER = np.array([0.35, 1.0, 0.67])
"""Of tentative, confirmed and coasting tracks."""
LIGHT = 0.01
MAX_COMPONENTS = 2000
"""Components that weigh less than `LIGHT`, and of one message all but the heaviest, are not drawn."""
TOLD, TOLD_TRACKS = 64, 5000
"""Newest messages of a source, and tracks in them, among which that is sought which a step could know: in a fast
playback the sources are far ahead of the centre."""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """T rows of one run of a source: ids (T,) of the tracks, times (T,) when they held, ns, place, codes (T,) of the
    tracks' status and mass (T,)."""

    epoch: int
    ids: U64
    times: NDArray[np.int64]
    place: Place
    codes: Codes
    mass: Floats

    def part(self, rows: NDArray[Any]) -> Table:
        """Some of the rows, by numbers or by a mask (T,)."""
        place = Place(*(column[rows] for column in self.place))
        return Table(self.epoch, self.ids[rows], self.times[rows], place, self.codes[rows], self.mass[rows])


def tabulate(
    epoch: int, time: int, ids: U64, place: Place, codes: Codes | None = None, mass: Floats | None = None
) -> Table:
    """A table of one message, without what is not to be placed (its vertical misses the Earth). codes: None for
    confirmed; mass: None for 1."""
    codes = np.ones(len(ids), dtype=np.uint8) if codes is None else codes
    mass = np.ones(len(ids)) if mass is None else mass
    table = Table(epoch, ids, np.full(len(ids), time), place, codes, mass)
    good = np.isfinite(place.xy).all(axis=1) & np.isfinite(place.covariance).all(axis=(1, 2))
    return table if good.all() else table.part(np.flatnonzero(good))


class DrawnComponents(NamedTuple):
    """Which components (C,) of a message are drawn, the track (C,) of each (of an intensity, itself), their weights
    (C,), and how many are too many."""

    rows: NDArray[np.intp]
    owner: NDArray[np.intp]
    weights: Floats
    over: int


def drawn_components(message: LocalTracks | GlobalTracks | LocalIntensity, sound: NDArray[np.bool_]) -> DrawnComponents:
    """In the order of the message, without that of a track that has only one. `sound` (T,)."""
    if isinstance(message, LocalIntensity):
        owner = np.arange(len(message.weights))
        weights, shown = message.weights, sound
    elif message.counts is None or message.weights is None:
        nothing = np.zeros(0, dtype=np.intp)
        return DrawnComponents(nothing, nothing, np.zeros(0), 0)
    else:
        owner = np.repeat(np.arange(len(message.counts)), message.counts)
        weights, shown = message.weights, (sound & (message.counts > 1))[owner]
    rows = np.flatnonzero(shown & (weights >= LIGHT))
    over = max(len(rows) - MAX_COMPONENTS, 0)
    if over:
        rows = np.sort(rows[np.argsort(-weights[rows], kind="stable")[:MAX_COMPONENTS]])
    return DrawnComponents(rows, owner[rows], weights[rows], over)


def hold(old: Table | None, new: Table, listed: U64, since: int) -> Table:
    """`new`, after the rows of `old` that held at `since` or later and whose tracks are not `listed`."""
    if old is None or old.epoch != new.epoch:
        return new
    standing = np.flatnonzero(~np.isin(old.ids, listed) & (old.times >= since))
    if not len(standing):
        return new
    first = old.part(standing)
    return Table(
        new.epoch,
        np.concatenate([first.ids, new.ids]),
        np.concatenate([first.times, new.times]),
        Place(*(np.concatenate(pair) for pair in zip(first.place, new.place, strict=True))),
        np.concatenate([first.codes, new.codes]),
        np.concatenate([first.mass, new.mass]),
    )


def levels(table: Table) -> NDArray[np.uint16]:
    """The opacity (T,) of each row, from 0 to LEVELS - 1."""
    mass: Floats = np.minimum(np.nan_to_num(table.mass), 1.0) * FAINTER[table.codes]
    level: NDArray[np.uint16] = np.rint((LEVELS - 1) * np.maximum(mass, 0.0)).astype(np.uint16)
    return level


def remember(told: deque[T], item: T, tracks: int) -> None:
    """Add `item`, and drop the oldest so that at most `TOLD` stay, and no more than `TOLD_TRACKS` if all have `tracks`
    tracks."""
    told.append(item)
    while len(told) > max(1, min(TOLD, TOLD_TRACKS // max(tracks, 1))):
        told.popleft()
