"""Fewer components: pruning, merging (Salmond 1990, Runnalls 2007) and truncating, for many mixtures at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Floats, Ints
from fusion_service.compiled import either
from fusion_service.densities.mixture import DensityError, Mixture, Mixtures, log_sum
from fusion_service.linalg import total

__all__ = ["reduce_mixture", "reduce_mixtures"]

METHODS = ("runnalls", "salmond", "truncate")


def merged(a: tuple[Floats, Floats, Floats], b: tuple[Floats, Floats, Floats]) -> tuple[Floats, Floats, Floats]:
    """Weight, mean and covariance of two weighted Gaussians, batch-last, merged with their moments kept."""
    weight = a[0] + b[0]
    share = b[0] / weight
    d = b[1] - a[1]
    spread = (share * (1.0 - share)) * linalg.outer(d, d)
    return weight, a[1] + share * d, a[2] + share * (b[2] - a[2]) + spread


def reduce_mixture(
    mixture: Mixture, *, max_components: int | None = None, prune: float = 0.0, method: str = "runnalls"
) -> Mixture:
    """A mixture of the same mass with fewer components.

    Components with a share of the mass below `prune` go (never the heaviest); then components are merged in pairs,
    mean and covariance kept, until `max_components` are left. The next pair is that with the least

    * "runnalls": bound of the divergence of the merged from the unmerged density, for components a, b merged to ab
      ((w_a + w_b) log det P_ab - w_a log det P_a - w_b log det P_b) / 2;
    * "salmond": w_a w_b / (w_a + w_b) (m_a - m_b)' P^-1 (m_a - m_b), P the covariance of the whole mixture.

    "truncate" merges nothing and keeps the heaviest. Components come heaviest first. Raises DensityError.
    """
    return reduce_mixtures(Mixtures.of([mixture]), max_components=max_components, prune=prune, method=method)[0]


def reduce_mixtures(
    mixtures: Mixtures, *, max_components: int | None = None, prune: float = 0.0, method: str = "runnalls"
) -> Mixtures:
    """`reduce_mixture` of many at once. Raises DensityError for a method or limits that are none."""
    if method not in METHODS:
        raise DensityError(f"method {method!r}: one of {', '.join(METHODS)}")
    if max_components is not None and max_components < 1:
        raise DensityError(f"max_components {max_components}: at least 1")
    if not 0.0 <= prune < 1.0:
        raise DensityError(f"prune {prune}: a share of the mass from 0 to below 1")
    log_mass = mixtures.log_mass
    order = np.argsort(-mixtures.log_weights, axis=0, kind="stable")
    logs = np.take_along_axis(mixtures.log_weights, order, axis=0)
    with np.errstate(invalid="ignore"):
        kept = (logs - log_mass > np.log(prune)) if prune else logs > -np.inf
    kept[0] = True
    count = kept.sum(axis=0)
    most = len(order) if method != "truncate" or max_components is None else max_components
    width = min(int(count.max(initial=1)), most)
    order = order[:width]
    logs = np.where(kept, logs, -np.inf)[:width]
    x = np.take_along_axis(mixtures.means, order[None], axis=1)
    P = np.take_along_axis(mixtures.covariances, order[None, None], axis=2)
    with np.errstate(all="ignore"):
        w = np.exp(logs - log_sum(logs))
        if max_components is not None and width > max_components:
            step = max(1, min((1 << 18) // (width * len(x) ** 2), (1 << 20) // width**2))
            for i in range(0, len(mixtures), step):
                at = slice(i, i + step)
                _merge(w[:, at], x[..., at], P[..., at], np.minimum(count[at], width), max_components, method)
            order = np.argsort(-w, axis=0, kind="stable")[:max_components]
            w = np.take_along_axis(w, order, axis=0)
            x = np.take_along_axis(x, order[None], axis=1)
            P = np.take_along_axis(P, order[None, None], axis=2)
        return Mixtures(np.log(w) + log_mass, x, P)


@either
def merged_logdet(P: Floats, x: Floats, w: Floats, i: Any, at: Ints, first: int) -> Floats:
    """log det (C - first, T) of the covariances that come of merging component i, or i (T,), of the elements `at` (T,)
    with each component from `first` on: of weights w (C, B), means x (n, C, B) and covariances P (n, n, C, B)."""
    where: Any = slice(None) if len(at) == w.shape[1] else at
    share = w[first:, where] / (w[i, at] + w[first:, where])
    rest = 1.0 - share
    both = share * rest
    d = x[:, first:, where] - x[:, i, at][:, None]
    S, mine = P[:, :, first:, where], P[:, :, i, at]
    M = np.empty_like(S)
    for k in range(len(M)):
        M[k, : k + 1] = share * S[k, : k + 1] + rest * mine[k, : k + 1, None] + both * d[k] * d[: k + 1]
    return linalg.logdet(M)


@either
def settled(new: Floats, i: Ints, j: Ints, at: Ints, cost: Floats, low: Floats, partner: Ints) -> bool:
    """Write the costs `new` (C, T) of the components i of the elements `at` (T,), into which the components j were
    merged, into `cost` (B, C, C), and which `partner` (B, C) is now the cheapest for each component, and its cost
    `low` (B, C)."""
    new[i, np.arange(len(at))] = np.inf
    cost[at, i, :] = new.T
    cost[at, :, i] = new.T
    partner[at, i], low[at, i] = new.argmin(axis=0), new.min(axis=0)
    mine, best = partner[at], low[at]
    costs = new.T
    nearer = costs < best
    partner[at], low[at] = np.where(nearer, i[:, None], mine), np.where(nearer, costs, best)
    one, other = i[:, None], j[:, None]
    again = ((mine == one) | (mine == other)) & (best < np.inf) & (np.arange(len(new)) != one)
    e, stale = np.nonzero(again)
    rows = cost[at[e], stale]
    partner[at[e], stale], low[at[e], stale] = rows.argmin(axis=1), rows.min(axis=1)
    return True


@dataclass(frozen=True, slots=True)
class _Parts:
    """Components of B mixtures that are merged in place; what is merged away keeps weight 0."""

    weights: Floats  # (C, B)
    means: Floats  # (n, C, B)
    covariances: Floats  # (n, n, C, B)
    logdet: Floats  # (C, B)
    whole: Floats | None  # (n, n, B), the inverse covariances of the mixtures, for Salmond's cost

    def costs(self, i: Any, at: Ints, first: int) -> Floats:
        """Of merging component i of the elements `at` (T,) with those from `first` on (C - first, T)."""
        where: Any = slice(None) if len(at) == self.weights.shape[1] else at
        w, other = self.weights[i, at], self.weights[first:, where]
        if self.whole is not None:
            d = self.means[:, first:, where] - self.means[:, i, at][:, None]
            out = w * other / (w + other) * total(d * linalg.matvec(self.whole[:, :, None, where], d))
        else:
            new = merged_logdet(self.covariances, self.means, self.weights, i, at, first)
            out = 0.5 * ((w + other) * new - w * self.logdet[i, at] - other * self.logdet[first:, where])
        return np.where((w > 0.0) & (other > 0.0), out, np.inf)

    def join(self, i: Ints, j: Ints, at: Ints) -> None:
        """Merge component j of each of the elements `at` into component i."""
        w, x, P = self.weights, self.means, self.covariances
        w[i, at], x[:, i, at], P[:, :, i, at] = merged(
            (w[i, at], x[:, i, at], P[:, :, i, at]), (w[j, at], x[:, j, at], P[:, :, j, at])
        )
        w[j, at] = 0.0
        self.logdet[i, at] = linalg.logdet(P[:, :, i, at])


def _merge(weights: Floats, means: Floats, P: Floats, count: Ints, most: int, method: str) -> None:
    """Merge in place down to `most` components; what is merged away keeps weight 0.

    For every component its cheapest partner is kept, and looked for again only where it was merged.
    """
    C, B = weights.shape
    todo = np.flatnonzero(count > most)
    left = count[todo]
    whole = linalg.inverse(Mixtures(np.log(weights), means, P).moments()[1]) if method == "salmond" else None
    parts = _Parts(weights, means, P, linalg.logdet(P), whole)
    cost = np.full((B, C, C), np.inf)
    for i in range(C - 1):
        cost[:, i, i + 1 :] = cost[:, i + 1 :, i] = parts.costs(i, np.arange(B), i + 1).T
    partner, low = cost.argmin(axis=2), cost.min(axis=2)
    while len(todo):
        i = low[todo].argmin(axis=1)
        j = partner[todo, i]
        i, j = np.minimum(i, j), np.maximum(i, j)
        parts.join(i, j, todo)
        cost[todo, j] = cost[todo, :, j] = np.inf
        low[todo, j] = np.inf
        left -= 1
        go = left > most
        todo, left, i, j = todo[go], left[go], i[go], j[go]
        if len(todo):
            settled(parts.costs(i, todo, 0), i, j, todo, cost, low, partner)
