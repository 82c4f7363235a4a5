"""Ellipsoidal intersection (EI): Sijs and Lazar 2012.

    P^-1 = P_1^-1 + P_2^-1 - G^-1,    P^-1 x = P_1^-1 x_1 + P_2^-1 x_2 - G^-1 g

with the mutual covariance G and mean g: where P_1 = T T' and P_2 = T diag(r) T',

    G = T diag(max(r, 1)) T'
    g = (P_1^-1 + P_2^-1 - 2 G^-1 + 2 eta I)^-1 ((P_2^-1 - G^-1 + eta I) x_1 + (P_1^-1 - G^-1 + eta I) x_2)

so P = T diag(min(r, 1)) T', the largest ellipsoid within both. eta is the authors' regularisation for
directions where both are equally good (r = 1, 0/0 without it). Theirs is I in the coordinates of the state
and only there where needed; here it is taken along T and relative to the smaller variance, always, with
eta = 1e-6: the result is continuous, does not depend on units or on which source is first, and the source
that is better in a direction gets the weight 1 - eta / (q - 1 + 2 eta) there, q >= 1 the ratio of the
variances. Equal sources share.

Promise: none in general. For P_1 = diag(4, 1), P_2 = diag(1, 4) and one cross-correlation of .9 the true
error exceeds the reported covariance by 90 %.

It has no weights: they are NaN. More than two sources are fused pairwise, in the order of `chain`.
"""

from dataclasses import replace

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.rules.base.block import Result, Sources
from fusion_service.rules.base.chain import Pair, pairwise
from fusion_service.rules.base.matrices import spectral
from fusion_service.rules.base.rule import Rule
from fusion_service.rules.weights.pencil import pencil

__all__ = ["RULE", "ei"]

ETA = 1e-6


def ei(sources: Sources, weights: Floats | None, influence: bool) -> Result:
    """Ellipsoidal intersection."""
    result = pairwise(_pair, sources, None, influence)
    return replace(result, weights=np.full_like(result.weights, np.nan))


RULE = Rule(
    name="ei",
    order=8,
    title="ellipsoidal intersection, pairwise",
    promise="none in general",
    source="ellipsoidal intersection (Sijs and Lazar 2012); smallest det first",
    fuse=ei,
    n_way=False,
    takes_weights=False,
)


def _pair(two: Sources, weights: Floats | None, influence: bool) -> Pair:
    T, inverse, r, grown = pencil(two.covariances[:, :, 0], two.covariances[:, :, 1])
    better = np.minimum(r, 1.0)
    small = ETA / (np.maximum(r, 1.0 / r) - 1.0 + 2.0 * ETA)
    gain = linalg.product(T * np.where(r > 1.0, small, 1.0 - small), inverse)
    zero = np.zeros_like(grown)
    return Pair(
        two.means[:, 0] + linalg.matvec(gain, two.spread[:, 1]),
        spectral(T, better),
        np.full_like(two.dets, 0.5),
        gain,
        10.0 * two.condition * grown,
        zero,
    )
