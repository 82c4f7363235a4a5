"""Ids that were published, of tracks that the checkpoint does not hold: they are for the local tracks that fed them.

A service that is killed has published tracks that began after its last checkpoint. Their ids, and the local tracks that
they were given for, are noted before they are published, and where they were; the centre that is made from the
checkpoint is told of them, and a track that one of these local tracks begins takes its id, or one that begins where it
must be by now (`whereabouts`). What nobody takes within `KEPT` seconds ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Ints
from fusion_service.centre.naming import LocalKey
from fusion_service.centre.whereabouts import Begun, Whereabouts

__all__ = ["MOST_PROMISED", "Promised"]

KEPT = 60.0
"""Seconds of the centre's time for which an id waits for its local tracks."""
MOST_PROMISED = 20_000
"""Local tracks that are remembered, the newest."""


class Promised:
    """Ids by local track. since: the time of the first step that knew of them, ns, -1 before it. where: they were;
    look: brings that to the time of the step, None where it cannot be."""

    def __init__(self) -> None:
        self._ids: dict[LocalKey, int] = {}
        self.where = Whereabouts.nothing()
        self.look: Callable[[Whereabouts], Whereabouts | None] = lambda where: None
        self.since = -1

    def __len__(self) -> int:
        return len(self._ids)

    @property
    def ids(self) -> NDArray[np.uint64]:
        """All of them, sorted."""
        return np.unique(np.array([*self._ids.values()], dtype=np.uint64))

    def add(self, born: Iterable[tuple[LocalKey, int]], where: Iterable[Whereabouts] = ()) -> None:
        """These local tracks fed tracks of these ids, which were there, the last said being the newest."""
        for one in where:
            self.where = self.where.followed(one)
        for local, track in born:
            self._ids.pop(local, None)
            self._ids[local] = track
        for local in list(self._ids)[: max(0, len(self._ids) - MOST_PROMISED)]:
            del self._ids[local]

    def take(self, groups: Sequence[Sequence[LocalKey]], begun: Begun | None = None) -> list[int | None]:
        """The id that each group of local tracks takes, None where it takes none; each is given once. begun: what they
        begin with, where that is known."""
        given: list[int | None] = []
        taken: set[int] = set()
        for group in groups:
            found = (self._ids[local] for local in group if local in self._ids)
            one = next((track for track in found if track not in taken), None)
            given.append(one)
            taken |= set() if one is None else {one}
        if begun is not None and None in given:
            for index, track in self._nearby(begun, np.flatnonzero([one is None for one in given])).items():
                given[index] = track
                taken.add(track)
        self._ids = {local: track for local, track in self._ids.items() if track not in taken}
        return given

    def _nearby(self, begun: Begun, open_: Ints) -> dict[int, int]:
        where = self.where.take(np.isin(self.where.id, self.ids))
        now = self.look(where) if len(where.id) else None
        return {} if now is None else now.nearest(begun, open_)

    def drop(self, tracks: Iterable[int]) -> None:
        """These are not waited for."""
        gone = set(tracks)
        self._ids = {local: track for local, track in self._ids.items() if track not in gone}

    def settle(self, there: NDArray[np.uint64], time: int) -> list[int]:
        """After the step at `time`, ns, which left the tracks `there`: the ids that nobody has taken in time, which are
        given to nobody any more."""
        if not self._ids:
            return []
        self.since = time if self.since < 0 else min(self.since, time)
        ids = self.ids
        self.drop(ids[np.isin(ids, there)].tolist())
        over = self.ids.tolist() if time - self.since > KEPT * 1e9 else []
        if over:
            self._ids = {}
        return over

    def packed(self) -> dict[str, object]:
        """As plain values."""
        if not self._ids:
            return {"since": self.since, "ids": []}
        where = self.where.take(np.isin(self.where.id, self.ids))
        return {
            "since": self.since,
            "ids": [[*local, track] for local, track in self._ids.items()],
            "where": where.packed(),
        }

    def restore(self, packed: dict[str, object]) -> None:
        """Go on with what `packed` gave."""
        self.since = int(packed["since"])  # type: ignore[call-overload]
        kept: Iterable[tuple[str, int, int, int]] = packed["ids"]  # type: ignore[assignment]
        self._ids = {(str(name), int(epoch), int(local)): int(track) for name, epoch, local, track in kept}
        where = packed.get("where")  # not in a checkpoint of an earlier release
        self.where = Whereabouts.unpacked(where) if isinstance(where, dict) else Whereabouts.nothing()
