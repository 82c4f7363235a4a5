"""The best weights of two sources, on the fast road where there is one: `pairs`, else `line`."""

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.rules.weights import line, pairs
from fusion_service.rules.weights.pairs import Ends

__all__ = ["best_of_two"]


def best_of_two(
    criterion: str, M: Ends, inverses: Ends, dets: Ends, *, bump: Floats | None = None, rho: float | Floats = 1.0
) -> Floats:
    """Weights (t, 1 - t) (2, B); M and the rest as in `pairs.best_weight`."""
    if M[0].dtype == np.float64 and len(M[0]) <= pairs.LIMIT:
        t = pairs.best_weight(criterion, M, inverses, dets, bump=bump, rho=rho)
    else:
        t = line.best_weight(criterion, M, bump=bump, rho=rho)
    return np.stack([t, 1.0 - t])
