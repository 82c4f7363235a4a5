"""Global tracks that an exchange has left without any local track: one with the track that took all of theirs.

Where two tracks of one target share no source, a rival link may be decided before their merge is: then the row of the
one goes over to the other, and in what it leaves there is nothing any more that would tell it from that. It is no place
that was vacated, to be shown as a second, coasting track until its time is up and to take rows back by chance, but a
merge that came about in another way.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, among, marked
from fusion_service.centre.candidates import Pairs
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.rows import NO_TRACK, Rows

__all__ = ["emptied"]

Ids = NDArray[np.uint64]


def emptied(rows: Rows, before: Ids, believed: Bools, now: Picture, near: Pairs) -> list[tuple[int, int]]:
    """Pairs (older id, newer) of global tracks, in order: all believed rows of the one went over to the other.

    before (M,), believed (M,): the links that the rows had when the exchanges of the step began, and which were
    `inside` them; near: pairs of tracks (places in `now`) within the gate, which may be merged. Not where a source told
    the two apart by a row in each; and a row that had failed its gate tells nothing of the track that it left.
    """
    link = rows.tracks.link
    moved = marked((link != before) & believed)
    if not len(moved):
        return []
    left = np.unique(before[moved])
    left = left[~among(left, link) & among(left, now.id)]
    if not len(left):
        return []
    mine = moved[among(before[moved], left)]
    at, width = np.searchsorted(left, before[mine]), max(len(now.id), 1)
    low, high = np.full(len(left), ~np.uint64(0)), np.full(len(left), NO_TRACK)
    np.minimum.at(low, at, link[mine])
    np.maximum.at(high, at, link[mine])
    one, other = now.find(left), np.minimum(now.find(low), width - 1)
    first, second = np.minimum(one, other), np.maximum(one, other)
    same = (low == high) & (now.id[other] == low) & among(first * width + second, near.first * width + near.second)
    linked = np.flatnonzero(before != NO_TRACK)
    held = rows.source[linked] * width + now.find(before[linked])
    apart = among(rows.source[mine] * width + other[at], held)
    same &= np.bincount(at[apart], minlength=len(left)) == 0
    return list(zip(now.id[first[same]].tolist(), now.id[second[same]].tolist(), strict=True))
