"""Means of mixtures part by part, by importance sampling: Sharma (61), (69)-(73).

The geometric mean prod f_i^w_i and the harmonic mean 1 / sum (w_i / f_i) are split into

    prod_i alpha_ic N_ic / D(x),    D = prod f_i^(1-w_i)   or   D = prod f_i sum (w_i / f_i),

one part for each choice of a component c from every source, each part a Gaussian with the part's moments and its
weight alpha beta zeta / sum. (70) and (73) as printed leave zeta out of the weights.

The samples of a part come from its component of the first-order geometric mean, q = prod a_i^w_i with
a_i = alpha_ic N_ic <= f_i, which bounds the part from above. Geometric: part / q = prod (a_i / f_i)^(1-w_i) <= 1.
Harmonic: prod (a_i / f_i) is at most the least a_i / f_i, so the part is at most the harmonic mean of the a_i, and that
is at most their geometric mean q. So no sample weighs more than 1, and nothing has to be chosen between sources;
Sharma's choice (74) is biased and not used. All parts share their normal draws: a result depends on its sources,
`samples` and `seed` only.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.densities import Mixtures, draws, log_gaussian, log_sum, power_product, sampled_moments

__all__ = ["LogRatio", "Terms", "sampled_parts"]

NEGLIGIBLE = np.log(1e-7)
"""Parts bounded by this share of the largest bound are not sampled."""
FEW = 50
"""Effective samples that a part needs."""
LIGHT = 0.01
"""Share of the mass below which a part with fewer takes the moments of its component of the geometric mean."""
AT_ONCE = 1 << 19
"""Numbers in one block of parts."""


class Terms(NamedTuple):
    """What one source says at S points of each of K parts."""

    w: Floats
    """(K,), its weight"""
    used: Bools
    """(K,), whether that is above 0"""
    components: Floats
    """(C, S, K), the logs of its components"""
    own: Floats
    """(S, K), the log of the part's component, log a_i"""
    whole: Floats
    """(S, K), the log of all of it, log f_i"""


LogRatio = Callable[[Iterator[Terms]], Floats]
"""log of part / q (S, K), from the terms of each source in turn."""


def sampled_parts(log_ratio: LogRatio, sources: Sequence[Mixtures], w: Floats, samples: int, seed: int) -> Mixtures:
    """The mean of sources at weights w (N, B), each part with its mass and moments; log mass NaN for what cannot be."""
    q = power_product(sources, w)
    z = draws(len(q.means), samples, seed)
    shape = [len(f.log_weights) for f in sources]
    part, element = np.nonzero(q.log_weights > q.log_weights.max(axis=0) + NEGLIGIBLE)
    logs = np.full_like(q.log_weights, -np.inf)
    few = np.zeros(logs.shape, dtype=np.bool_)
    means, covariances = q.means.copy(), q.covariances.copy()
    step = max(1, AT_ONCE // (z.shape[1] * sum(shape)))
    for i in range(0, len(part), step):
        p, b = part[i : i + step], element[i : i + step]
        ratio = partial(_ratio, log_ratio, [f.take(b) for f in sources], w[:, b], np.unravel_index(p, shape))
        mass, x, P, effective = sampled_moments(q.means[:, p, b], q.covariances[:, :, p, b], ratio, z)
        logs[p, b] = q.log_weights[p, b] + mass
        few[p, b] = ~(effective >= FEW)
        good = ~few[p, b]
        means[:, p[good], b[good]], covariances[:, :, p[good], b[good]] = x[:, good], P[..., good]
    heavy = (few & (logs > log_sum(logs) + np.log(LIGHT))).any(axis=0)
    logs[:, ~np.isfinite(q.log_weights.max(axis=0))] = np.nan
    logs[:, heavy] = np.nan
    return Mixtures(logs, means, covariances)


def _ratio(
    log_ratio: LogRatio, sources: Sequence[Mixtures], weights: Floats, choice: tuple[Ints, ...], x: Floats
) -> Floats:
    """log of part / q (S, K) of K parts, each with its sources, weights (N, K) and choice, at x (n, S, K)."""
    return log_ratio(_terms(sources, weights, choice, x))


def _terms(sources: Sequence[Mixtures], weights: Floats, choice: tuple[Ints, ...], x: Floats) -> Iterator[Terms]:
    k = np.arange(x.shape[-1])
    for f, w, c in zip(sources, weights, choice, strict=True):
        L, d = linalg.ldl(f.covariances)
        components = np.stack(
            [
                f.log_weights[j] + log_gaussian(x - f.means[:, None, j], L[:, :, None, j], d[:, None, j])
                for j in range(len(f.log_weights))
            ]
        )
        yield Terms(w, w > 0.0, components, components[c, :, k].T, log_sum(components))
