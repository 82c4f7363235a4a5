"""Which local tracks are of one object, by the centre's own links.

An object is a global track that was confirmed in `LEAST` pictures; one that goes on where another ended is the same
object: it was merged into it (`replaced_by`), split from it, or its first local track was the other's until then.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import Counter
from typing import TypeAlias

import numpy as np

from fusion_service.review.snapshots import Times
from schemas import GlobalTracks, merged
from schemas.messages import TENTATIVE

__all__ = ["Key", "Links"]

Key: TypeAlias = tuple[str, int, int]
"""Source, epoch, id of a local track."""
LEAST = 10


class Links:
    """Gathers the pictures of one centre, in time; then `object_of` says which object a local track was of."""

    def __init__(self) -> None:
        self.times: list[int] = []
        self._picture: GlobalTracks | None = None
        self._same: dict[int, int] = {}
        self._last: dict[Key, int] = {}
        self._history: dict[Key, tuple[list[int], list[int]]] = {}
        """By local track: times of pictures at which its link changed, and to what (0: none)."""
        self._confirmed: Counter[int] = Counter()
        self._known: set[int] = set()

    def add(self, message: GlobalTracks) -> None:
        """The next picture, or what has changed in it."""
        picture = merged(self._picture, message)
        if picture is None:
            return
        self._picture = picture
        self.times.append(picture.time)
        for track, _, into in message.ended:
            if into:
                self._join(track, into)
        for track, whole in message.split_from:
            self._join(track, whole)
        rows = np.repeat(np.arange(len(picture.ids)), picture.contributor_counts.astype(np.intp))
        present = set(picture.ids.tolist())
        links: dict[Key, int] = {}
        for row, source, epoch, one in zip(
            rows.tolist(),
            picture.contributor_source.tolist(),
            picture.contributor_epoch.tolist(),
            picture.contributor_id.tolist(),
            strict=True,
        ):
            links[picture.sources[source], epoch, one] = int(picture.ids[row])
        for key, track in links.items():
            before = self._last.get(key)
            if before != track:
                if before and track not in self._known and before not in present:
                    self._join(track, before)
                self._note(key, picture.time, track)
        for key in [key for key in self._last if key not in links and self._last[key]]:
            self._note(key, picture.time, 0)
        self._known |= present
        self._confirmed.update(picture.ids[picture.status != TENTATIVE].tolist())

    def _note(self, key: Key, time: int, track: int) -> None:
        self._last[key] = track
        times, tracks = self._history.setdefault(key, ([], []))
        times.append(time)
        tracks.append(track)

    def _join(self, one: int, other: int) -> None:
        self._same[self._root(one)] = self._root(other)

    def _root(self, track: int) -> int:
        while (above := self._same.get(track, track)) != track:
            self._same[track] = self._same.get(above, above)
            track = above
        return track

    def objects(self) -> list[int]:
        """Those that were confirmed often enough, when all pictures are in."""
        count: Counter[int] = Counter()
        for track, times in self._confirmed.items():
            count[self._root(track)] += times
        return sorted(track for track, times in count.items() if times >= LEAST)

    def object_of(self, key: Key, time: int) -> int:
        """The object that what the track said at `time` went into: by the first picture from then on; before its first
        link that one; 0 for none."""
        times, tracks = self._history.get(key, ([], []))
        if not times:
            return 0
        at = bisect_left(self.times, time)
        if at == len(self.times):
            return 0
        place = bisect_right(times, self.times[at]) - 1
        return self._root(tracks[max(place, 0)]) if tracks[max(place, 0)] else 0

    def picture_times(self) -> Times:
        """(K,), ns."""
        return np.unique(np.array(self.times, dtype=np.int64))
