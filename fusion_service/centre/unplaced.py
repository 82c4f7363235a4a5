"""`Unplaced`: late messages that stay where they came, counted by what kept them from being put in their places.

They are used, in the step in which they came, but the pictures before are not those of the ordered run. Nothing of it
changes a result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace

from fusion_service.centre import notes
from fusion_service.centre.limits import MAX_SOURCES
from schemas import Status

__all__ = ["Key", "Unplaced"]

Key = tuple[str, int, int, int]
"""Source, epoch, number and digest of a message."""


class Unplaced:
    """began: before the first step that this process has made, ns; cut: the newest step that was let go because there
    was no room for it, ns; -1: none."""

    def __init__(self) -> None:
        self.began = self.cut = -1
        self.why: Counter[str] = Counter()
        self.of: Counter[str] = Counter()

    def gone(self, owed: Iterable[tuple[Key, int]]) -> None:
        """The steps in which these messages should have been, first at so many ns, are kept no more, or never were."""
        for key, due in owed:
            self._count(key, "start" if due <= self.began else "room" if due <= self.cut else "turn")

    def behind(self, keys: Iterable[Key]) -> None:
        """No step is made again for these, since the centre is behind."""
        for key in keys:
            self._count(key, "behind")

    def _count(self, key: Key, why: str) -> None:
        self.why[why] += 1
        if key[0] in self.of or len(self.of) < 2 * MAX_SOURCES:
            self.of[key[0]] += 1

    def told_in(self, status: Status) -> Status:
        """A status that says how many there were, of which sources, and why."""
        if not self.why:
            return status
        sources = {
            name: entry | {"unplaced": self.of[name]} if name in self.of else entry
            for name, entry in status.sources.items()
        }
        return replace(
            status,
            queue=dict(status.queue) | {"unplaced": self.why.total()},
            sources=sources,
            notes=(*(status.notes or ()), notes.unplaced(self.why)),
        )
