"""How much a count of samples shows of a rate: one-sided bounds by Clopper and Pearson (1934), and of Poisson's.

Of k in n the upper bound p solves P(K <= k | n, p) = 1 - confidence: for k = 0 it is 1 - (1 - confidence)^(1/n), about
3 / n at 95 % (the rule of three). The samples are taken as independent; those of one track are not, so a bound says
less than it seems to.
"""

from __future__ import annotations

import math

from scipy.special import betaincinv, gammaincinv

__all__ = ["lower", "needed", "upper", "upper_count"]


def upper(k: int, n: int, confidence: float) -> float:
    """The largest rate that k of n leaves possible; 1 without samples."""
    return 1.0 if k >= n else float(betaincinv(k + 1, n - k, confidence))


def lower(k: int, n: int, confidence: float) -> float:
    """The smallest; 0 without samples."""
    return 0.0 if k <= 0 else float(betaincinv(k, n - k + 1, 1.0 - confidence))


def upper_count(k: int, confidence: float) -> float:
    """The largest expected number that a count of k leaves possible (Poisson)."""
    return float(gammaincinv(k + 1, confidence)) if confidence > 0 else float(k)


def needed(rate: float, confidence: float) -> float:
    """How many samples without a single failure show that the rate is at most this; infinity for 0."""
    return math.log1p(-confidence) / math.log1p(-rate) if 0.0 < rate < 1.0 else (math.inf if rate <= 0.0 else 0.0)
