"""Fast covariance intersection: CI at weights in closed form (see `closed_form`)."""

from fusion_service.arrays import Floats
from fusion_service.rules.base.block import Result, Sources
from fusion_service.rules.base.options import CRITERION
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.base.scales import SCALES, in_scales
from fusion_service.rules.ci import ci
from fusion_service.rules.weights.closed_form import closed_form

__all__ = ["RULE", "fast_ci"]


def fast_ci(sources: Sources, weights: Floats | None, influence: bool, *, criterion: str) -> Result:
    """CI at weights in closed form."""
    return ci(sources, closed_form(sources, criterion) if weights is None else weights, influence, criterion=criterion)


RULE = Rule(
    name="fast-ci",
    order=4,
    title="CI with weights in closed form",
    promise="conservative for every correlation",
    source="CI, weights in closed form: Franken and Huepper 2005 (det), Niehsen 2002 (trace)",
    fuse=in_scales(fast_ci),
    information=True,
    takes={"criterion": CRITERION, "scales": SCALES},
)
