"""What each version of a local track adds to the one before: an equivalent measurement, in information form.

    L = P_new^-1 - P_pred^-1        y = P_new^-1 x_new - P_pred^-1 x_pred

with the version before predicted by the motion that its source declares: of a linear filter that moves its targets so,
L = H' R^-1 H and y = H' R^-1 z of its measurement z, whatever it knew before. Where the tracker's motion is another one
L has directions below zero, which are left out, as are those of less than `LEAST` of what the track knows. The first
version of a track counts whole.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fusion_service.arrays import Floats, Ints
from fusion_service.motion import predict
from fusion_service.review.smoothing.linked import Key
from fusion_service.review.snapshots import in_frame
from schemas import Frame, LocalTracks, Motion

__all__ = ["Gain", "Gained", "gain_of"]

LEAST = 1e-3


class Gain(NamedTuple):
    """At a time, ns, of a local track: y (m,) and L (m, m) in the components `space`."""

    time: int
    key: Key
    space: tuple[str, ...]
    y: Floats
    L: Floats


class _Version(NamedTuple):
    time: int
    updated: int
    mean: Floats
    covariance: Floats


class Gained:
    """Gathers the tracks of one source, in time; motion: what it declares. wanted: components that are kept."""

    def __init__(self, source: str, motion: Motion, frame: Frame, wanted: tuple[str, ...]) -> None:
        self._source, self._motion, self._frame, self._wanted = source, motion, frame, wanted
        self._last: dict[tuple[int, int], _Version] = {}
        self._space: tuple[str, ...] = ()

    def add(self, message: LocalTracks) -> list[Gain]:
        """What its tracks have added."""
        found: list[Gain] = []
        for space, _, means, covariances in in_frame([message], self._frame):
            if space != self._space:
                self._last, self._space = {}, space
            sound = np.isfinite(means).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
            ids = message.ids.tolist()
            updated = [message.time] * len(ids) if message.updated is None else message.updated.tolist()
            rows = [row for row in np.flatnonzero(sound).tolist() if self._is_new(message, ids[row], updated[row])]
            found += self._gains(message, space, means, covariances, rows)
            for row in rows:
                version = _Version(message.time, updated[row], means[row], covariances[row])
                self._last[message.epoch, ids[row]] = version
        return found

    def _is_new(self, message: LocalTracks, track: int, updated: int) -> bool:
        last = self._last.get((message.epoch, track))
        return last is None or (message.time > last.time and updated > last.updated)

    def _gains(
        self, message: LocalTracks, space: tuple[str, ...], means: Floats, covariances: Floats, rows: list[int]
    ) -> list[Gain]:
        ids = message.ids.tolist()
        kept = np.array([space.index(name) for name in self._wanted if name in space], dtype=np.intp)
        names = tuple(name for name in self._wanted if name in space)
        old = [row for row in rows if (message.epoch, ids[row]) in self._last]
        before: dict[int, tuple[Floats, Floats]] = {
            row: (np.zeros(len(kept)), np.zeros((len(kept), len(kept)))) for row in rows
        }
        if old:
            last = [self._last[message.epoch, ids[row]] for row in old]
            x = np.stack([one.mean for one in last], axis=-1)
            P = np.stack([one.covariance for one in last], axis=-1)
            dt = np.array([(message.time - one.time) / 1e9 for one in last])
            x, P = predict(self._motion, space, x, P, dt, self._frame)
            for column, row in enumerate(old):
                A = np.linalg.inv(P[np.ix_(kept, kept)][..., column])
                before[row] = np.asarray(A @ x[kept, column]), np.asarray(A)
        found = []
        for row in rows:
            y, L = gain_of(means[row][kept], covariances[row][np.ix_(kept, kept)], *before[row])
            found.append(Gain(message.time, (self._source, message.epoch, ids[row]), names, y, L))
        return found


def gain_of(mean: Floats, covariance: Floats, y_before: Floats, L_before: Floats) -> tuple[Floats, Floats]:
    """y (m,) and L (m, m) that (mean, covariance) add to what was known in information form; never less than none."""
    C = np.linalg.cholesky(covariance)
    share, turn = np.linalg.eigh(np.eye(len(mean)) - C.T @ L_before @ C)
    good: Ints = np.flatnonzero(share > LEAST)
    back = np.linalg.solve(C.T, turn[:, good])  # C^-T V
    y = np.linalg.solve(covariance, mean) - y_before
    return back @ (turn[:, good].T @ (C.T @ y)), (back * share[good]) @ back.T
