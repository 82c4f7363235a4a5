"""The mean of densities by importance sampling (HMD-S, GMD-S): Sharma section 5.

Samples come from the mixture q = sum p_i / N and carry the weight p / q. Both means lie below the arithmetic
one, so for equal w no sample weighs more than the average of the sources' mixture allows: nothing needs a
proposal of its own. The result is the mean and covariance of the weighted samples, self-normalised
(Sharma (63), (65), (71), (72) omit factors that cancel). Sharma's (74), choosing each sample from one density
or the other by its weight, is biased, and is not used.

`alpha` >= 1 multiplies every source's covariance before fusing (section 5.2's inflation): GMD-S then gives
alpha times CI's covariance, up to the sampling error.

The same standard normal draws serve every source and every fusion of a batch: a result depends on its own
numbers, `samples` (per source) and `seed` alone, not on the batch or on the order of sources. So errors of
different fusions are not independent: change the seed for that.

Sources so far apart that fewer than `FEW` effective samples are left are refused. There is no gain: the influence
is NaN.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats
from fusion_service.densities import log_sum
from fusion_service.linalg import total
from fusion_service.rules.base.block import Result, Sources, alone
from fusion_service.rules.base.matrices import lower_inverse
from fusion_service.rules.base.options import Option, in_range, whole

__all__ = ["SAMPLING", "TOO_FAR", "sampled"]

FEW = 100
FEWEST = 200
"""Samples that a sampled rule works with at least."""
SAMPLING: Mapping[str, Option] = MappingProxyType(
    {
        "samples": Option(5000, whole(FEWEST)),
        "alpha": Option(1.0, in_range(lambda alpha: 1.0 <= alpha < np.inf, "a number of at least 1")),
        "seed": Option(0, whole(0)),
    }
)
"""The options of every sampled rule."""
TOO_FAR = "is too ill-conditioned to fuse, or its sources are too far apart for this many samples"

Mean = Callable[[Floats, Floats], Floats]
"""Weights (K,), all above 0, and log densities (K, S) of the sources at S points: log of the fused density (S,)."""


def sampled(
    mean_of: Mean,
    best: Callable[[Sources], Floats],
    sources: Sources,
    weights: Floats | None,
    influence: bool,
    *,
    samples: int,
    alpha: float,
    seed: int,
) -> Result:
    """The moments of the density `mean_of` the sources' densities; weights None: those `best` gives (N, B)."""
    n, N, size = sources.means.shape
    if N == 1:
        one = alone(sources, influence)
        return replace(one, covariance=one.covariance * alpha)
    dtype = sources.means.dtype
    wide = replace(
        sources,
        covariances=sources.covariances * alpha,
        information=sources.information / alpha,
        dets=sources.dets * alpha**n,
    )
    if weights is None:
        weights = best(wide)
    z = np.random.default_rng(seed).standard_normal((n, samples)).astype(dtype)
    L, d = linalg.ldl(wide.covariances)
    F = L * np.sqrt(d)
    W = lower_inverse(F)
    half_logdet = 0.5 * total(np.log(d))
    mean, P, effective = np.empty((n, size), dtype), np.empty((n, n, size), dtype), np.empty(size, dtype)
    for b in range(size):
        x = np.concatenate([wide.spread[:, i, b, None] + linalg.matvec(F[:, :, i, b], z) for i in range(N)], axis=1)
        log_p = np.empty((N, x.shape[1]), dtype)
        for i in range(N):
            y = linalg.matvec(W[:, :, i, b], x - wide.spread[:, i, b, None])
            log_p[i] = -0.5 * total(y * y) - half_logdet[i, b]
        w = weights[:, b]
        used = np.flatnonzero(w)
        m, P[..., b], effective[b] = _weighted_moments(x, mean_of(w[used], log_p[used]) - log_sum(log_p))
        mean[:, b] = m + wide.means[:, 0, b]
    condition = np.where(effective >= FEW, sources.condition, np.inf)
    nan = np.full_like(weights, np.nan) if influence else None
    return Result(mean, P, weights, nan, condition, np.zeros_like(condition))


def _weighted_moments(x: Floats, log_weights: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean (n,) and covariance (n, n) of samples x (n, S) by log weights (S,), and how many count."""
    share = np.exp(log_weights - log_weights.max())
    share /= share.sum()
    m = np.array([(share * row).sum() for row in x])
    r = x - m[:, None]
    P = np.empty((len(x), len(x)), x.dtype)
    for i in range(len(x)):
        for j in range(i + 1):
            P[i, j] = P[j, i] = (share * r[i] * r[j]).sum()
    return m, P, 1.0 / (share * share).sum()
