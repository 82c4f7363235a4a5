"""Numeric checks, run on the densities of many messages at once.

A density is sound when its numbers are finite and within `MAX_MEAN` and `VARIANCES`, its covariance is
positive definite (every pivot of the factorisation of the correlation matrix above `PIVOT`), its weights are
not negative and sum to 1 per track (an intensity's only are not negative), and its existence is in [0, 1].
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from schemas.messages import Floats, GlobalTracks, LocalIntensity, LocalTracks

__all__ = ["FAULTS", "check_numbers"]

FAULTS = ("", "not-finite", "out-of-range", "not-positive-definite", "weights", "existence")
"""Reasons by the code that `check_numbers` gives; 0 is sound."""

MAX_MEAN = 1e12
VARIANCES = (1e-20, 1e24)
PIVOT = 1e-14
WEIGHT_SUM = 1e-6

_FINITE, _RANGE, _DEFINITE, _WEIGHTS, _EXISTENCE = range(1, 6)


def check_numbers(messages: Sequence[LocalTracks | LocalIntensity | GlobalTracks]) -> list[NDArray[np.uint8]]:
    """For each message one fault code (index into `FAULTS`) per track, or per component of an intensity.

    All components of one state dimension are checked together; a bad one spoils no other.
    """
    faults: list[NDArray[np.uint8]] = [np.zeros(0, dtype=np.uint8)] * len(messages)
    by_dimension: dict[int, list[int]] = {}
    for index, message in enumerate(messages):
        by_dimension.setdefault(message.means.shape[-1], []).append(index)
    for indices in by_dimension.values():
        means = np.concatenate([messages[index].means for index in indices])
        covariances = np.concatenate([messages[index].covariances for index in indices])
        codes = _density_faults(means, covariances)
        ends = np.cumsum([0, *(len(messages[index].means) for index in indices)])
        for index, (low, high) in zip(indices, pairwise(ends), strict=True):
            faults[index] = _track_faults(messages[index], codes[low:high])
    return faults


def _density_faults(means: Floats, covariances: Floats) -> NDArray[np.uint8]:
    codes = np.zeros(len(means), dtype=np.uint8)
    variances = np.einsum("bii->bi", covariances)
    with np.errstate(all="ignore"):
        definite = _definite(covariances, variances)
        in_range = (np.abs(means) <= MAX_MEAN).all(axis=1)
        in_range &= ((variances >= VARIANCES[0]) & (variances <= VARIANCES[1])).all(axis=1)
    codes[~definite] = _DEFINITE
    codes[~in_range & (variances > 0).all(axis=1)] = _RANGE
    codes[~(np.isfinite(means).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2)))] = _FINITE
    return codes


def _definite(covariances: Floats, variances: Floats) -> NDArray[np.bool_]:
    """Whether each correlation matrix has an LDL' factorisation with pivots above `PIVOT`."""
    n = covariances.shape[-1]
    scale = 1.0 / np.sqrt(variances)
    rest = np.ascontiguousarray(np.moveaxis(covariances * scale[:, :, None] * scale[:, None, :], 0, -1))
    good: NDArray[np.bool_] = np.all(variances > 0, axis=1)
    for k in range(n):
        good &= rest[k, k] > PIVOT
        for i in range(k + 1, n):
            factor = rest[i, k] / rest[k, k]
            for j in range(k + 1, i + 1):
                rest[i, j] -= factor * rest[j, k]
    return good


def _track_faults(message: LocalTracks | LocalIntensity | GlobalTracks, codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if isinstance(message, LocalIntensity):
        bad = ~((message.weights >= 0) & np.isfinite(message.weights))
        return np.where((codes == 0) & bad, np.uint8(_WEIGHTS), codes)
    if message.weights is None:
        faults = codes.copy()
    else:
        counts = np.ones(len(message.ids), dtype=np.intp) if message.counts is None else message.counts.astype(np.intp)
        starts = np.cumsum(counts) - counts
        if not len(counts):
            return codes
        faults = np.maximum.reduceat(codes, starts)
        with np.errstate(all="ignore"):
            total = np.add.reduceat(message.weights, starts)
            sound = np.minimum.reduceat(message.weights, starts) >= 0
            sound &= np.abs(total - 1.0) <= WEIGHT_SUM
        faults[(faults == 0) & ~sound] = _WEIGHTS
    if message.existence is not None:
        with np.errstate(all="ignore"):
            sound = (message.existence >= 0) & (message.existence <= 1)
        faults[(faults == 0) & ~sound] = _EXISTENCE
    return faults
