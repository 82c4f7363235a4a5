"""What is done with the tracks of a source before they are used, by what the centre has learned of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.centre.tracks import Tracks
from fusion_service.densities import Mixtures

__all__ = ["AS_IT_IS", "PLACES", "Correction", "Treatment", "treated"]

PLACES = ("x", "y", "z")


class Correction(Protocol):
    """A registration error that is taken off a source's tracks. loose: what remains uncertain of it is too much to be
    neglected beside their own errors."""

    @property
    def loose(self) -> bool: ...

    def off(self, tracks: Tracks) -> Tracks:
        """The tracks, in the picture's space and frame, without it; what remains uncertain of it added to their
        covariances."""
        ...

    def moved(self, mean: Floats, covariance: Floats) -> tuple[Floats, Floats]:
        """Densities (n, T), (n, n, T) without it, and nothing added."""
        ...


@dataclass(frozen=True, slots=True)
class Treatment:
    """clock: ns that a source's time stamps are too late; what is stamped t held at t - clock. correction: what is
    taken off its states. inflation: factors on the variances of its positions and of the rest. out: it is watched, but
    fused with nothing, and starts nothing. union: with others by covariance union. lasting: its errors stay the same:
    its successive data are not taken as tracklets."""

    clock: int = 0
    correction: Correction | None = None
    inflation: tuple[float, float] = (1.0, 1.0)
    out: bool = False
    union: bool = False
    lasting: bool = False

    @property
    def plain(self) -> bool:
        """Whether the densities of its tracks stay as they are."""
        return not self.clock and self.correction is None and self.inflation == (1.0, 1.0)


AS_IT_IS = Treatment()


def treated(tracks: Tracks, space: tuple[str, ...], treatment: Treatment) -> Tracks:
    """Tracks of one source in the picture's `space`, after its treatment."""
    if treatment.inflation != (1.0, 1.0):
        tracks = _inflated(tracks, space, treatment.inflation)
    return tracks if treatment.correction is None else treatment.correction.off(tracks)


def _inflated(tracks: Tracks, space: tuple[str, ...], inflation: tuple[float, float]) -> Tracks:
    """Covariances S P S, S the roots of the factors: correlations stay as they are."""
    root: Floats = np.sqrt(np.array([inflation[name not in PLACES] for name in space]))
    factor = (root[:, None] * root)[:, :, None]
    if not len(tracks.log_weight):
        return replace(tracks, covariance=factor * tracks.covariance)
    parts = factor[..., None] * tracks.part_covariance
    mean, covariance = Mixtures(tracks.log_weight, tracks.part_mean, parts).moments()
    return replace(tracks, mean=mean, covariance=covariance, part_covariance=parts)
