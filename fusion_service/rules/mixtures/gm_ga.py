"""Geometric mean of mixtures, prod f_i^w_i, every power of a sum taken as the sum of the powers: Li-2nd (49)-(51).

That drops the cross terms: the result is nowhere below the exact density and its mass is too large (1.8964 instead of
1.5634 in the example of Fig. 7). cross_terms="sampled" gives every component its share of the exact density.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.densities import Mixtures, log_sum, power_product
from fusion_service.rules.base.options import Option, one_of
from fusion_service.rules.base.rule import MixtureRule
from fusion_service.rules.mixtures.base.criteria import MEAN, inflated, weights_by
from fusion_service.rules.mixtures.base.parts import Terms, sampled_parts

__all__ = ["RULE", "gm_ga"]


def gm_ga(
    sources: Sequence[Mixtures],
    weights: Floats | None,
    prune: float,
    *,
    criterion: str,
    samples: int,
    alpha: float,
    seed: int,
    cross_terms: str,
) -> tuple[Mixtures, Floats]:
    """Geometric mean, powers to first order."""
    sources = inflated(sources, alpha)
    if weights is None:
        weights = weights_by(criterion, "ci", sources, samples, seed)
    if cross_terms == "dropped":
        return power_product(sources, weights), weights
    return sampled_parts(_log_ratio, sources, weights, samples, seed), weights


def _log_ratio(terms: Iterator[Terms]) -> Floats:
    """prod f_i^w_i / sum over the choices of prod a_i^w_i: every part's share of the exact density."""
    return np.asarray(sum(np.where(t.used, t.w * t.whole - log_sum(t.w * t.components), 0.0) for t in terms))


RULE = MixtureRule(
    name="gm-ga",
    order=2,
    title="geometric mean, powers to first order",
    promise="keeps modes that all sources share; mass too large, cross terms dropped",
    source="Li-2nd (49)-(51)",
    fuse=gm_ga,
    information=True,
    takes={**MEAN, "cross_terms": Option("dropped", one_of("dropped", "sampled"))},
)
