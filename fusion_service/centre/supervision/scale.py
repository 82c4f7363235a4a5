"""How large squares are that should have the mean 1, whatever a few of them are.

Normalised squares v of differences are kept as a histogram over their logarithm, which fades. Their scale s is where
the mean of min(v, c s), c = `CUT`, is what it is for Gaussians, s E min(chi2_k / k, c): Huber's proposal 2 for the
variance. It is found from any start, for the left side is concave in s; it has 96 % of the efficiency of the mean, and
is bounded as long as less than 1 / c of the differences are of pairs that do not belong together. (The functions of
`scipy.special` are those behind `scipy.stats.chi2`, whose import takes longer than all others of the service.)
"""

from __future__ import annotations

from functools import cache
from statistics import NormalDist

import numpy as np
from scipy.special import chdtr, chdtrc, gammaincinv

from fusion_service.arrays import Floats, Ints

__all__ = ["BINS", "CUT", "binned", "high_bound", "low_bound", "robust_scale", "sigmas"]

LOWEST, PER_OCTAVE, BINS = -8.0, 2, 84
"""Bins have their centres at 2^(LOWEST + b / PER_OCTAVE): up to 2^33, a factor 1e5 in sigma."""
CENTRES = 2.0 ** (LOWEST + np.arange(BINS) / PER_OCTAVE)
CUT = 4.0
ROUNDS = 12


def binned(value: Floats) -> tuple[Ints, Floats]:
    """Of values (R,): the bin below each, and the part of it that belongs to the next, so that means are kept."""
    inside = np.clip(np.nan_to_num(value, nan=1.0), CENTRES[0], CENTRES[-1])
    below = np.clip(np.searchsorted(CENTRES, inside, "right") - 1, 0, BINS - 2)
    return below, (inside - CENTRES[below]) / (CENTRES[below + 1] - CENTRES[below])


@cache
def _expected(k: int) -> float:
    """E min(chi2_k / k, CUT)."""
    return float(chdtr(k + 2, CUT * k) + CUT * chdtrc(k, CUT * k))


@cache
def _median(k: int) -> float:
    """The median of chi2_k / k."""
    return float(2.0 * gammaincinv(0.5 * k, 0.5) / k)


def robust_scale(histogram: Floats, k: int) -> Floats:
    """The scale (K,) of squares over k degrees of freedom each, from histograms (K, BINS); 1 where there are none."""
    total = np.add.reduce(histogram, axis=1)
    safe = np.where(total > 0.0, total, 1.0)
    middle = (np.cumsum(histogram, axis=1) >= 0.5 * safe[:, None]).argmax(axis=1)
    scale = CENTRES[middle] / _median(k)
    for _ in range(ROUNDS):
        cut = np.minimum(CENTRES, CUT * scale[:, None])
        scale = np.add.reduce(histogram * cut, axis=1) / (safe * _expected(k))
    return np.where(total > 0.0, scale, 1.0)


@cache
def sigmas(chance: float) -> float:
    """How many standard deviations a Gaussian exceeds with this chance."""
    return -NormalDist().inv_cdf(min(max(chance, 1e-15), 0.5))


def high_bound(freedom: Floats, z: float) -> Floats:
    """What a mean of so many squares exceeds with the chance of z (Wilson, Hilferty 1931)."""
    part = 2.0 / (9.0 * np.maximum(freedom, 0.2))
    return np.asarray((1.0 - part + z * np.sqrt(part)) ** 3)


def low_bound(freedom: Floats, z: float) -> Floats:
    """The same below."""
    part = 2.0 / (9.0 * np.maximum(freedom, 0.2))
    return np.asarray(np.maximum(1.0 - part - z * np.sqrt(part), 0.0) ** 3)
