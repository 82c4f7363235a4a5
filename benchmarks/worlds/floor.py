"""What an assignment that knows the truth makes of the same messages: the floor under every centre.

For each target the newest local tracks of it, one of each source, predicted to the step with the source's declared
motion and fused by the centre's rule. A source counts whose newest scan lists the target; where none does, the newest
track of it is held for `HOLD` s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from benchmarks.worlds.measures import Picture
from benchmarks.worlds.world import SPACE
from fusion_service import linalg
from fusion_service.motion import predict
from fusion_service.rules import fuse
from schemas import LocalTracks, Motion

__all__ = ["Ear", "fresh_errors", "known_assignment"]

Floats = NDArray[np.float64]

HOLD = 5.0
SECOND = 10**9


@dataclass(slots=True, eq=False)
class Ear:
    """The newest that one source said of each of T targets, up to the time of a step: mean (T, 4), covariance
    (T, 4, 4), time (T,), ns, -1 for never; listed (T,) by its newest scan."""

    motion: Motion
    mean: Floats
    covariance: Floats
    time: NDArray[np.int64]
    listed: NDArray[np.bool_]
    newest: int = -1

    @staticmethod
    def of(motion: Motion, targets: int) -> Ear:
        return Ear(
            motion,
            np.zeros((targets, 4)),
            np.tile(np.eye(4), (targets, 1, 1)),
            np.full(targets, -1, dtype=np.int64),
            np.zeros(targets, dtype=bool),
        )

    def hear(self, message: LocalTracks, target: NDArray[np.int64]) -> None:
        """Take a scan, if it is newer than the newest. Of two tracks of one target the one with the lower id counts."""
        if message.time <= self.newest:
            return
        self.newest = message.time
        rows = np.flatnonzero(target >= 0)[::-1]
        who = target[rows]
        self.mean[who], self.covariance[who], self.time[who] = (
            message.means[rows],
            message.covariances[rows],
            message.time,
        )
        self.listed = np.isin(np.arange(len(self.time)), who)

    def at(self, time: int) -> tuple[Floats, Floats]:
        """Means (T, 4) and covariances (T, 4, 4) predicted to `time`, ns."""
        dt = np.where(self.time < 0, 0.0, (time - self.time) / SECOND)
        mean, covariance = predict(self.motion, SPACE, self.mean.T, np.moveaxis(self.covariance, 0, 2), dt)
        return mean.T, np.moveaxis(covariance, 2, 0)


def known_assignment(ears: list[Ear], time: int, rule: str) -> Picture:
    """The picture at `time`, ns, of an assignment that knows the truth: the id of a track is its target's index."""
    stamps = np.stack([ear.time for ear in ears])
    use = np.stack([ear.listed for ear in ears])
    held = (stamps == stamps.max(axis=0)) & (stamps >= max(time - round(HOLD * SECOND), 0))
    use = np.where(use.any(axis=0), use, held)
    means, covariances = (np.stack(part) for part in zip(*(ear.at(time) for ear in ears), strict=True))
    code = (use * 2 ** np.arange(len(ears))[:, None]).sum(axis=0)
    place, spread = np.zeros((use.shape[1], 2)), np.zeros((use.shape[1], 2, 2))
    for which in np.unique(code[code > 0]).tolist():
        who, of = np.flatnonzero(code == which), np.flatnonzero(which >> np.arange(len(ears)) & 1)
        x, P = means[np.ix_(of, who)].swapaxes(0, 1), covariances[np.ix_(of, who)].swapaxes(0, 1)
        if len(of) == 1:
            fused_mean, fused_covariance = x[:, 0], P[:, 0]
        else:
            fused = fuse(rule, x, (P + P.swapaxes(-1, -2)) / 2)
            fused_mean, fused_covariance = fused.mean, fused.covariance
        place[who], spread[who] = fused_mean[:, :2], fused_covariance[:, :2, :2]
    there = np.flatnonzero(code > 0)
    return Picture(there.astype(np.uint64), place[there], spread[there])


def fresh_errors(first: Ear, second: Ear, time: int) -> int:
    """Wrong pairs of a new optimal assignment of the tracks of two sources at `time`, ns: least sum of
    d2 + log det(Pi + Pj), without memory."""
    one, other = np.flatnonzero(first.listed), np.flatnonzero(second.listed)
    (xa, Pa), (xb, Pb) = first.at(time), second.at(time)
    i, j = (part.ravel() for part in np.meshgrid(one, other, indexing="ij"))
    both = np.moveaxis(Pa[i] + Pb[j], 0, 2)
    cost = linalg.quadratic(both, (xa[i] - xb[j]).T) + linalg.logdet(both)
    row, column = linear_sum_assignment(cost.reshape(len(one), len(other)))
    return int((one[row] != other[column]).sum())
