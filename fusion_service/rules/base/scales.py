"""The trace adds variances of different units: `scales` says which unit of each component to count in.

Option `scales` (n,): the rule works in the state divided by it, component by component. A component whose
scale is large counts little. det and KL do not depend on units.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.rules.base.block import Result, Sources
from fusion_service.rules.base.options import Case, Option, RuleError, array

__all__ = ["SCALES", "in_scales"]


def _check(name: str, value: Any, case: Case) -> Floats | None:
    if value is None:
        return None
    scales = array(name, value)
    if scales.shape != (case.n,) or not ((scales > 0.0) & np.isfinite(scales)).all():
        raise RuleError(f"{name} {value!r}: {case.n} positive numbers, one unit for each component, are needed")
    return scales


SCALES = Option(None, _check)


def in_scales(rule: Callable[..., Result]) -> Callable[..., Result]:
    """The rule with the option `scales`."""

    def scaled(
        sources: Sources, weights: Floats | None, influence: bool, *, scales: Floats | None, **options: Any
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
