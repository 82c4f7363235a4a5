"""Numeric checks, run on the densities of many messages at once.

A density is sound when its numbers are finite and within `MAX_MEAN` and `VARIANCES`, its covariance is
positive definite (LDL' factorisation, every pivot above `PIVOT` times the variance it started from), its
weights are not negative and sum to 1 per track (an intensity's only are finite and not negative), its existence
is in [0, 1], and what it says of an extent is sound (see `extents`). Every operation is element by element over
the batch, so that a message gets the same codes alone and among others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import accumulate, pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from schemas.extents import sound_extents, sound_references, sound_sigmas
from schemas.messages import Floats, GlobalTracks, LocalIntensity, LocalTracks

__all__ = ["FAULTS", "check_numbers"]

FAULTS = ("", "not-finite", "out-of-range", "not-positive-definite", "weights", "existence", "extent")
"""Reasons by the code that `check_numbers` gives; 0 is sound. The first that holds is given."""

MAX_MEAN = 1e12
VARIANCES = (1e-20, 1e24)
PIVOT = 1e-14
WEIGHT_SUM = 1e-6
FEW = 256
"""Densities up to which calls cost more than what is done in them."""
BLOCK = 2048
"""Densities factorised at a time: what fits the cache."""

_FINITE, _RANGE, _DEFINITE, _WEIGHTS, _EXISTENCE, _EXTENT = range(1, 7)
_EXTENTS = (("extent", sound_extents), ("extent_sigma", sound_sigmas), ("reference_covariances", sound_references))

Densities: TypeAlias = LocalTracks | LocalIntensity | GlobalTracks
Codes: TypeAlias = NDArray[np.uint8]


def check_numbers(messages: Sequence[Densities]) -> list[Codes]:
    """For each message one fault code (index into `FAULTS`) per track, or per component of an intensity.

    A track of several components has the highest code of them. One bad component spoils no other track.
    """
    faults: list[Codes] = [np.zeros(0, dtype=np.uint8)] * len(messages)
    by_dimension: dict[int, list[int]] = {}
    for index, message in enumerate(messages):
        by_dimension.setdefault(message.means.shape[1], []).append(index)
    with np.errstate(all="ignore"):
        for together in by_dimension.values():
            for indices in _batches(together, messages):
                means, covariances = _one(messages, indices, "means"), _one(messages, indices, "covariances")
                codes = _density_faults(means, covariances)
                ends = accumulate((len(messages[index].means) for index in indices), initial=0)
                for index, (low, high) in zip(indices, pairwise(ends), strict=True):
                    faults[index] = codes[low:high]
        _weight_faults(messages, faults)
        _existence_faults(messages, faults)
        _extent_faults(messages, faults)
    return faults


def _batches(indices: list[int], messages: Sequence[Densities]) -> Iterator[list[int]]:
    """Messages that fill a block alone, each as it is; the small ones together."""
    small = []
    for index in indices:
        if len(messages[index].means) >= BLOCK:
            yield [index]
        else:
            small.append(index)
    if small:
        yield small


def _one(messages: Sequence[Densities], indices: list[int], name: str) -> Floats:
    columns: list[Floats] = [getattr(messages[index], name) for index in indices]
    return columns[0] if len(columns) == 1 else np.concatenate(columns)


def _density_faults(means: Floats, covariances: Floats) -> Codes:
    codes = np.zeros(len(means), dtype=np.uint8)
    blocks = [slice(start, start + BLOCK) for start in range(0, len(means), BLOCK)]
    bad = np.flatnonzero(~np.concatenate([_sound(means[block], covariances[block]) for block in blocks or [slice(0)]]))
    if bad.size:
        means, covariances = means[bad], covariances[bad]
        variances = np.einsum("bii->bi", covariances)
        outside = (np.abs(means) > MAX_MEAN).any(axis=1) | (variances > VARIANCES[1]).any(axis=1)
        outside |= ((variances > 0) & (variances < VARIANCES[0])).any(axis=1)
        finite = np.isfinite(means).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
        codes[bad] = np.where(finite, np.where(outside, _RANGE, _DEFINITE), _FINITE)
    return codes


def _sound(means: Floats, covariances: Floats) -> NDArray[np.bool_]:
    """True where numbers are in range and every pivot is large enough; NaN and infinity fail each comparison."""
    n = means.shape[1]
    good: NDArray[np.bool_] = np.all(np.abs(means.T) <= MAX_MEAN, axis=0)
    rest = covariances.reshape(len(means), n * n).T.copy().reshape(n, n, -1)
    for k in range(n):
        variance = covariances[:, k, k]
        pivot = rest[k, k]
        good &= (variance >= VARIANCES[0]) & (variance <= VARIANCES[1]) & (pivot > PIVOT * variance)
        if len(means) <= FEW:  # the upper triangle too, in fewer calls
            below = rest[k + 1 :, k]
            rest[k + 1 :, k + 1 :] -= (below / pivot)[:, None] * below
            continue
        for i in range(k + 1, n):
            factor = rest[i, k] / pivot
            for j in range(k + 1, i + 1):
                rest[i, j] -= factor * rest[j, k]
    return good


def _weight_faults(messages: Sequence[Densities], faults: list[Codes]) -> None:
    """Mark bad weights in `faults`, whose codes are per component so far, and make them per track."""
    mixtures, counts, weights = [], [], []
    for index, message in enumerate(messages):
        if isinstance(message, LocalIntensity):
            sound = (message.weights >= 0) & np.isfinite(message.weights)
            faults[index][(faults[index] == 0) & ~sound] = _WEIGHTS
        elif message.weights is not None and len(message.ids):
            mixtures.append(index)
            counts.append(np.ones(len(message.ids), np.uint16) if message.counts is None else message.counts)
            weights.append(message.weights)
    if not mixtures:
        return
    count = np.concatenate(counts).astype(np.intp)
    starts = np.cumsum(count) - count
    weight = np.concatenate(weights)
    codes = np.maximum.reduceat(np.concatenate([faults[index] for index in mixtures]), starts)
    sound = np.minimum.reduceat(weight, starts) >= 0
    sound &= np.abs(np.add.reduceat(weight, starts) - 1.0) <= WEIGHT_SUM
    codes[(codes == 0) & ~sound] = _WEIGHTS
    ends = accumulate(map(len, counts), initial=0)
    for index, (low, high) in zip(mixtures, pairwise(ends), strict=True):
        faults[index] = codes[low:high]


def _existence_faults(messages: Sequence[Densities], faults: list[Codes]) -> None:
    told: list[tuple[int, Floats]] = []
    for index, message in enumerate(messages):
        if not isinstance(message, LocalIntensity) and message.existence is not None:
            told.append((index, message.existence))
    if not told:
        return
    existence = np.concatenate([values for _, values in told])
    if ((existence >= 0) & (existence <= 1)).all():
        return
    for index, values in told:
        faults[index][(faults[index] == 0) & ~((values >= 0) & (values <= 1))] = _EXISTENCE


def _extent_faults(messages: Sequence[Densities], faults: list[Codes]) -> None:
    for index, message in enumerate(messages):
        for name, is_sound in _EXTENTS:
            column = getattr(message, name, None)
            if column is not None:
                faults[index][(faults[index] == 0) & ~is_sound(column)] = _EXTENT
