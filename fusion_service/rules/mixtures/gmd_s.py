"""Geometric mean of mixtures, prod f_i^w_i, part by part by sampling (see `parts`): Sharma (61)-(65), (67)-(73)."""

from collections.abc import Iterator, Sequence

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.densities import Mixtures
from fusion_service.rules.base.rule import MixtureRule
from fusion_service.rules.mixtures.base.criteria import MEAN, inflated, weights_by
from fusion_service.rules.mixtures.base.parts import Terms, sampled_parts

__all__ = ["RULE", "gmd_s"]


def gmd_s(
    sources: Sequence[Mixtures],
    weights: Floats | None,
    prune: float,
    *,
    criterion: str,
    samples: int,
    alpha: float,
    seed: int,
) -> tuple[Mixtures, Floats]:
    """Geometric mean, sampled."""
    sources = inflated(sources, alpha)
    if weights is None:
        weights = weights_by(criterion, "ci", sources, samples, seed)
    return sampled_parts(_log_ratio, sources, weights, samples, seed), weights


def _log_ratio(terms: Iterator[Terms]) -> Floats:
    """prod (a_i / f_i)^(1-w_i)."""
    return np.asarray(sum(np.where(t.used, (1.0 - t.w) * (t.own - t.whole), 0.0) for t in terms))


RULE = MixtureRule(
    name="gmd-s",
    order=3,
    title="geometric mean, sampled",
    promise="as conservative as alpha makes it",
    source="Sharma (61)-(65), (67)-(73)",
    fuse=gmd_s,
    takes=MEAN,
)
