"""Geometric mean density by importance sampling (GMD-S), any number of sources: Sharma section 5.

    p ~ prod p_i^w_i    (61)

Without given weights: those of `ci` by the criterion. See `sampling` for how, and what `alpha` does.
"""

from typing import Any

from fusion_service.arrays import Floats
from fusion_service.linalg import total
from fusion_service.rules.base.block import Result, Sources
from fusion_service.rules.base.options import CRITERION
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.base.sampling import SAMPLING, TOO_FAR, sampled
from fusion_service.rules.base.scales import SCALES, in_scales
from fusion_service.rules.ci import ci

__all__ = ["RULE", "gmd_s"]


def gmd_s(sources: Sources, weights: Floats | None, influence: bool, *, criterion: str, **sampling: Any) -> Result:
    """Geometric mean density, sampled; `sampling`: samples, alpha and seed."""

    def best(wide: Sources) -> Floats:
        return ci(wide, None, False, criterion=criterion).weights

    return sampled(_mean, best, sources, weights, influence, **sampling)


def _mean(w: Floats, log_p: Floats) -> Floats:
    return total(w[:, None] * log_p)


RULE = Rule(
    name="gmd-s",
    order=11,
    title="geometric mean density, sampled",
    promise="as conservative as alpha makes it",
    source="geometric mean density, sampled: Sharma (61)-(65)",
    fuse=in_scales(gmd_s),
    takes={"criterion": CRITERION, "scales": SCALES, **SAMPLING},
    refusal=TOO_FAR,
)
