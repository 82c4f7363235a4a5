"""Weights of covariance intersection in closed form. Any weights that sum to 1 keep its promise; these cost no search.

det: Franken and Huepper (2005), from how much information is lost without source i, and what it has alone:

    w_i ~ |S| - |S - A_i| + |A_i|,    A_i = P_i^-1,  S = sum A_i

trace: Niehsen (2002), w_i ~ 1 / trace P_i.
"""

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.linalg import total
from fusion_service.rules.base.block import Sources
from fusion_service.rules.base.matrices import all_but_one, weighted_sum

__all__ = ["closed_form"]


def closed_form(sources: Sources, criterion: str) -> Floats:
    """Weights (N, B) by criterion "det" or "trace"."""
    if sources.count == 1:
        return sources.uniform
    if criterion == "trace":
        share = 1.0 / linalg.trace(sources.covariances)
    else:
        A = sources.information
        whole = linalg.logdet(weighted_sum(A))
        without, alone = linalg.logdet(all_but_one(A)), -np.log(sources.dets)
        share = 1.0 - np.exp(without - whole) + np.exp(alone - whole)
    out: Floats = share / total(share)
    return out
