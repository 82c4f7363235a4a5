"""Life of global tracks: tentative, confirmed, coasting, deleted.

A track is confirmed by new data in M of its last N chances, or at once by several sources in one step; a
confirmed track without support coasts on its own motion and is deleted when that lasts too long; a tentative
one is deleted sooner. One whose existence falls below `min_existence` is tentative again, and deleted if it
has no support. A chance is a step with new data in it, or without any support.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre.sources import as_mixtures, join_tracks, no_parts
from fusion_service.config import CentreConfig
from fusion_service.densities import Mixtures
from schemas.messages import COASTING, CONFIRMED, TENTATIVE

__all__ = ["Picture", "advance", "empty_picture", "newborn"]


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """G global tracks sorted by id: mean (n, G), covariance (n, n, G), the rest (G,).

    log_weight (C, G), part_mean (n, C, G), part_covariance (n, n, C, G): components as in `sources.Tracks`.
    id u64; status u8; time i64 of the density (-1: none yet); updated i64 of the last measurement in it;
    seen i64 time of the newest local track in it; born i64 of its first step; supported i64 of the last step
    with a linked track; hits u64, the last chances as bits; existence.
    """

    id: NDArray[np.uint64]
    status: NDArray[np.uint8]
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    log_weight: NDArray[np.float64]
    part_mean: NDArray[np.float64]
    part_covariance: NDArray[np.float64]
    time: NDArray[np.int64]
    updated: NDArray[np.int64]
    seen: NDArray[np.int64]
    born: NDArray[np.int64]
    supported: NDArray[np.int64]
    hits: NDArray[np.uint64]
    existence: NDArray[np.float64]

    def take(self, rows: Any) -> Picture:
        """The given rows (indices or a mask)."""
        return Picture(*(getattr(self, one.name)[..., rows] for one in fields(self)))

    def mixtures(self, rows: Any) -> Mixtures:
        """The densities of the given rows as mixtures."""
        return as_mixtures(self, rows)

    def find(self, ids: NDArray[np.uint64]) -> NDArray[np.intp]:
        """Rows of ids that are in the picture."""
        return np.searchsorted(self.id, ids)

    def join(self, other: Picture) -> Picture:
        """Both; ids of `other` are above all of these."""
        return join_tracks([self, other])


def empty_picture(n: int) -> Picture:
    """No tracks, of n components."""
    return newborn(np.zeros(0, dtype=np.uint64), n, 0)


def newborn(ids: NDArray[np.uint64], n: int, time: int) -> Picture:
    """Tentative tracks without a density yet."""
    count = len(ids)
    parts = no_parts(n, count)
    never = np.full(count, -1, dtype=np.int64)
    return Picture(
        id=ids,
        status=np.full(count, TENTATIVE, dtype=np.uint8),
        mean=np.zeros((n, count)),
        covariance=np.zeros((n, n, count)),
        log_weight=parts[0],
        part_mean=parts[1],
        part_covariance=parts[2],
        time=never,
        updated=never,
        seen=never,
        born=np.full(count, time, dtype=np.int64),
        supported=np.full(count, time, dtype=np.int64),
        hits=np.zeros(count, dtype=np.uint64),
        existence=np.ones(count),
    )


def advance(
    picture: Picture, time: int, support: NDArray[np.intp], fresh: NDArray[np.bool_], config: CentreConfig
) -> tuple[Picture, NDArray[np.bool_]]:
    """One step of every life. support (G,): how many sources feed the track; fresh (G,): with new data.

    Returns the picture with new status, and which tracks end now.
    """
    supported = support > 0
    chance = fresh | ~supported
    window = np.uint64(2**config.confirm_within - 1)
    shifted = ((picture.hits << np.uint64(1)) | fresh.astype(np.uint64)) & window
    hits = np.where(chance, shifted, picture.hits)
    proven = (np.bitwise_count(hits) >= config.confirm_hits) | (support >= config.confirm_sources)
    weak = picture.existence < config.min_existence
    confirm = supported & ~weak & proven & (picture.existence >= config.confirm_existence)
    status = np.where((picture.status == TENTATIVE) & ~confirm, TENTATIVE, np.where(supported, CONFIRMED, COASTING))
    status = np.where(weak, TENTATIVE, status)
    last = np.where(supported, time, picture.supported)
    overdue = time - last > round(config.coast * 1e9)
    hopeless = (status == TENTATIVE) & ~supported & (hits == 0)
    ended = ~supported & (overdue | hopeless | weak)
    return replace(picture, status=status.astype(np.uint8), hits=hits, supported=last), ended
