"""Monte Carlo numbers with their standard errors. The runs are the last axis."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Estimate", "armse", "jackknife", "mean", "pooled_rms", "rmse"]

Floats = NDArray[np.float64]


class Estimate(NamedTuple):
    """A number and its standard error."""

    value: float
    stderr: float


def mean(samples: Floats) -> Estimate:
    """Mean of independent samples (M,)."""
    return Estimate(float(np.mean(samples)), float(np.std(samples, ddof=1) / np.sqrt(len(samples))))


def rmse(squared: Floats) -> Estimate:
    """Root of the mean of squared errors (M,); its error by the delta method."""
    return armse(squared[None])


def armse(squared: Floats) -> Estimate:
    """Time mean of the root of the mean over runs, of squared errors (K, M): the ARMSE of the papers.

    Standard error by the delta method: run m moves it by mean_k (e2_km - mse_k) / (2 sqrt mse_k), errors along one run
    being as correlated as they are.
    """
    mse = squared.mean(axis=1)
    root = np.sqrt(mse)
    moved = ((squared - mse[:, None]) / (2 * np.maximum(root, 1e-300))[:, None]).mean(axis=0)
    return Estimate(float(root.mean()), float(np.std(moved, ddof=1) / np.sqrt(squared.shape[1])))


def pooled_rms(samples: Floats) -> float:
    """Root of the mean squared error of all runs together, of (2, M): each run's sum of squares, and their number."""
    return float(np.sqrt(samples[0].sum() / max(samples[1].sum(), 1e-9)))


def jackknife(statistic: Callable[[Floats], float], samples: Floats, groups: int = 50) -> Estimate:
    """Any statistic of samples (..., M) with its error by leaving out one of `groups` groups of runs at a time."""
    M = samples.shape[-1]
    groups = min(groups, M)
    edges = np.linspace(0, M, groups + 1).round().astype(int)
    left = [
        statistic(np.concatenate([samples[..., :low], samples[..., high:]], axis=-1)) for low, high in pairwise(edges)
    ]
    spread = (groups - 1) / groups * float(np.sum((np.array(left) - np.mean(left)) ** 2))
    return Estimate(statistic(samples), float(np.sqrt(spread)))
