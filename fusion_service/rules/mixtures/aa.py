"""Arithmetic average of mixtures: sum w_i f_i, the union of all components (Li-AA (6)).

Weights uniform, or by a criterion of the Gaussian rule `aa` on the sources' moments.
"""

from collections.abc import Sequence

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.densities import Mixtures
from fusion_service.rules.aa import RULE as GAUSSIAN
from fusion_service.rules.base.rule import MixtureRule
from fusion_service.rules.face.gaussians import fuse_last
from fusion_service.rules.mixtures.base.source_moments import source_moments

__all__ = ["RULE", "aa"]


def aa(sources: Sequence[Mixtures], weights: Floats | None, prune: float, *, criterion: str) -> tuple[Mixtures, Floats]:
    """Arithmetic average."""
    if weights is None:
        weights = fuse_last("aa", *source_moments(sources), criterion=criterion).weights
    union = Mixtures(
        np.concatenate([f.log_weights + np.log(w) for f, w in zip(sources, weights, strict=True)]),
        np.concatenate([f.means for f in sources], axis=1),
        np.concatenate([f.covariances for f in sources], axis=2),
    )
    return union, weights


RULE = MixtureRule(
    name="aa",
    order=1,
    title="arithmetic average, the union of all components",
    promise="keeps every mode; fault tolerant",
    source="Li-AA (6)",
    fuse=aa,
    takes={"criterion": GAUSSIAN.takes["criterion"]},
    multiplies=False,
)
