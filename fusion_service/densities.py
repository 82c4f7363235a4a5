"""Gaussian mixtures of many tracks as arrays: components in rows, `counts` says how many each track has."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["moments"]

Floats = NDArray[np.float64]


def moments(
    means: Floats, covariances: Floats, weights: Floats | None, counts: NDArray[np.uint16] | None
) -> tuple[Floats, Floats]:
    """Mean (T, n) and covariance (T, n, n) of each track's mixture of `counts` (T,) components.

    means (C, n), covariances (C, n, n), weights (C,), which sum to 1 per track up to rounding and are
    normalised here. Without weights or counts every track is one Gaussian and is returned as it is.
    A component that is not finite spoils its own track only.
    """
    if weights is None or counts is None or not len(counts):
        return means, covariances
    sizes = counts.astype(np.intp)
    starts = np.cumsum(sizes) - sizes
    with np.errstate(all="ignore"):
        share = weights / np.repeat(np.add.reduceat(weights, starts), sizes)
        mean = np.add.reduceat(share[:, None] * means, starts)
        offset = means - np.repeat(mean, sizes, axis=0)
        spread = covariances + offset[:, :, None] * offset[:, None, :]
        return mean, np.add.reduceat(share[:, None, None] * spread, starts)
