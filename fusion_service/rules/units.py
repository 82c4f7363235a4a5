"""The trace adds variances of different units: `scales` says which unit of each component to count in.

Option `scales` (n,): the rule works in the state divided by it, component by component. A component whose
scale is large counts little. det and KL do not depend on units.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from fusion_service.linalg import FloatArray
from fusion_service.rules.sources import Result, Sources


def in_units(rule: Callable[..., Result]) -> Callable[..., Result]:
    """The rule with the option `scales`."""

    def scaled(
        sources: Sources, weights: FloatArray | None, influence: bool, *, scales: FloatArray | None, **options: Any
    ) -> Result:
        if scales is None:
            return rule(sources, weights, influence, **options)
        unit = scales[:, None]
        square = unit[:, None] * unit[None]
        there = replace(
            sources,
            means=sources.means / unit[..., None],
            covariances=sources.covariances / square[..., None],
            information=sources.information * square[..., None],
            dets=sources.dets / np.prod(scales * scales),
        )
        result = rule(there, weights, influence, **options)
        return replace(result, mean=result.mean * unit, covariance=result.covariance * square)

    return scaled
