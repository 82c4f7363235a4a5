"""Rules for two sources, applied to more: fused one after another, in an order of their own.

The order is canonical: by the determinant of the covariance, smallest first; equal ones by the mean, then by
the covariance, component by component. So the order of arrival does not matter.

With t_k the weight that what is fused so far gets in step k, and 1 - t_k that of the next source, the
sources' weights are w_i = (1 - t_i) t_{i+1} ... t_N, which sum to 1; given weights are read the same way.
Influence: the gains multiply likewise.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats, Ints
from fusion_service.linalg import condition
from fusion_service.rules.base.block import Result, Sources, alone

__all__ = ["Pair", "pairwise"]


@dataclass(frozen=True, slots=True)
class Pair:
    """Two sources, fused."""

    mean: Floats  # (n, B)
    covariance: Floats  # (n, n, B)
    weights: Floats  # (2, B)
    gain: Floats | None  # (n, n, B), of the second source, if asked for
    condition: Floats  # (B,)
    gap: Floats  # (B,)


Step = Callable[[Sources, Floats | None, bool], Pair]


def canonical(sources: Sources) -> Ints:
    """For each element the sources in canonical order (N, B)."""
    n = len(sources.means)
    entries = [sources.covariances[i, j] for i in range(n) for j in range(i + 1)]
    keys = [sources.dets, *sources.means, *entries]
    return np.asarray(np.lexsort(keys[::-1], axis=0))


def in_order(sources: Sources, order: Ints) -> Sources:
    """The sources of each element, rearranged."""
    means = np.take_along_axis(sources.means, order[None], axis=1)
    P, A = (np.take_along_axis(a, order[None, None], axis=2) for a in (sources.covariances, sources.information))
    dets = np.take_along_axis(sources.dets, order, axis=0)
    return Sources(means, P, A, dets, sources.condition, sources.definite)


def pairwise(step: Step, sources: Sources, weights: Floats | None, influence: bool) -> Result:
    """Any number of sources by a rule for two."""
    N, n = sources.count, len(sources.means)
    if N == 1:
        return alone(sources, influence)
    if N == 2:
        pair = step(sources, weights, influence)
        share = None if pair.gain is None else linalg.trace(pair.gain) / n
        shares = None if share is None else np.stack([1.0 - share, share])
        return Result(pair.mean, pair.covariance, pair.weights, shares, pair.condition, pair.gap)
    order = canonical(sources)
    there = in_order(sources, order)
    given = None if weights is None else np.take_along_axis(weights, order, axis=0)
    w, gap, worst = np.ones_like(there.dets), np.zeros_like(there.condition), there.condition
    gains = np.zeros_like(there.covariances)
    gains[range(n), range(n), 0] = 1.0
    mean, P = there.means[:, 0], there.covariances[:, :, 0]
    for k in range(1, N):
        two = _two(mean, P, there, k)
        t = None
        if given is not None:
            so_far = sum(given[1:k], start=given[0])
            both = so_far + given[k]
            t = np.where(both > 0.0, so_far / both, 0.5)
            t = np.stack([t, 1.0 - t])
        pair = step(two, t, influence)
        mean, P = pair.mean, pair.covariance
        worst, gap = np.maximum(worst, pair.condition), np.maximum(gap, pair.gap)
        w[:k] *= pair.weights[0]
        w[k] = pair.weights[1]
        if pair.gain is not None:
            gains[:, :, :k] -= linalg.product(pair.gain[:, :, None], gains[:, :, :k])
            gains[:, :, k] = pair.gain
    out = np.empty_like(w)
    np.put_along_axis(out, order, w, axis=0)
    shares = None
    if influence:
        shares = np.empty_like(w)
        np.put_along_axis(shares, order, linalg.trace(gains) / n, axis=0)
    return Result(mean, P, out, shares, worst, gap)


def _two(mean: Floats, P: Floats, sources: Sources, k: int) -> Sources:
    A, det, _ = linalg.sweep(P)
    return Sources(
        np.stack([mean, sources.means[:, k]], axis=1),
        np.stack([P, sources.covariances[:, :, k]], axis=2),
        np.stack([A, sources.information[:, :, k]], axis=2),
        np.stack([det, sources.dets[k]]),
        np.maximum(sources.condition, condition(P, A)),
        sources.definite,
    )
