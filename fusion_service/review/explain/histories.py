"""When every global track of a centre lived, from whom, and what became of it: enough to know which to ask about."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from fusion_service.recording.steps import Step
from schemas import GlobalTracks
from schemas.messages import KEPT, TENTATIVE

__all__ = ["GONE", "TrackHistories", "TrackHistory"]


@dataclass(slots=True)
class TrackHistory:
    """One track, times in ns. events: decisions about it but links kept; confirmed: whether it ever was; ended: time,
    reason and heir; parent: what it was split from; took: tracks that were merged into it."""

    track: int
    first: int
    last: int
    sources: set[str] = field(default_factory=set)
    events: int = 0
    confirmed: bool = False
    ended: tuple[int, str, int | None] | None = None
    parent: int | None = None
    took: list[int] = field(default_factory=list)


GONE = "gone without a word"
"""The reason of a track that a picture does not show any more and none has ended."""


class TrackHistories:
    """All lives of a centre, gathered step by step."""

    def __init__(self) -> None:
        self.known: dict[int, TrackHistory] = {}
        self.last = 0
        """Time of the newest step, ns."""
        self._before: GlobalTracks | None = None

    def __iter__(self) -> Iterator[TrackHistory]:
        return iter(self.known.values())

    def step(self, step: Step) -> None:
        """Take a step of the centre."""
        at = self.last = step.time
        if step.log is not None:
            one = step.log.decisions
            tracks, counts = np.unique(one.track[one.kind != KEPT], return_counts=True)
            for track, count in zip(tracks.tolist(), counts.tolist(), strict=True):
                self._life(track, at).events += count
        if step.picture is not None:
            self._picture(step.picture)

    def _picture(self, picture: GlobalTracks) -> None:
        at, before = picture.time, self._before
        self._before = picture
        for track, reason, heir in picture.ended:
            life = self._life(track, at)
            life.last, life.ended = at, (at, reason, heir)
            if heir is not None:
                self._life(heir, at).took.append(track)
        if before is None or not _alike(before, picture):
            self._members(picture)
            for track in np.setdiff1d(before.ids, picture.ids).tolist() if before is not None else ():
                life = self.known[track]
                if life.ended is None:
                    life.last, life.ended = at, (at, GONE, None)
        for new, old in picture.split_from:
            self._life(new, at).parent = old

    def _members(self, picture: GlobalTracks) -> None:
        """Note who is there and from whom; called when that has changed."""
        at = picture.time
        for track in picture.ids.tolist():
            self._life(track, at)
        for track in picture.ids[picture.status != TENTATIVE].tolist():
            self.known[track].confirmed = True
        owner = np.repeat(picture.ids, picture.contributor_counts)
        for track, source in set(zip(owner.tolist(), picture.contributor_source.tolist(), strict=True)):
            self.known[track].sources.add(picture.sources[source])

    def _life(self, track: int, at: int) -> TrackHistory:
        return self.known.setdefault(track, TrackHistory(track, at, at))

    def until(self, life: TrackHistory) -> int:
        """Time of the newest step in which the track was there."""
        return life.last if life.ended is not None else self.last


def _alike(one: GlobalTracks, two: GlobalTracks) -> bool:
    """Whether the same tracks are there, of the same status and sources."""
    names = ("ids", "status", "contributor_counts", "contributor_source")
    return one.sources == two.sources and all(np.array_equal(getattr(one, n), getattr(two, n)) for n in names)
