"""The naive rule: the product of the densities, as if the tracks' errors were independent."""

import numpy as np

from fusion_service import linalg
from fusion_service.linalg import FloatArray
from fusion_service.rules.sources import Result, Sources, weighted_product


def naive(sources: Sources, weights: FloatArray | None, influence: bool) -> Result:
    """P^-1 = sum P_i^-1 and P^-1 x = sum P_i^-1 x_i. It has no weights: they are NaN."""
    mean, P, condition = weighted_product(sources, None)
    share = linalg.inner(P[:, :, None], sources.information) / len(P) if influence else None
    nan = np.full_like(sources.means[0], np.nan)
    return Result(mean, P, nan, share, condition, np.zeros_like(condition))
