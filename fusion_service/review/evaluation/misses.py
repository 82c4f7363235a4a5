"""Why a target had no fused track when it had none.

Of a target that exists at a scored time and has no fused track assigned, the first of these that holds, for the source
whose track on it came furthest:

    no picture     a source had a track on it, and the centre had no picture that was new enough
    merged         that track was part of a confirmed track, which is assigned to another target
    far            that track was part of a confirmed track, which is farther from the target than the cut-off
    unconfirmed    that track was part of a tentative track
    suspended      that track was in no fused track; its own was suspended, says the step log: its existence had fallen
                   so low that it was not shown
    gate           that track was in no fused track; the step log says that it failed its gate, or was cut
    refused        the same; messages of its source were refused or dropped in the last three of its periods
    unlinked       the same, and nothing says why
    unseen         no source had a track on it, within the cut-off, assigned as GOSPA does
    outside        the same, and every source says what it covers, by its newest info and the newest place of its
                   platform, and none covers the place
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Floats
from fusion_service.coverage import at_platform, covers
from fusion_service.review.evaluation.consistency import links_by_source
from fusion_service.review.evaluation.turned_away import TurnedAway
from fusion_service.review.snapshots import Indices, Numbers
from schemas import Frame, GlobalTracks, Platform, SensorInfo
from schemas.messages import TENTATIVE

__all__ = ["CAUSES", "MERGED", "Coverages", "Misses", "PlatformPath", "Sighting"]

OUTSIDE, UNSEEN, UNLINKED, REFUSED, GATE, SUSPENDED, UNCONFIRMED, FAR, MERGED, NO_PICTURE = range(1, 11)

CAUSES = (
    "",
    "outside all coverage",
    "seen by none",
    "seen, but in no fused track",
    "seen, but its source was refused",
    "seen, but out of the centre's gate",
    "seen, but the existence of its track was too low",
    "seen, but not confirmed",
    "its track was farther off than the cut-off",
    "merged into the track of another target",
    "seen, but the centre had no new picture",
)
"""In words, by code; 0: not missed."""


class Sighting(NamedTuple):
    """What of one source is assigned to the targets: numbers (K, T) of its tracks, -1 without one, and what they stand
    for; period: s, of its messages."""

    held: NDArray[np.int32]
    numbers: Numbers
    period: float


class PlatformPath(NamedTuple):
    """Where the platform of a source was: times, ns, ascending, and places, in frames."""

    times: list[int]
    places: list[tuple[Platform, Frame]]


class Coverages:
    """What the sources cover. told: whether each of them says so."""

    def __init__(
        self, sources: Sequence[str], infos: Mapping[str, SensorInfo], platforms: Mapping[str, PlatformPath]
    ) -> None:
        self._infos = [infos[name] for name in sources if name in infos]
        self._platforms = platforms
        self.told = len(self._infos) == len(sources) > 0 and all(one.coverage is not None for one in self._infos)

    def hold(self, time: int, places: Floats, frame: Frame) -> Bools:
        """Whether any covers each of `places` (d, M) at `time`, ns: (M,)."""
        found = np.zeros(places.shape[1], dtype=np.bool_)
        for info in self._infos:
            if (path := self._platforms.get(info.source)) is not None:
                at = bisect_right(path.times, time) - 1
                info = at_platform(info, *path.places[max(at, 0)])
            found |= covers(info, places, frame)
        return found


class Misses:
    """Gathers, for one centre, the causes: codes (K, T), 0 where a target is followed or is not there; others (K, T):
    the index of the other target of a merger, else -1."""

    def __init__(self, count: int, targets: int, turned_away: TurnedAway) -> None:
        self.codes = np.zeros((count, targets), dtype=np.uint8)
        self.others = np.full((count, targets), -1, dtype=np.int32)
        self._turned_away = turned_away

    def add(
        self,
        k: int,
        time: int,
        missed: Indices,
        covered: Bools,
        picture: GlobalTracks | None,
        fused: Sighting,
        sources: Mapping[str, Sighting],
    ) -> None:
        """At the k-th time, `time` in ns: `missed` (M,) targets have no fused track; covered (M,): by any source, all
        true where that is not known of each."""
        codes, others = np.where(covered, UNSEEN, OUTSIDE), np.full(len(missed), -1)
        links: dict[str, tuple[Indices, Indices]] | None = None
        for name, sighting in sources.items():
            number = sighting.held[k, missed]
            seen = np.flatnonzero(number >= 0)
            if not len(seen):
                continue
            if picture is None:
                codes[seen] = NO_PICTURE
                continue
            if links is None:
                links = links_by_source(picture, {one: found.numbers for one, found in sources.items()})
            rows = np.full(len(sighting.numbers.keys) + 1, -1)
            if name in links:
                owner, whose = links[name]
                rows[whose] = owner
                rows[-1] = -1
            row = rows[number[seen]]
            code, other = self._linked(k, row, picture, fused)
            for index in np.flatnonzero(row < 0).tolist():
                code[index] = self._turned(time, picture, name, sighting, int(number[seen[index]]))
            later = code > codes[seen]
            codes[seen[later]], others[seen[later]] = code[later], other[later]
        self.codes[k, missed], self.others[k, missed] = codes, others

    def _linked(
        self, k: int, row: Indices, picture: GlobalTracks, fused: Sighting
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Codes of local tracks that are part of the rows `row` (M,) of a picture, and the other targets."""
        there = row >= 0
        tentative = there & (picture.status[row] == TENTATIVE) if len(picture.ids) else there
        other = np.full(len(row), -1)
        confirmed = np.flatnonzero(there & ~tentative)
        number = fused.numbers.find(0, picture.ids[row[confirmed]])
        targets = np.flatnonzero(fused.held[k] >= 0)
        follows = {int(fused.held[k, target]): int(target) for target in targets}
        other[confirmed] = [follows.get(one, -1) for one in number.tolist()]
        return np.where(tentative, UNCONFIRMED, np.where(other >= 0, MERGED, FAR)), other

    def _turned(self, time: int, picture: GlobalTracks, name: str, sighting: Sighting, number: int) -> int:
        """The code of a local track that is in no fused track."""
        epoch, track = sighting.numbers.keys[number]
        if (name, epoch, track) in self._turned_away.outside(picture.time):
            return GATE
        if self._turned_away.suspended((name, epoch, track), picture.time):
            return SUSPENDED
        since = time - round(3e9 * sighting.period)
        return REFUSED if self._turned_away.refused(name, since, time) else UNLINKED
