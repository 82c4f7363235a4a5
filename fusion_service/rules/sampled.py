"""Harmonic and geometric mean density by importance sampling (HMD-S, GMD-S): Sharma section 5.

    HMD: p ~ 1 / sum w_i / p_i  (21),        GMD: p ~ prod p_i^w_i  (61), for any number of sources at once

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

Without given weights: those of `hmd-ga` or `ci` by the criterion. Sources so far apart that fewer than `FEW`
effective samples are left are refused. There is no gain: the influence is NaN.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from fusion_service import linalg
from fusion_service.linalg import FloatArray, total
from fusion_service.rules.chain import alone
from fusion_service.rules.harmonic import hmd_ga
from fusion_service.rules.intersection import ci
from fusion_service.rules.sources import Result, Sources
from fusion_service.rules.weights.pencil import lower_inverse

FEW = 100


def _sampled(
    kind: str,
    sources: Sources,
    weights: FloatArray | None,
    influence: bool,
    *,
    criterion: str,
    samples: int,
    alpha: float,
    seed: int,
) -> Result:
    n, N, size = sources.means.shape
    if N == 1:
        one = alone(sources, influence)
        return replace(one, covariance=one.covariance * alpha)
    dtype = sources.means.dtype
    wide = Sources(
        sources.means,
        sources.covariances * alpha,
        sources.information / alpha,
        sources.dets * alpha**n,
        sources.condition,
        sources.definite,
    )
    if weights is None:
        if kind == "harmonic":
            weights = hmd_ga(wide, None, False, criterion=criterion, constants=True).weights
        else:
            weights = ci(wide, None, False, criterion=criterion).weights
    z = np.random.default_rng(seed).standard_normal((n, samples)).astype(dtype)
    L, d = linalg.ldl(wide.covariances)
    F = L * np.sqrt(d)
    W = lower_inverse(F)
    mean, P, effective = np.empty((n, size), dtype), np.empty((n, n, size), dtype), np.empty(size, dtype)
    half_logdet = 0.5 * total(np.log(d))
    for b in range(size):
        x = np.concatenate([wide.spread[:, i, b, None] + linalg.matvec(F[:, :, i, b], z) for i in range(N)], axis=1)
        log_p = np.empty((N, x.shape[1]), dtype)
        for i in range(N):
            y = linalg.matvec(W[:, :, i, b], x - wide.spread[:, i, b, None])
            log_p[i] = -0.5 * total(y * y) - half_logdet[i, b]
        w = weights[:, b]
        used = np.flatnonzero(w)
        if kind == "harmonic":
            log_fused = -_log_sum(np.log(w[used, None]) - log_p[used])
        else:
            log_fused = total(w[used, None] * log_p[used])
        share = log_fused - _log_sum(log_p)
        share = np.exp(share - share.max())
        share /= share.sum()
        m = np.array([(share * row).sum() for row in x])
        r = x - m[:, None]
        for i in range(n):
            for j in range(i + 1):
                P[i, j, b] = P[j, i, b] = (share * r[i] * r[j]).sum()
        mean[:, b] = m + wide.means[:, 0, b]
        effective[b] = 1.0 / (share * share).sum()
    condition = np.where(effective >= FEW, sources.condition, np.inf)
    nan = np.full_like(weights, np.nan) if influence else None
    return Result(mean, P, weights, nan, condition, np.zeros_like(condition))


def _log_sum(a: FloatArray) -> FloatArray:
    """log sum exp over the first axis."""
    top = a.max(axis=0)
    out: FloatArray = top + np.log(total(np.exp(a - top)))
    return out


hmd_s = partial(_sampled, "harmonic")
gmd_s = partial(_sampled, "geometric")
