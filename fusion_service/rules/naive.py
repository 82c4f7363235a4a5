"""The naive rule: the product of the densities, as if the tracks' errors were independent."""

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.compiled import either
from fusion_service.rules.base.block import Result, Sources, weighted_product
from fusion_service.rules.base.rule import Rule

__all__ = ["RULE", "naive"]


def naive(sources: Sources, weights: Floats | None, influence: bool) -> Result:
    """P^-1 = sum P_i^-1 and P^-1 x = sum P_i^-1 x_i. It has no weights: they are NaN."""
    mean, P, condition = weighted_product(sources, None)
    share = linalg.inner(P[:, :, None], sources.information) / len(P) if influence else None
    nan = np.full_like(sources.means[0], np.nan)
    return Result(mean, P, nan, share, condition, np.zeros_like(condition))


@either
def product_of_all(x: Floats, P: Floats) -> tuple[Floats, Floats, Floats] | None:
    """See `Rule.at_once`: NumPy has no faster road."""
    return None


RULE = Rule(
    name="naive",
    order=1,
    title="product of the densities",
    promise="right only for independent tracks",
    source="product of the densities",
    fuse=naive,
    information=True,
    takes_weights=False,
    at_once=product_of_all,
)
