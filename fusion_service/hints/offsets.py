"""Sources whose tracks never become one, and the constant offset that would make them."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from fusion_service.arrays import Floats, Ints
from schemas import GlobalTracks

__all__ = ["offset_doubts"]

FEWEST = 4
"""Tracks that must agree on an offset."""
SHARE = 0.6
"""Of the tracks of the source that has fewer, so many must agree."""
MOST, MOST_PAIRS = 200, 50
"""Tracks of a source, and pairs of sources, that are looked at."""
NEAR = 5.0
"""m/s between the velocities of one object, at most."""
SIGMAS = 4.0


def offset_doubts(picture: GlobalTracks) -> list[str]:
    """A sentence for each pair of sources that share no track of `picture`, and would share most of them if one were
    shifted."""
    if not {"vx", "vy"} <= set(picture.space) or picture.counts is not None or not len(picture.ids):
        return []
    counts = picture.contributor_counts.astype(np.intp)
    owner = np.repeat(np.arange(len(counts)), counts)
    source = picture.contributor_source.astype(np.intp)
    of = {k: np.unique(owner[source == k]) for k in np.unique(source).tolist()}
    at = [picture.space.index(name) for name in ("x", "y", "vx", "vy")]
    states, spread = picture.means[:, at], picture.covariances[:, at[:2], at[:2]].sum(axis=1)
    found = []
    for one, other in list(combinations(sorted(of), 2))[:MOST_PAIRS]:
        if len(np.intersect1d(of[one], of[other])):
            continue
        a, b = of[one][:MOST], of[other][:MOST]
        shift, agree = _shift(states, spread, a, b)
        if agree >= max(FEWEST, SHARE * min(len(a), len(b))):
            east, north = shift.tolist()
            found.append(
                f"{picture.sources[one]} and {picture.sources[other]} share no track, and would share {agree} if "
                f"{picture.sources[other]} were shifted by {east:+.0f} m in x and {north:+.0f} m in y: are its "
                f"position and frame right?"
            )
    return found


def _shift(states: Floats, spread: Floats, a: Ints, b: Ints) -> tuple[Floats, int]:
    """The offset (2,) from tracks b to tracks a that most pairs agree on, and how many tracks do."""
    apart = states[a][:, None, :] - states[b][None, :, :]
    i, j = np.nonzero(np.hypot(apart[..., 2], apart[..., 3]) < NEAR)
    if len(i) < FEWEST:
        return np.zeros(2), 0
    offsets = apart[i, j, :2]
    radius = SIGMAS * float(np.sqrt(np.median(spread[a]) + np.median(spread[b])))
    cells, place = np.unique(np.floor(offsets / radius).astype(np.int64), axis=0, return_inverse=True)
    best, most = np.zeros(2), 0
    sizes = np.bincount(place.ravel(), minlength=len(cells))
    for cell in np.argsort(-sizes, kind="stable")[:8].tolist():
        centre = np.median(offsets[place.ravel() == cell], axis=0)
        near = np.hypot(*(offsets - centre).T) < radius
        agree = min(len(np.unique(i[near])), len(np.unique(j[near])))
        if agree > most:
            best, most = np.median(offsets[near], axis=0), agree
    return best, most
