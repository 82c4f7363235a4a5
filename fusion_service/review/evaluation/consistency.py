"""Whether sources agree with each other, which needs no truth.

Two local tracks that a centre holds for one object, of sources i and j, are d2 = (xi - xj)' (Pi + Pj)^-1 (xi - xj)
apart, by position. If their errors are independent and as large as said, d2 over its dimension is 1 in the mean. More:
covariances are too small, or there is a bias between the two, or links are wrong. Less: covariances are too large, or
the errors are correlated, so that the difference is smaller than the sum of both.

A link is scored too as it was when made: local tracks that do not agree are not linked, which takes the largest
distances away.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.metrics import nees, nees_bounds
from fusion_service.review.snapshots import Block, Numbers
from schemas import GlobalTracks

__all__ = ["Consistency", "SourceAgreement", "SourcePair", "links_by_source"]


class SourcePair(NamedTuple):
    """Two sources: n pairs of tracks, the mean of d2 over its dimension, and where it lies with 95 % if errors are
    independent, also in time, and as said; NaN without a pair."""

    n: int
    mean: float
    bounds: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class SourceAgreement:
    """By pair of sources, in alphabetical order."""

    dimension: int
    pairs: dict[tuple[str, str], SourcePair]


class Consistency:
    """Gathers the agreement of the sources that one centre links."""

    def __init__(self, sources: Sequence[str], dimension: int) -> None:
        self._sources, self._dimension = sorted(sources), dimension
        self._sums = dict.fromkeys(combinations(self._sources, 2), (0, 0.0))
        self._of: tuple[GlobalTracks | None, dict[str, tuple[NDArray[np.intp], NDArray[np.intp]]]] = (None, {})

    def add(self, pictures: Sequence[GlobalTracks | None], local: Mapping[str, tuple[Numbers, Block]]) -> None:
        """A block of times: the centre's picture, and what each source shows, at each of them."""
        gathered: dict[tuple[str, str], list[tuple[NDArray[np.intp], NDArray[np.intp]]]] = {}
        for row, picture in enumerate(pictures):
            if picture is None or not len(picture.ids):
                continue
            links = self._links(picture, local)
            at: dict[str, NDArray[np.intp]] = {}
            for name, (owner, number) in links.items():
                numbers, block = local[name]
                begin, end = int(block.ends[row]), int(block.ends[row + 1])
                place = np.full(len(numbers.keys) + 1, -1)
                place[block.number[begin:end]] = np.arange(begin, end)
                at[name] = np.full(len(picture.ids), -1)
                at[name][owner] = place[number]
            for a, b in combinations(sorted(at), 2):
                both = np.flatnonzero((at[a] >= 0) & (at[b] >= 0))
                gathered.setdefault((a, b), []).append((at[a][both], at[b][both]))
        for (a, b), rows in gathered.items():
            i, j = (np.concatenate(part) for part in zip(*rows, strict=True))
            one, other, d = local[a][1], local[b][1], self._dimension
            apart = one.states[i, :d] - other.states[j, :d]
            distance = nees(apart, one.covariances[i] + other.covariances[j]) / d
            n, total = self._sums[a, b]
            self._sums[a, b] = n + len(i), total + float(distance.sum())

    def _links(
        self, picture: GlobalTracks, local: Mapping[str, tuple[Numbers, Block]]
    ) -> dict[str, tuple[NDArray[np.intp], NDArray[np.intp]]]:
        """As `links_by_source`, once for each picture."""
        if self._of[0] is not picture:
            self._of = picture, links_by_source(picture, {name: numbers for name, (numbers, _) in local.items()})
        return self._of[1]

    def result(self) -> SourceAgreement:
        """When all blocks are added."""
        nothing = (np.nan, np.nan)
        return SourceAgreement(
            self._dimension,
            {
                pair: SourcePair(n, total / n if n else np.nan, nees_bounds(self._dimension, n) if n else nothing)
                for pair, (n, total) in self._sums.items()
            },
        )


def links_by_source(
    picture: GlobalTracks, numbers: Mapping[str, Numbers]
) -> dict[str, tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """By source: rows of the picture's tracks and the numbers of the local tracks in them, -1 for one that is not
    known."""
    counts = picture.contributor_counts.astype(np.intp)
    owner = np.repeat(np.arange(len(picture.ids)), counts)
    links = {}
    for index, name in enumerate(picture.sources):
        mine = np.flatnonzero(picture.contributor_source == index)
        if name not in numbers or not len(mine):
            continue
        number = np.full(len(mine), -1)
        epochs = picture.contributor_epoch[mine]
        for epoch in np.unique(epochs).tolist():
            some = epochs == epoch
            number[some] = numbers[name].find(epoch, picture.contributor_id[mine[some]])
        links[name] = owner[mine], number
    return links
