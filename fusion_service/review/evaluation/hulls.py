"""Scores against the true hull, where truth tells the extent of its objects, beside those against its point.

A sensor that reports some point of a ship is not wrong by its distance from the ship's antenna. Of every pair that
GOSPA assigns, in the plane: the distance from the track to the nearest point of the hull, 0 inside it, and the least
NEES of all points of the hull, by the covariance that the track states. A track that knows where on the ship it is
gets no more for it than one that lies anywhere inside, so an ANEES of the hull below 1 is no fault, above its bounds it
is one whatever point was meant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats, Ints
from fusion_service.geodesy import FrameError, axis_turn, transform
from fusion_service.hulls import centres, drawable, outlines, to_hulls
from fusion_service.metrics import nees_bounds
from fusion_service.review.snapshots import Times
from schemas import Ecef, Frame, Truth

__all__ = ["HullScore", "HullTally", "TrueHulls", "true_hulls"]

PLANE = 2


@dataclass(frozen=True, slots=True, eq=False)
class TrueHulls:
    """Of T targets at K times: extent (K, T, 3), in the scoring frame; offset (K, T, 2) of the true point from the
    centre of the hull, along the heading and to the left of it, m; box (K, T). NaN where no hull is told."""

    extent: Floats
    offset: Floats
    box: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class HullScore:
    """rmse: of the distance to the hull, m; inside: share of the pairs that lie in it; anees: over the two dimensions;
    bounds: 95 % for it, if the point of the hull were known. NaN without a pair."""

    pairs: int
    rmse: float
    inside: float
    anees: float
    bounds: tuple[float, float]

    def as_json(self) -> dict[str, Any]:
        """None for what does not exist."""
        numbers = {"rmse": self.rmse, "inside": self.inside, "anees": self.anees}
        told: dict[str, Any] = {name: value if np.isfinite(value) else None for name, value in numbers.items()}
        return {"pairs": self.pairs, **told, "bounds": list(self.bounds) if self.pairs else None}


def true_hulls(truths: Sequence[Truth], frame: Frame, times: Times, targets: tuple[int, ...]) -> TrueHulls | None:
    """What truth says of the hulls at the scored times (K,), ns: of each target the version nearest in time. None where
    it says nothing, or the frame has no horizontal plane."""
    told = [truth for truth in truths if truth.extent is not None and len(truth.ids)]
    if not told or isinstance(frame, Ecef):
        return None
    parts = [part for part in (_of_message(truth, frame) for truth in told) if part is not None]
    if not parts:
        return None
    ids, when, rows = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.lexsort((when, ids))
    ids, when, rows = ids[order], when[order], rows[order]
    found = np.full((len(times), len(targets), 6), np.nan)
    for column, target in enumerate(targets):
        first, last = np.searchsorted(ids, np.uint64(target), "left"), np.searchsorted(ids, np.uint64(target), "right")
        if last > first:
            found[:, column] = rows[first:last][_nearest(when[first:last], times)]
    return TrueHulls(found[..., :3], found[..., 3:5], found[..., 5] == 1.0)


def _of_message(truth: Truth, frame: Frame) -> tuple[NDArray[np.uint64], Times, Floats] | None:
    """Ids, times and rows (extent, offset, box) of the hulls in one message."""
    assert truth.extent is not None
    some = drawable(truth.extent)
    own = tuple(name for name in "xyz" if name in truth.space)
    means = truth.means[some][:, [truth.space.index(name) for name in own]]
    try:
        places, _ = transform(means, np.zeros((*means.shape, len(own))), own, truth.frame, frame)
        turn = axis_turn(places.T, own, truth.frame, frame)
    except FrameError:
        return None
    rows = np.full((len(means), 6), np.nan)
    rows[:, :3] = truth.extent[some]
    rows[:, 2] += turn
    if truth.extent_offset is not None:
        rows[:, 3:5] = truth.extent_offset[some]
    rows[:, 5] = float(truth.shape == "box")
    return truth.ids[some], np.full(len(means), truth.time, dtype=np.int64), rows


def _nearest(when: Times, times: Times) -> Ints:
    after = np.minimum(np.searchsorted(when, times), len(when) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(times - when[before] <= when[after] - times, before, after)


class HullTally:
    """Gathers the hull scores of one source or centre."""

    def __init__(self, hulls: TrueHulls) -> None:
        self._hulls = hulls
        self._distance: list[Floats] = []
        self._nees: list[Floats] = []

    def add(self, k: int, targets: Ints, truth: Floats, states: Floats, covariances: Floats) -> None:
        """Pairs at the k-th time: targets (R,), their true and estimated places (R, 2), covariances (R, 2, 2)."""
        extent, offset, box = (part[k, targets] for part in (self._hulls.extent, self._hulls.offset, self._hulls.box))
        known = drawable(extent) & np.isfinite(states).all(axis=1)
        for some, rectangle in ((known & box, True), (known & ~box, False)):
            if some.any():
                middle = centres(truth[some], extent[some], offset[some])
                hulls = outlines(middle, extent[some], rectangle)
                distance, least = to_hulls(states[some], hulls, covariances[some])
                self._distance.append(distance)
                self._nees.append(least / PLANE)

    def score(self) -> HullScore:
        """When all times are added."""
        distance, squared = (np.concatenate([np.zeros(0), *part]) for part in (self._distance, self._nees))
        count = len(distance)
        if not count:
            return HullScore(0, np.nan, np.nan, np.nan, (np.nan, np.nan))
        rmse, inside = float(np.sqrt(np.mean(distance**2))), float(np.mean(distance == 0.0))
        return HullScore(count, rmse, inside, float(np.mean(squared)), nees_bounds(PLANE, count))
