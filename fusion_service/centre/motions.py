"""How global tracks move on their own: by the config's motion, or by what the sources that feed them declare.

Of several sources of one track the motion with the most noise is taken: a prediction that allows for too much costs
little, one that allows for too little is sure of what is wrong.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats, Ints, all_of, picked
from fusion_service.centre.align import predict_tracks
from fusion_service.centre.intake import Intake
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.tracks import join_tracks, no_parts
from fusion_service.motion import predict
from schemas import Motion

__all__ = ["USUAL", "Motions", "States"]

Codes = NDArray[np.int32]
USUAL = Motion("cv", 1.0)
"""Of a track whose sources declare none."""
AHEAD = 10.0
"""Seconds after which the noise of two motions is compared."""
ROOM = 64


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """G densities: time (G,) ns, mean (n, G), covariance (n, n, G), motion (G,) code; the columns of components are
    there for `predict_tracks`, and empty."""

    time: NDArray[np.int64]
    mean: Floats
    covariance: Floats
    motion: NDArray[np.int32]
    log_weight: Floats
    part_mean: Floats
    part_covariance: Floats

    @classmethod
    def of(cls, time: NDArray[np.int64], mean: Floats, covariance: Floats, motion: NDArray[np.int32]) -> States:
        """From its columns."""
        return cls(time, mean, covariance, motion, *no_parts(len(mean), len(time)))

    def take(self, at: Any) -> States:
        """The given ones (indices or a mask)."""
        return States(*(picked(getattr(self, one.name), at) for one in fields(self)))


Kind = TypeVar("Kind", Picture, States)


class Motions:
    """The motions that global tracks have: motion by code, `Picture.motion`; -1 is that of the config."""

    def __init__(self, intake: Intake) -> None:
        self._intake, self._config = intake, intake.config
        self.known: list[Motion] = []
        self._noise: list[tuple[float, str]] = []

    def code(self, motion: Motion) -> int:
        """Its code, a new one where it is new."""
        if motion not in self.known:
            self.known.append(motion)
            space = tuple(axis for axis in ("x", "y", "vx", "vy") if axis in self._config.space)
            n = len(space)
            _, spread = predict(motion, space, np.zeros((n, 1)), np.zeros((n, n, 1)), np.full(1, AHEAD))
            self._noise.append((float(spread[0, 0, 0]), repr(motion)))
        return self.known.index(motion)

    def predicted(self, picture: Picture, time: int) -> Picture:
        """The picture at `time`, ns; tracks without a density as they are."""
        dt = np.where(picture.time >= 0, time - picture.time, 0) / 1e9
        return self.moved(picture, picture.motion, dt, np.maximum(picture.time - picture.seen, 0) / 1e9)

    def moved(self, tracks: Kind, codes: Codes, dt: Floats, age: Floats | None = None) -> Kind:
        """Densities, in the centre's space, with these motions `dt` seconds later, each (T,). age (T,): seconds for
        which nothing was heard of them already."""
        age, speed = np.zeros(len(dt)) if age is None else age, self._config.unknown_speed
        space, frame = self._config.space, self._intake.frame
        kinds = codes[:1] if all_of(codes == codes[:1]) else np.unique(codes)
        if len(kinds) <= 1:
            return predict_tracks(
                tracks, self.motion(int(kinds[0]) if len(kinds) else -1), space, space, dt, frame, speed, age
            )
        parts = [np.flatnonzero(codes == kind) for kind in kinds]
        moved = [
            predict_tracks(tracks.take(at), self.motion(int(kind)), space, space, dt[at], frame, speed, age[at])
            for kind, at in zip(kinds, parts, strict=True)
        ]
        return join_tracks(moved).take(np.argsort(np.concatenate(parts), kind="stable"))

    def motion(self, code: int) -> Motion:
        """The motion of a code."""
        return self._config.motion or (self.known[code] if code >= 0 else USUAL)

    def wildest(self, declared: Iterable[Motion | None]) -> int:
        """The code of the motion with the most noise among these."""
        codes = [-1 if motion is None else self.code(motion) for motion in declared]
        return max(codes, key=lambda code: self._noise[code] if code >= 0 else (0.0, ""), default=-1)

    def follow(self, picture: Picture, at: Ints, declared: Iterable[Motion | None], source: Ints) -> Codes:
        """The codes (G,) after a step: tracks that rows feed move as these declare; at (R,) rows of the picture that
        rows of `source` (R,), index into `declared`, feed."""
        if self._config.motion is not None:
            return np.full_like(picture.motion, -1)
        codes = np.array([-1 if motion is None else self.code(motion) for motion in declared], dtype=np.int32)
        if len({*codes.tolist()}) == 1:
            fed = np.zeros(len(picture.id), dtype=np.bool_)
            fed[at] = bool(codes[0] >= 0)
            return self._compacted(np.where(fed, codes[0], picture.motion).astype(np.int32))
        order = sorted(range(len(self.known)), key=self._noise.__getitem__)
        rank = np.full(len(self.known) + 1, -1)
        rank[order] = np.arange(len(order))
        best = np.full(len(picture.id), -1)
        np.maximum.at(best, at, rank[codes[source]])
        new = np.where(best >= 0, np.array([*order, -1], dtype=np.int32)[best], picture.motion).astype(np.int32)
        return self._compacted(new)

    def _compacted(self, codes: Codes) -> Codes:
        """Forget what no track has, where there is much."""
        if len(self.known) < ROOM:
            return codes
        used = np.unique(codes[codes >= 0])
        self.known = [self.known[code] for code in used.tolist()]
        self._noise = [self._noise[code] for code in used.tolist()]
        return np.where(codes >= 0, np.searchsorted(used, codes), -1).astype(np.int32)

    def packed(self) -> list[list[Any]]:
        """As plain values."""
        return [list(astuple(motion)) for motion in self.known]

    def restore(self, packed: list[list[Any]]) -> None:
        """From what `packed` gave."""
        for one in packed:
            self.code(Motion(*one))
