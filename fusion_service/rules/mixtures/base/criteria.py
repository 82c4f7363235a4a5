"""The weights of means of mixtures by a criterion, and the options of the rules that have one.

* "chernoff": of the Gaussians with the sources' moments (Uney Algorithm 1 in closed form);
* "chernoff-mixture": of the mixtures themselves, by sampling;
* "det" and "trace": as a rule for Gaussians finds them from the moments.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

from fusion_service.arrays import Floats
from fusion_service.densities import Mixtures, chernoff_gaussians, chernoff_mixtures
from fusion_service.rules.base.options import Option, one_of
from fusion_service.rules.base.sampling import SAMPLING
from fusion_service.rules.face.gaussians import fuse_last
from fusion_service.rules.mixtures.base.source_moments import source_moments

__all__ = ["MEAN", "inflated", "weights_by"]

MEAN: Mapping[str, Option] = MappingProxyType(
    {"criterion": Option("chernoff", one_of("chernoff", "chernoff-mixture", "det", "trace")), **SAMPLING}
)
"""The options of a mean of densities."""


def inflated(sources: Sequence[Mixtures], alpha: float) -> list[Mixtures]:
    """The sources with every covariance multiplied by alpha, as in the Gaussian `hmd-s`."""
    return [Mixtures(f.log_weights, f.means, f.covariances * alpha) for f in sources]


def weights_by(criterion: str, gaussian: str, sources: Sequence[Mixtures], samples: int, seed: int) -> Floats:
    """Weights (N, B) of N batches of B mixtures; `gaussian`: the rule that finds them by det or trace."""
    if criterion == "chernoff-mixture":
        return chernoff_mixtures(sources, samples, seed)
    if criterion == "chernoff":
        return chernoff_gaussians(*source_moments(sources))
    return fuse_last(gaussian, *source_moments(sources), criterion=criterion).weights
