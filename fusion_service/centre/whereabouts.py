"""Where young tracks were that the checkpoint does not hold, so that they are known again by any source that sees them.

A track that one source had begun before a kill may be told by another one first after it. The local tracks of its
note do not tell that it is the same; its place does, as it would have without the kill: the new local track is within
the gate of the prediction.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Floats, Ints, among, from_bytes, picked, to_bytes
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.motions import Motions, States
from fusion_service.centre.partial import Unknown
from fusion_service.centre.rows import Rows
from schemas import Frame, Motion

__all__ = ["Begun", "Whereabouts", "founders"]

Ids = NDArray[np.uint64]


@dataclass(frozen=True, slots=True, eq=False)
class Begun:
    """What G new tracks begin with: mean (n, G), covariance (n, n, G), gate (n + 1, G) by how many components are in
    common, as `unknown` tells."""

    mean: Floats
    covariance: Floats
    gate: Floats
    unknown: Unknown


def founders(rows: Rows, at: Ints, groups: Ints, chosen: Ints, unknown: Unknown) -> Begun:
    """Of the groups `chosen` (G,), sorted: their first rows. groups (A,): of the rows `at`."""
    first = np.unique(groups, return_index=True)[1]
    row = at[first[chosen]]
    tracks = rows.tracks
    return Begun(picked(tracks.mean, row), picked(tracks.covariance, row), picked(rows.gate, row), unknown)


@dataclass(frozen=True, slots=True, eq=False)
class Whereabouts:
    """K tracks in `frame` (in words): id (K,) sorted, time (K,) ns, mean (n, K), covariance (n, n, K)."""

    frame: str
    id: Ids
    time: NDArray[np.int64]
    mean: Floats
    covariance: Floats

    @classmethod
    def nothing(cls, n: int = 0) -> Whereabouts:
        """Of no track."""
        no, never = np.zeros(0, dtype=np.uint64), np.zeros(0, dtype=np.int64)
        return cls("", no, never, np.zeros((n, 0)), np.zeros((n, n, 0)))

    @classmethod
    def of(cls, picture: Picture, above: int, frame: Frame | None) -> Whereabouts:
        """The tracks of a picture whose ids are above `above`, as far as they have a density."""
        at = np.flatnonzero((picture.id > np.uint64(above)) & (picture.time >= 0))
        return cls(
            repr(frame), picture.id[at], picture.time[at], picked(picture.mean, at), picked(picture.covariance, at)
        )

    def take(self, some: Any) -> Whereabouts:
        """Those given."""
        mean, covariance = picked(self.mean, some), picked(self.covariance, some)
        return Whereabouts(self.frame, self.id[some], self.time[some], mean, covariance)

    def followed(self, newer: Whereabouts) -> Whereabouts:
        """These and newer ones, which count where both are of one track; in another frame or space alone."""
        if self.frame != newer.frame or len(self.mean) != len(newer.mean):
            return newer if len(newer.id) else self
        old = self.take(~among(self.id, newer.id))
        both = Whereabouts(
            newer.frame,
            np.concatenate([old.id, newer.id]),
            np.concatenate([old.time, newer.time]),
            np.concatenate([old.mean, newer.mean], axis=-1),
            np.concatenate([old.covariance, newer.covariance], axis=-1),
        )
        return both.take(np.argsort(both.id))

    def now(
        self, time: int, frame: Frame | None, motions: Motions, declared: Iterable[Motion | None]
    ) -> Whereabouts | None:
        """At `time`, ns, by the motion with the most noise of those that sources declare; None of another frame."""
        if self.frame != repr(frame):
            return None
        code = motions.wildest(declared)
        states = States.of(self.time, self.mean, self.covariance, np.full(len(self.id), code, dtype=np.int32))
        moved = motions.moved(states, states.motion, np.maximum(time - self.time, 0) / 1e9)
        return Whereabouts(
            self.frame, self.id, np.full(len(self.id), time, dtype=np.int64), moved.mean, moved.covariance
        )

    def nearest(self, begun: Begun, open_: Ints) -> dict[int, int]:
        """Which of the new tracks `open_` is which of these, each once, the nearest first: {index: id}."""
        if len(self.mean) != len(begun.mean) or not len(self.id):
            return {}
        found: list[tuple[float, int, int]] = []
        for index in open_.tolist():
            spread = self.covariance + begun.covariance[:, :, index, None]
            distance = linalg.quadratic(spread, self.mean - begun.mean[:, index, None])
            size, _ = begun.unknown.common(spread)
            near = np.flatnonzero(distance <= begun.gate[size, index])
            found += [(float(distance[one]), index, int(self.id[one])) for one in near.tolist()]
        given: dict[int, int] = {}
        for _, index, track in sorted(found):
            if index not in given and track not in given.values():
                given[index] = track
        return given

    def packed(self) -> dict[str, Any]:
        """As plain values."""
        columns = ("id", "time", "mean", "covariance")
        return {"frame": self.frame, "n": len(self.mean)} | {one: to_bytes(getattr(self, one)) for one in columns}

    @classmethod
    def unpacked(cls, packed: Mapping[str, Any]) -> Whereabouts:
        """From what `packed` gave. Raises where it is something else."""
        n, like = int(packed["n"]), cls.nothing()
        id, time = from_bytes(packed["id"], like.id), from_bytes(packed["time"], like.time)
        mean = from_bytes(packed["mean"], like.mean).reshape(n, len(id))
        covariance = from_bytes(packed["covariance"], like.mean).reshape(n, n, len(id))
        if len(time) != len(id):
            raise ValueError("columns of different lengths")
        return cls(str(packed["frame"]), id, time, mean, covariance)
