"""Global tracks that are the same target though nothing links them, since the errors of their sources are too large.

In each look one pair of sources that should share targets and hardly do is looked at (`matching`), pair after pair; not
one that others tie together, with each of which the next shares targets: their errors are estimated by those.
What is found several times is believed: the errors of both are estimated as if the tracks were linked. It is believed
no more when it is looked for and not found, or not looked for in a while.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fusion_service.arrays import Floats, Ints, picked
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.supervision.gauge import connected
from fusion_service.centre.supervision.matching import FEWEST, Tracks2, match

__all__ = ["Unlinked"]

BELIEVED, MOST_VOTES = 3, 5
EXPIRES = 120
"""Looks in which a pair was not looked for."""
MOST_PAIRS = 2000
MOST_COMPARED = 1_000_000
"""Tracks of one source times those of the other: of more, every so many of the one, in turns."""
TIED = 0.25
"""Of the tracks of that source that has fewer: more links than that tie the two."""
FEW_LINKS = 0.5
"""Of the tracks of that source that has fewer: more links than that are enough."""


class Unlinked:
    """votes: {(older, younger global track): (how often found, less how often not, number of the last look)}."""

    def __init__(self) -> None:
        self.votes: dict[tuple[int, int], tuple[int, int]] = {}
        self._turn = 0

    def look(self, rows: Rows, whose: Ints, sites: Floats, sigma: Floats, space: tuple[str, ...], step: int) -> None:
        """Look at the next pair of sources. whose (N,): the number in the estimate of each source, or -1; sites (2, S),
        sigma (S, 7): where those stand, and how large their errors may be."""
        self._forget(rows, step)
        if not {"vx", "vy"} <= set(space):
            return
        pairs = _lonely(rows, whose)
        if not len(pairs):
            return
        self._turn += 1
        one, other = pairs[self._turn % len(pairs)]
        a, b = (np.flatnonzero((rows.source == k) & (rows.tracks.link != NO_TRACK)) for k in (one, other))
        if rows.tracks.origin[a[0]] != rows.tracks.origin[b[0]]:
            return
        every = -(-len(a) * len(b) // MOST_COMPARED)
        a = a[(self._turn // len(pairs)) % every :: every]
        both = np.hypot(sigma[whose[one]], sigma[whose[other]])
        first, second = _plane(rows, a, space), _plane(rows, b, space)
        i, j = match(first, second, sites[:, whose[other]], both)
        if not len(i):  # a turn, and ranges, are about the place of one of them
            j, i = match(second, first, sites[:, whose[one]], both)
        self._count(rows.tracks.link, a, b, set(zip(a[i].tolist(), b[j].tolist(), strict=True)), step)

    def _count(self, link: Any, a: Ints, b: Ints, found: set[tuple[int, int]], step: int) -> None:
        pairs = {tuple(sorted((int(link[i]), int(link[j])))) for i, j in found if link[i] != link[j]}
        mine, its = set(link[a].tolist()), set(link[b].tolist())
        for pair in sorted(self.votes):
            looked = (pair[0] in mine and pair[1] in its) or (pair[1] in mine and pair[0] in its)
            if looked and pair not in pairs:
                self.votes[pair] = self.votes[pair][0] - 1, step
        for first, second in sorted(pairs):
            votes, _ = self.votes.get((first, second), (0, step))
            if votes or len(self.votes) < MOST_PAIRS:
                self.votes[first, second] = min(votes + 1, MOST_VOTES), step

    def _forget(self, rows: Rows, step: int) -> None:
        if not self.votes:
            return
        alive = set(rows.tracks.link.tolist())
        self.votes = {
            pair: (votes, at)
            for pair, (votes, at) in self.votes.items()
            if votes > 0 and step - at < EXPIRES and pair[0] in alive and pair[1] in alive
        }

    def same(self) -> dict[int, int]:
        """{global track: the older one that it is the same as}, as it is believed now."""
        root: dict[int, int] = {}

        def of(one: int) -> int:
            while one in root:
                one = root[one]
            return one

        for (first, second), (votes, _) in sorted(self.votes.items(), key=lambda item: (-item[1][0], item[0])):
            if votes >= BELIEVED:
                one, other = sorted((of(first), of(second)))
                if one != other:
                    root[other] = one
        return {one: of(one) for one in sorted(root)}

    def packed(self) -> list[Any]:
        """As plain values."""
        return [self._turn, [[*pair, *votes] for pair, votes in sorted(self.votes.items())]]

    def restore(self, packed: list[Any]) -> None:
        """From what `packed` gave."""
        self._turn = int(packed[0])
        self.votes = {(int(a), int(b)): (int(votes), int(at)) for a, b, votes, at in packed[1]}


def _lonely(rows: Rows, whose: Ints) -> list[tuple[int, int]]:
    """Pairs of sources, in order, that have enough tracks and hardly share one."""
    linked = np.flatnonzero((rows.tracks.link != NO_TRACK) & (whose[rows.source] >= 0))
    count = np.bincount(rows.source[linked], minlength=len(whose))
    some = np.flatnonzero(count >= FEWEST)
    if len(some) < 2:
        return []
    place = np.full(len(whose), -1)
    place[some] = np.arange(len(some))
    linked = linked[place[rows.source[linked]] >= 0]
    _, target = np.unique(rows.tracks.link[linked], return_inverse=True)
    there = np.zeros((int(target.max()) + 1, len(some)), dtype=np.float32)
    there[target, place[rows.source[linked]]] = ~rows.tracks.outside[linked]
    shared = there.T @ there
    fewer = np.minimum(count[some][:, None], count[some])
    tied = connected(np.where(shared >= np.maximum(TIED * fewer, FEWEST), 1.0, 0.0))
    apart = tied[:, None] != tied
    first, second = np.nonzero(np.triu((shared < FEW_LINKS * fewer) & apart, 1))
    return list(zip(some[first].tolist(), some[second].tolist(), strict=True))


def _plane(rows: Rows, at: Ints, space: tuple[str, ...]) -> Tracks2:
    xy, v = [space.index("x"), space.index("y")], [space.index("vx"), space.index("vy")]
    mean, covariance = picked(rows.tracks.mean, at), picked(rows.tracks.covariance, at)
    return Tracks2(mean[xy], mean[v], covariance[np.ix_(xy, xy)], covariance[np.ix_(v, v)])
