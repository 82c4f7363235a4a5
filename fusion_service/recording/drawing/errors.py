"""How far the global tracks are from the truth, step by step, where there is truth.

At each global step every true object is interpolated linearly to the step's time and assigned to a track as
GOSPA does (p = 2, alpha = 2): a pair costs its squared distance and counts only within the cut-off c.
Tentative tracks are left out. NEES is that of the position, divided by its dimension, so that 1 is ideal.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service import geodesy, metrics
from fusion_service.arrays import Floats
from fusion_service.recording.columns import Stamp
from fusion_service.recording.drawing.geometry import track_moments
from schemas import STATUSES, GlobalTracks, Truth

__all__ = ["StepErrors", "TruthMatcher"]


HELD = 512
"""Truth messages of a scenario, and global steps of a centre, that wait for each other."""
HELD_TRACKS = 50_000
"""Of those steps together: a mission without truth holds no more."""
SPREADS = 10.0
SMALLEST = 20.0
"""Without a given cut-off: so many typical standard deviations of the position, and at least so many metres."""


class StepErrors(NamedTuple):
    """One global step of `centre`: for each true object (T,) the distance (m) and NEES / dimension of the track
    that is assigned to it, NaN without one, and the track's id (0: none); `bounds`: where the mean NEES lies with 95 %
    for a consistent centre."""

    centre: str
    stamp: Stamp
    ids: NDArray[np.uint64]
    error: Floats
    nees: Floats
    dimension: int
    tracks: NDArray[np.uint64]

    @property
    def assigned(self) -> int:
        """How many true objects have a track."""
        return int(np.isfinite(self.nees).sum())

    @property
    def bounds(self) -> tuple[float, float]:
        """Of the mean NEES over its dimension; NaN where no object has a track."""
        return metrics.nees_bounds(self.dimension, self.assigned) if self.assigned else (np.nan, np.nan)


class TruthMatcher:
    """Matches global steps with truth as both come, in any order. `cutoff`: m, None chooses one for each step."""

    def __init__(self, cutoff: float | None = None) -> None:
        self._cutoff = cutoff
        self._truth: dict[str, list[Truth]] = {}
        self._steps: deque[tuple[GlobalTracks, Stamp]] = deque(maxlen=HELD)

    def truth(self, message: Truth) -> None:
        """Truth, as it comes; a new epoch takes the place of the old one."""
        held = self._truth.setdefault(message.source, [])
        if held and held[-1].epoch != message.epoch:
            held.clear()
        insort(held, message, key=lambda item: item.time)
        del held[:-HELD]

    def step(self, message: GlobalTracks, stamp: Stamp) -> None:
        """A global step, as it comes; its errors are told at `stamp`."""
        self._steps.append((message, stamp))
        held = sum(len(one.ids) for one, _ in self._steps)
        while held > HELD_TRACKS and len(self._steps) > 1:
            held -= len(self._steps.popleft()[0].ids)

    def matched(self) -> Iterator[StepErrors]:
        """Every step whose time the truth has reached; the others wait for it. `geodesy.FrameError` where the
        truth has no place in the frame of the tracks: that step is left out."""
        waiting = list(self._steps)
        self._steps.clear()
        while waiting:
            message, stamp = waiting.pop(0)
            times = [held[-1].time for held in self._truth.values()]
            if not times or max(times) < message.time:
                self._steps.append((message, stamp))
                continue
            for held in self._truth.values():
                try:
                    found = _truth_at(held, message)
                except geodesy.FrameError:
                    self._steps.extend(waiting)
                    raise
                if found is not None:
                    yield self._score(message, stamp, *found)

    def _score(
        self,
        message: GlobalTracks,
        stamp: Stamp,
        ids: NDArray[np.uint64],
        positions: Floats,
        names: tuple[str, ...],
    ) -> StepErrors:
        index = [message.space.index(name) for name in names]
        means, covariances = track_moments(message)
        shown = np.flatnonzero(message.status != STATUSES.index("tentative"))
        means, covariances = means[shown][:, index], covariances[shown][:, index][:, :, index]
        sound = np.isfinite(means).all(axis=1) & (np.linalg.det(covariances) > 0)
        means, covariances, shown = means[sound], covariances[sound], shown[sound]
        spread = np.sqrt(np.trace(covariances, axis1=1, axis2=2) / len(names))
        typical = float(np.median(spread)) if len(spread) else 0.0
        cutoff = self._cutoff or max(SMALLEST, SPREADS * typical)
        assignment = metrics.gospa(positions, means, cutoff).assignment
        error, nees = np.full(len(ids), np.nan), np.full(len(ids), np.nan)
        found = np.flatnonzero(assignment >= 0)
        apart = positions[found] - means[assignment[found]]
        error[found] = np.sqrt((apart * apart).sum(axis=1))
        nees[found] = metrics.nees(apart, covariances[assignment[found]]) / len(names)
        tracks = np.zeros(len(ids), dtype=np.uint64)
        tracks[found] = message.ids[shown[assignment[found]]]
        return StepErrors(message.source, stamp, ids, error, nees, len(names), tracks)


def _truth_at(held: list[Truth], message: GlobalTracks) -> tuple[NDArray[np.uint64], Floats, tuple[str, ...]] | None:
    """Ids (T,), positions (T, d) in the frame of `message` at its time, and the names of the components; None
    where the truth does not reach around that time."""
    after = bisect_left(held, message.time, key=lambda item: item.time)
    if after == len(held) or (after == 0 and held[0].time != message.time):
        return None
    late = held[after]
    ids, positions, names = _positions(late, message)
    if late.time != message.time:
        early = held[after - 1]
        early_ids, early_positions, _ = _positions(early, message)
        ids, first, second = np.intersect1d(early_ids, ids, assume_unique=True, return_indices=True)
        part = (message.time - early.time) / (late.time - early.time)
        positions = (1 - part) * early_positions[first] + part * positions[second]
    return ids, positions, names


def _positions(truth: Truth, message: GlobalTracks) -> tuple[NDArray[np.uint64], Floats, tuple[str, ...]]:
    own = tuple(name for name in "xyz" if name in truth.space)
    index = [truth.space.index(name) for name in own]
    nothing = np.zeros((len(truth.ids), len(own), len(own)))
    means, _ = geodesy.transform(truth.means[:, index], nothing, own, truth.frame, message.frame)
    names = tuple(name for name in own if name in message.space)
    good = np.isfinite(means).all(axis=1)
    return truth.ids[good], means[good][:, [own.index(name) for name in names]], names
