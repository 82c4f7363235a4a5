"""Fast and fault-tolerant convex combination (FFCC): Wang and Li 2009; Li-AA after (18).

The weights are those in closed form (see `closed_form`), scaled to sum to delta <= 1, so that P = P_CI / delta:
conservative also where every source understates its covariance by up to that factor. The mean is that of CI.
"""

from fusion_service.arrays import Floats
from fusion_service.rules.base.block import Result, Sources
from fusion_service.rules.base.options import CRITERION, Option, in_range
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.base.scales import SCALES, in_scales
from fusion_service.rules.ci import ci
from fusion_service.rules.weights.closed_form import closed_form

__all__ = ["RULE", "ffcc"]


def ffcc(sources: Sources, weights: Floats | None, influence: bool, *, criterion: str, delta: float) -> Result:
    """CI at weights that sum to `delta`: those in closed form, or the given ones, times delta."""
    w = closed_form(sources, criterion) if weights is None else weights
    return ci(sources, delta * w, influence, criterion=criterion)


RULE = Rule(
    name="ffcc",
    order=5,
    title="CI with weights in closed form that sum to `delta` <= 1",
    promise="conservative for every correlation, also of sources that understate their covariance by delta",
    source="CI, weights in closed form that sum to delta (Wang and Li 2009; Li-AA after (18))",
    fuse=in_scales(ffcc),
    information=True,
    takes={
        "criterion": CRITERION,
        "scales": SCALES,
        "delta": Option(0.9, in_range(lambda delta: 0.0 < delta <= 1.0, "a number above 0 and at most 1")),
    },
)
