"""What requirements are counted on: which shown track followed which target at each scored time, and what it said.

Scored as `evaluate` does (`evaluation`): at the times of a centre's pictures, or every so many seconds, from truth that
is interpolated between its messages; tracks are confirmed and coasting ones, assigned to targets nearer than the
cut-off by GOSPA. Horizontal is east and north at the place, height along its vertical.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.errors import ReviewError
from fusion_service.geodesy import ecef_to_geodetic, enu_to_geodetic, level_axes, vertical
from fusion_service.metrics import DENSE, assign_near, near_pairs
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.reference import Reference, ScoredTruth, reference_for, scored_truth
from fusion_service.review.snapshots import Block, ShownTracks, Times, TrackMessage, truth_path, truth_positions
from schemas import Ecef, Enu, Frame, GlobalTracks, LocalTracks, Truth

__all__ = ["Observed", "Pairs", "Rest", "observe", "places_on_earth"]

SAME_CLOCK = 3600.0
NOTHING = -1
BLOCK = 32
"""Times looked at at once."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """R tracks at a scored time k with a target t: number of the track, offset (R, 3) east, north, up from the target,
    m (up NaN on the plane), velocity (R, 2) and its error (R, 2), m/s, identity (R,) as an index of
    `Observed.identities`, -1 for none, updated (R,) ns: the last measurement, place (R, d) in the frame, and apart
    (R,), m: to the nearest target, which may be another one."""

    k: Ints
    t: Ints
    number: Ints
    offset: Floats
    velocity: Floats
    error: Floats
    identity: Ints
    updated: Times
    place: Floats
    apart: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Rest:
    """S shown tracks without a target of their own: at the time k, place (S, d), m to the nearest target, inf
    without one."""

    k: Ints
    place: Floats
    apart: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """A centre's mission beside the truth: K times, T targets.

    exists, seen (K, T): where a target is, and where a source had a track of it; place (K, T, d), velocity (K, T, 2),
    m/s east and north, by truth's own word or from its places; height (K, T), m above the ellipsoid or z, NaN where it
    is not known; latency (P,), s, of the pictures, empty where they have no clock.
    """

    centre: str
    frame: Frame
    c: float
    times: Times
    targets: tuple[int, ...]
    exists: Bools
    place: Floats
    velocity: Floats
    height: Floats
    pairs: Pairs
    rest: Rest
    seen: Bools
    identities: tuple[str, ...]
    latency: Floats


def places_on_earth(place: Floats, frame: Frame) -> tuple[Floats, Floats, Floats]:
    """Latitude and longitude in degrees, and altitude in m, of places (R, d) in the frame. ReviewError for a local
    one."""
    x, y = place[:, 0], place[:, 1]
    z = place[:, 2] if place.shape[1] > 2 else np.zeros(len(place))
    if isinstance(frame, Enu):
        return enu_to_geodetic(x, y, z, frame)
    if isinstance(frame, Ecef):
        return ecef_to_geodetic(x, y, z)
    raise ReviewError("an area in degrees has no meaning in a local frame: give it in x and y, m")


def observe(
    book: Logbook,
    centre: str,
    truths: Sequence[Truth],
    c: float,
    *,
    every: float | None = None,
    gap: float = 5.0,
    sources: bool = False,
) -> Observed:
    """Go once through a mission. c: cut-off, m. sources: their tracks too, for `seen`. Raises `ReviewError` where there
    is nothing to score."""
    reference = reference_for(book, [centre], None, None, None, c)
    try:
        scored = scored_truth(truths, reference, book.times([centre]), every, gap)
    except ReviewError:
        raise
    except ValueError as error:
        raise ReviewError(f"the truth cannot be scored against: {error}") from None
    walk = _Walk(reference, scored, centre)
    wanted = {key for key in reference.motions if key[0] == "global" or sources}
    shown = {
        key: ShownTracks(
            reference.limits[key], reference.motions[key], reference.frame, reference.axes, reference.speeds
        )
        for key in wanted
    }
    stream = book.tracks(lambda kind, name: (kind, name) in shown)
    ahead = next(stream, None)
    for begin in range(0, len(scored.times), BLOCK):
        block = scored.times[begin : begin + BLOCK]
        came: dict[tuple[str, str], list[TrackMessage]] = {key: [] for key in shown}
        while ahead is not None and ahead.time <= block[-1]:
            came["local" if isinstance(ahead, LocalTracks) else "global", ahead.source].append(ahead)
            ahead = next(stream, None)
        for key, messages in came.items():
            shown[key].add(messages)
            if key[0] == "global":
                walk.hear(messages)
        for key, one in shown.items():
            found, pictures = one.show(block)
            for row in range(len(block)):
                if key[0] == "global":
                    walk.picture(begin + row, found, row, pictures[row], one)
                else:
                    walk.source(begin + row, found, row)
    return walk.result(truths)


class _Walk:
    def __init__(self, reference: Reference, scored: ScoredTruth, centre: str) -> None:
        self._reference, self._scored, self._centre = reference, scored, centre
        self._d = len(reference.axes)
        self._exists = np.isfinite(scored.states[:, :, 0])
        self._seen = np.zeros_like(self._exists)
        self._names: dict[str, int] = {}
        self._pairs: list[tuple[NDArray[np.generic], ...]] = []
        self._rest: list[tuple[NDArray[np.generic], ...]] = []
        self._delays: list[float] = []
        self._velocity = self._velocities()

    def _velocities(self) -> Floats:
        """(K, T, d) in the frame's axes: told, else from the places before and after."""
        states, d = self._scored.states, self._d
        told: Floats = states[:, :, d : 2 * d].copy()
        if len(states) > 1:
            with np.errstate(invalid="ignore", divide="ignore"):
                found = np.gradient(states[:, :, :d], self._scored.times / 1e9 - self._scored.times[0] / 1e9, axis=0)
            told = np.where(np.isfinite(told), told, found)
        return told

    def hear(self, messages: Sequence[TrackMessage]) -> None:
        for one in messages:
            if one.sent != one.time and abs(one.sent - one.time) < SAME_CLOCK * 1e9:
                self._delays.append((one.sent - one.time) / 1e9)

    def _meet(self, k: int, states: Floats) -> tuple[Ints, Ints, Floats, Ints]:
        """Targets and rows that belong together, and the distance (M,) of every row to its nearest target."""
        there = np.flatnonzero(self._exists[k])
        places = self._scored.states[k, there, : self._d]
        crowd = cKDTree(places) if len(there) * len(states) > DENSE else None
        i, j, apart = near_pairs(places if crowd is None else crowd, states[:, : self._d], self._reference.c)
        kept = assign_near(i, j, self._reference.c**2 - apart**2, (len(there), len(states)))
        nearest = np.full(len(states), np.inf)
        if crowd is not None:
            nearest = crowd.query(states[:, : self._d])[0]
        elif len(there) and len(states):
            nearest = np.sqrt(((states[:, None, : self._d] - places[None]) ** 2).sum(axis=2)).min(axis=1)
        return there[i[kept]], j[kept], nearest, there

    def source(self, k: int, block: Block, row: int) -> None:
        states = block.states[int(block.ends[row]) : int(block.ends[row + 1])]
        targets, _, _, _ = self._meet(k, states)
        self._seen[k, targets] = True

    def picture(self, k: int, block: Block, row: int, picture: GlobalTracks | None, shown: ShownTracks) -> None:
        mine = slice(int(block.ends[row]), int(block.ends[row + 1]))
        states, number, d = block.states[mine], block.number[mine], self._d
        targets, rows, nearest, _ = self._meet(k, states)
        identity, updated = self._said(picture, number[rows], shown)
        offset = states[rows] - np.concatenate(
            [self._scored.states[k, targets, :d], self._velocity[k, targets]], axis=1
        )
        place = states[rows, :d]
        level = self._level(place, offset[:, :d])
        speed = self._level(place, states[rows, d:])[:, :2]
        error = self._level(place, offset[:, d:])[:, :2]
        self._pairs.append(
            (np.full(len(rows), k), targets, number[rows], level, speed, error, identity, updated, place, nearest[rows])
        )
        left = np.setdiff1d(np.arange(len(states)), rows)
        self._rest.append((np.full(len(left), k), states[left, :d], nearest[left]))

    def _said(self, picture: GlobalTracks | None, number: Ints, shown: ShownTracks) -> tuple[Ints, Times]:
        identity, updated = np.full(len(number), NOTHING), np.full(len(number), NOTHING, dtype=np.int64)
        if picture is None or not len(number):
            return identity, updated
        ids = np.array([shown.numbers.keys[one][1] for one in number.tolist()], dtype=np.uint64)
        by = np.argsort(picture.ids)
        at = by[np.minimum(np.searchsorted(picture.ids, ids, sorter=by), len(by) - 1)]
        there = picture.ids[at] == ids
        updated[there] = picture.updated[at[there]]
        if picture.identity is not None:
            names = [
                picture.identity[row] if good else None for row, good in zip(at.tolist(), there.tolist(), strict=True)
            ]
            identity = np.array(
                [NOTHING if not name else self._names.setdefault(name, len(self._names)) for name in names],
                dtype=np.intp,
            )
        return identity, updated

    def _level(self, place: Floats, vectors: Floats) -> Floats:
        """Vectors (R, d) as east, north, up (R, 3); up NaN on the plane."""
        frame, axes = self._reference.frame, self._reference.axes
        if isinstance(frame, Ecef) and self._d == 3:
            east, north = level_axes(place.T, axes, frame)
            up = vertical(place.T, axes, frame)
            return np.stack([(axis * vectors.T).sum(axis=0) for axis in (east, north, up)], axis=1)
        return vectors if self._d == 3 else np.pad(vectors, ((0, 0), (0, 1)), constant_values=np.nan)

    def result(self, truths: Sequence[Truth]) -> Observed:
        """When all times are through."""
        scored, d = self._scored, self._d
        count, targets = self._exists.shape
        flat = scored.states[:, :, :d].reshape(-1, d)
        known = self._exists.reshape(-1)
        velocity = np.full((count * targets, 2), np.nan)
        velocity[known] = self._level(flat[known], self._velocity.reshape(-1, d)[known])[:, :2]
        pairs = [np.concatenate([one[i] for one in self._pairs]) for i in range(10)]
        rest = [np.concatenate([one[i] for one in self._rest]) for i in range(3)]
        return Observed(
            centre=self._centre,
            frame=self._reference.frame,
            c=self._reference.c,
            times=scored.times,
            targets=scored.targets,
            exists=self._exists,
            place=scored.states[:, :, :d],
            velocity=velocity.reshape(count, targets, 2),
            height=self._heights(truths, flat, known).reshape(count, targets),
            pairs=Pairs(*pairs),
            rest=Rest(*rest),
            seen=self._seen,
            identities=tuple(self._names),
            latency=np.array(self._delays),
        )

    def _heights(self, truths: Sequence[Truth], flat: Floats, known: Bools) -> Floats:
        """(K T,): where the frame has none, by truth's own z."""
        frame, found = self._reference.frame, np.full(len(flat), np.nan)
        place = flat
        if self._d == 2 and len(self._scored.targets):
            paths = truth_path(truths, frame, self._reference.axes, ("z",))
            moved = [truth_positions(*paths[one], self._scored.times, np.inf) for one in self._scored.targets]
            place = np.stack(moved, axis=1).reshape(-1, 3)
            known = known & np.isfinite(place[:, 2])
        if known.any():
            level = place[known]
            found[known] = level[:, 2] if not isinstance(frame, Enu | Ecef) else places_on_earth(level, frame)[2]
        return found
