"""The local tracks of all sources as one step sees them, in one state space and one order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import marked
from fusion_service.centre.lineage import Kin
from fusion_service.centre.tracks import Tracks

__all__ = ["NO_TRACK", "Rows"]

NO_TRACK = np.uint64(0)
"""The link of a track that belongs to no global track."""


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """M usable local tracks in canonical order (source, epoch, id).

    source (M,): index into the sorted names. epoch (M,) u64. tracks: their columns, mean (n, M) and covariance
    (n, n, M) predicted and brought to the centre's space; the columns of links may be written. may_start (M,).
    interval (M,): ns to the next report that is expected of it. lost (M,): the source's token is gone. gate (n + 1,
    M): d2 within which it may join or begin a track, by how many components are in common. fresh (M,): a measurement
    is in it that was not judged before. kept: how many of them each source has, in order. kin: whose data is in each,
    None where that is not known. out (M,): of a source that is watched, but not fused; union (M,): of one that is fused
    with others by covariance union.
    """

    source: NDArray[np.intp]
    epoch: NDArray[np.uint64]
    tracks: Tracks
    may_start: NDArray[np.bool_]
    interval: NDArray[np.int64]
    lost: NDArray[np.bool_]
    gate: NDArray[np.float64]
    fresh: NDArray[np.bool_]
    kept: dict[str, int]
    kin: Kin | None = None
    out: NDArray[np.bool_] | None = None
    union: NDArray[np.bool_] | None = None

    @property
    def echo(self) -> NDArray[np.bool_]:
        """(M,): there are data of this centre in it."""
        return np.zeros(len(self.source), dtype=np.bool_) if self.kin is None else self.kin.echo

    def linked(self) -> NDArray[np.intp]:
        """Rows that belong to a global track."""
        return marked(self.tracks.link != NO_TRACK)

    def inside_mask(self) -> NDArray[np.bool_]:
        """`inside` as a mask (M,)."""
        inside = (self.tracks.link != NO_TRACK) & ~self.tracks.outside
        return np.asarray(inside if self.out is None else inside & ~self.out)

    def inside(self) -> NDArray[np.intp]:
        """Rows that belong to a global track and are fused in it: their newest datum has passed its gate."""
        return marked(self.inside_mask())
