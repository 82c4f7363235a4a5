"""Covariance intersection with weights in closed form: fast CI, and FFCC, whose weights sum to less than 1.

Any weights that sum to 1 keep CI's promise; these cost no search.

det: Franken and Huepper (2005), from how much information is lost without source i, and what it has alone:

    w_i ~ |S| - |S - A_i| + |A_i|,    A_i = P_i^-1,  S = sum A_i

trace: Niehsen (2002), w_i ~ 1 / trace P_i.

FFCC (fast and fault-tolerant convex combination: Wang and Li 2009; Li-AA after (18)) scales the weights to
sum to delta <= 1, so that P = P_CI / delta: conservative also where every source understates its covariance
by up to that factor. The mean is that of CI.
"""

import numpy as np

from fusion_service import linalg
from fusion_service.linalg import FloatArray, total
from fusion_service.rules.harmonic import all_but_one
from fusion_service.rules.intersection import ci
from fusion_service.rules.sources import Result, Sources, weighted_sum


def fast_ci(sources: Sources, weights: FloatArray | None, influence: bool, *, criterion: str) -> Result:
    """CI at weights in closed form."""
    return ci(sources, _weights(sources, criterion) if weights is None else weights, influence, criterion=criterion)


def ffcc(sources: Sources, weights: FloatArray | None, influence: bool, *, criterion: str, delta: float) -> Result:
    """CI at weights that sum to `delta`: those of `fast_ci`, or the given ones, times delta."""
    w = _weights(sources, criterion) if weights is None else weights
    return ci(sources, delta * w, influence, criterion=criterion)


def _weights(sources: Sources, criterion: str) -> FloatArray:
    """(N, B)."""
    if sources.count == 1:
        return sources.uniform
    if criterion == "trace":
        share = 1.0 / linalg.trace(sources.covariances)
    else:
        A = sources.information
        whole = linalg.logdet(weighted_sum(A))
        without, alone = linalg.logdet(all_but_one(A)), -np.log(sources.dets)
        share = 1.0 - np.exp(without - whole) + np.exp(alone - whole)
    out: FloatArray = share / total(share)
    return out
