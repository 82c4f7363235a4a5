"""How long vessels are, learned from their returns, and what that leaves unknown of the place that is asked for.

A sensor that resolves a vessel sees of it bow, stern or all, which is the scan's matter, and its track follows one of
them. The place that is asked for, an antenna's, may be anywhere on a hull of length l along the course u, so it lies
off what is followed by something of variance

    l^2 / 12  along u,

the same from scan to scan: it is added to what is reported, and not to the noise. Nothing is known of l at first. Each
scan's returns within the longest hull about the track span s of it, and l follows s: quickly when more is seen than
was known, slowly when less. A point stays a point.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from sensor_clients.filters.measurement import Floats

__all__ = ["Hulls"]

GROWS, SHRINKS = 0.2, 0.02
"""Share of the difference by which the length follows the span of a scan."""
MOVING = 0.5
"""Speed, m/s, below which a track has no course."""


class Hulls:
    """The lengths of the tracks of one sensor. longest: no vessel is longer, m; across: how far from the middle of the
    hull its returns lie across the course, m."""

    def __init__(self, longest: float, across: float) -> None:
        self._longest, self._across = longest, across
        self._lengths: dict[int, float] = {}

    def lengths(self, ids: NDArray[np.integer]) -> Floats:
        """What is known of the length of each track (K,), m."""
        return np.array([self._lengths.get(one, 0.0) for one in ids.tolist()])

    def learn(self, ids: NDArray[np.integer], means: Floats, returns: Floats) -> None:
        """One scan: returns (2, M), m, and all tracks that there are at its time, ids (K,) and states (4, K). A return
        is of the track in whose hull it lies deepest; what has no course learns nothing."""
        known = self.lengths(ids)
        self._lengths = dict(zip(ids.tolist(), known.tolist(), strict=True))
        if not len(ids) or returns.shape[1] < 2:
            return
        speed = np.maximum(np.hypot(means[2], means[3]), 1e-6)
        course = means[2:] / speed
        x, y = returns[:, :, None] - means[:2, None]
        along, across = x * course[0] + y * course[1], y * course[0] - x * course[1]
        depth = np.maximum(np.abs(along) / self._longest, np.abs(across) / self._across)
        depth = np.where(speed < MOVING, np.inf, depth)
        which = np.where(depth.min(axis=1) <= 1, depth.argmin(axis=1), -1)
        for k in np.unique(which[which >= 0]).tolist():
            span = min(float(np.ptp(along[which == k, k])), self._longest)
            share = GROWS if span > known[k] else SHRINKS
            self._lengths[int(ids[k])] += share * (span - known[k])

    def reference(self, ids: NDArray[np.integer], means: Floats) -> Floats:
        """Covariance (2, 2, K), m2, of where on its hull the place that is asked for lies, tracks (4, K)."""
        course = means[2:] / np.maximum(np.hypot(means[2], means[3]), 1e-6)
        return np.asarray(self.lengths(ids) ** 2 / 12 * linalg.outer(course, course))
