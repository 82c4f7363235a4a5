"""Harmonic mean of mixtures, 1 / sum (w_i / f_i), part by part by sampling (see `parts`): Sharma (66)-(73)."""

from collections.abc import Iterator, Sequence

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.densities import Mixtures, log_sum
from fusion_service.rules.base.rule import MixtureRule
from fusion_service.rules.mixtures.base.criteria import MEAN, inflated, weights_by
from fusion_service.rules.mixtures.base.parts import Terms, sampled_parts

__all__ = ["RULE", "hmd_s"]


def hmd_s(
    sources: Sequence[Mixtures],
    weights: Floats | None,
    prune: float,
    *,
    criterion: str,
    samples: int,
    alpha: float,
    seed: int,
) -> tuple[Mixtures, Floats]:
    """Harmonic mean, sampled."""
    sources = inflated(sources, alpha)
    if weights is None:
        weights = weights_by(criterion, "hmd-ga", sources, samples, seed)
    return sampled_parts(_log_ratio, sources, weights, samples, seed), weights


def _log_ratio(terms: Iterator[Terms]) -> Floats:
    """prod a_i^(1-w_i) / f_i over sum (w_i / f_i)."""
    out, inverse = np.zeros(()), []
    for t in terms:
        out = out + np.where(t.used, (1.0 - t.w) * t.own - t.whole, 0.0)
        inverse.append(np.where(t.used, np.log(t.w) - t.whole, -np.inf))
    return np.asarray(out - log_sum(np.stack(inverse)))


RULE = MixtureRule(
    name="hmd-s",
    order=4,
    title="harmonic mean, sampled",
    promise="as conservative as alpha makes it",
    source="Sharma (66)-(73)",
    fuse=hmd_s,
    takes=MEAN,
)
