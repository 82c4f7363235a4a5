"""What is taken off the tracks of a source: its registration error as estimated, and what stays uncertain of it.

Places are corrected exactly (`bias` says how the errors act):

    d = R(-heading) (z - t - p),    u = p + d (|d| - range) / (|d| (1 + scale)),

velocities and accelerations by the Jacobian of that, and covariances with them. The clock is corrected by the time to
which a track is predicted. What stays uncertain, of covariance Sigma, is an error that all tracks of the source have in
common: H Sigma H' is added to the covariance of each.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.centre.supervision.bias import CLOCK, HEADING, PARAMETERS, RANGE, SCALE, X, Y, design
from fusion_service.centre.tracks import Tracks
from fusion_service.densities import Mixtures

__all__ = ["Bias"]

PAIRS = (("x", "y"), ("vx", "vy"), ("ax", "ay"))
TRIFLE = 1e-12
"""By which variances of what stays are larger: what they are added to may be less than what is lost in rounding."""
LEAST_STRETCH = 0.1
"""No scale is taken off that makes ranges ten times as long."""


@dataclass(frozen=True, slots=True, eq=False)
class Bias:
    """The error of a source at `site` (2,) in the picture's `space`: value (7,), what is taken off, and covariance
    (7, 7), what stays. loose: so much stays that it is no more to be neglected beside the errors of its tracks."""

    space: tuple[str, ...]
    site: Floats
    value: Floats
    covariance: Floats
    loose: bool = False

    def off(self, tracks: Tracks) -> Tracks:
        """The tracks without it; what remains uncertain of it added to their covariances."""
        mean, covariance = self.moved(tracks.mean, tracks.covariance)
        if not len(tracks.log_weight):
            return replace(tracks, mean=mean, covariance=covariance + self.common(mean))
        n, count, size = tracks.part_mean.shape
        flat = tracks.part_mean.reshape(n, -1), tracks.part_covariance.reshape(n, n, -1)
        means, covariances = self.moved(*flat)
        covariances = (covariances + self.common(means)).reshape(n, n, count, size)
        means = means.reshape(n, count, size)
        mean, covariance = Mixtures(tracks.log_weight, means, covariances).moments()
        return replace(tracks, mean=mean, covariance=covariance, part_mean=means, part_covariance=covariances)

    def moved(self, mean: Floats, covariance: Floats) -> tuple[Floats, Floats]:
        """Densities (n, T), (n, n, T) without the error."""
        at = [self.space.index(name) for name in PAIRS[0]]
        turned, J = self._place(mean[at])
        G = np.zeros((len(self.space), *mean.shape))
        for k in range(len(self.space)):
            G[k, k] = 1.0
        out = mean.copy()
        for pair in PAIRS:
            if pair[0] in self.space and pair[1] in self.space:
                two = [self.space.index(name) for name in pair]
                G[np.ix_(two, two)] = J
                out[two] = np.stack([J[k, 0] * mean[two[0]] + J[k, 1] * mean[two[1]] for k in (0, 1)])
        out[at] = turned
        return out, linalg.congruence(G, covariance)

    def _place(self, z: Floats) -> tuple[Floats, Floats]:
        """Places (2, T) corrected, and the Jacobian (2, 2, T) of that."""
        c, s = np.cos(self.value[HEADING]), np.sin(self.value[HEADING])
        stretch, shift = max(1.0 + self.value[SCALE], LEAST_STRETCH), self.value[RANGE]
        away = z - self.site[:, None] - self.value[[X, Y]][:, None]
        d = np.stack([c * away[0] + s * away[1], -s * away[0] + c * away[1]])
        far = np.hypot(d[0], d[1])
        safe = np.where(far > abs(shift), far, np.inf)
        across = (1.0 - shift / safe) / stretch
        e = d / np.where(far > 0.0, far, 1.0)
        along = 1.0 / stretch
        J = np.stack(
            [
                np.stack([across + (along - across) * e[0] * e[0], (along - across) * e[0] * e[1]]),
                np.stack([(along - across) * e[0] * e[1], across + (along - across) * e[1] * e[1]]),
            ]
        )
        turn = np.array([[c, s], [-s, c]])
        J = np.stack([np.stack([J[i, 0] * turn[0, j] + J[i, 1] * turn[1, j] for j in (0, 1)]) for i in (0, 1)])
        return self.site[:, None] + d * across, J

    def common(self, mean: Floats) -> Floats:
        """H Sigma H' (n, n, T) at states (n, T): what all the tracks may be off by together."""
        n, space = len(self.space), self.space
        H = np.zeros((n, len(PARAMETERS), mean.shape[1]))
        place = mean[[space.index("x"), space.index("y")]]
        moves = "vx" in space and "vy" in space
        velocity = mean[[space.index("vx"), space.index("vy")]] if moves else np.zeros_like(place)
        H[[space.index("x"), space.index("y")]] = design(
            place, velocity, np.broadcast_to(self.site[:, None], place.shape)
        )
        if moves:
            vx, vy = space.index("vx"), space.index("vy")
            H[vx, HEADING], H[vy, HEADING] = -velocity[1], velocity[0]
            H[vx, SCALE], H[vy, SCALE] = velocity
        if {"vx", "vy", "ax", "ay"} <= set(space):
            H[vx, CLOCK], H[vy, CLOCK] = -mean[space.index("ax")], -mean[space.index("ay")]
        spread = np.broadcast_to(self.covariance[:, :, None], (*self.covariance.shape, mean.shape[1]))
        out = linalg.congruence(H, spread)
        for k in range(n):
            out[k, k] *= 1.0 + TRIFLE
        return out
