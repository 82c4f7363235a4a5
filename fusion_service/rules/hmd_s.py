"""Harmonic mean density by importance sampling (HMD-S), any number of sources: Sharma section 5.

    p ~ 1 / sum w_i / p_i    (21)

Without given weights: those of `hmd-ga` by the criterion. See `sampling` for how, and what `alpha` does.
"""

from typing import Any

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.densities import log_sum
from fusion_service.rules.base.block import Result, Sources
from fusion_service.rules.base.options import CRITERION
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.base.sampling import SAMPLING, TOO_FAR, sampled
from fusion_service.rules.base.scales import SCALES, in_scales
from fusion_service.rules.hmd_ga import harmonic

__all__ = ["RULE", "hmd_s"]


def hmd_s(sources: Sources, weights: Floats | None, influence: bool, *, criterion: str, **sampling: Any) -> Result:
    """Harmonic mean density, sampled; `sampling`: samples, alpha and seed."""

    def best(wide: Sources) -> Floats:
        return harmonic(wide, None, False, criterion=criterion, constants=True).weights

    return sampled(_mean, best, sources, weights, influence, **sampling)


def _mean(w: Floats, log_p: Floats) -> Floats:
    return -log_sum(np.log(w[:, None]) - log_p)


RULE = Rule(
    name="hmd-s",
    order=10,
    title="harmonic mean density, sampled",
    promise="as conservative as alpha makes it",
    source="harmonic mean density, sampled: Sharma (21), (66)-(72)",
    fuse=in_scales(hmd_s),
    takes={"criterion": CRITERION, "scales": SCALES, **SAMPLING},
    refusal=TOO_FAR,
)
