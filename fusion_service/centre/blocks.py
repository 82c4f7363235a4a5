"""Fusion of sources that do not all know the same components, by any rule.

A rule is never shown a component that none of its sources has. Of the others

* a rule in information form (`Rule.information`) takes padded sources as they are (see `partial`): padding is an
  information of nothing, and what remains is the rule's own formula on what there is;
* any other fuses the block of components that all have, C, by its own formula; then, for each set T of sources that
  alone know some more of them, R, the fusion of T by the same rule says how R goes with what is already placed, and
  that is kept:

      p(C) = rule(all),    p(C, R) = p(C) p_T(R | C),    p_T = rule(T)

  With x_R = x'_R + B (x_C - x'_C), B = P'_RC P'_CC^-1 of p_T:  P_RR = P'_RR - B P'_CR + B P_CC B', P_RC = B P_CC.
  Sets come largest first, and R is placed beside all components that are placed and that every source of T knows; of
  the rest it is independent given these. What the sources of T say of C through R is left where it is: in C all sources
have their say once. (Where one source alone tells R, this of the naive rule is the product of the densities.)

The influence of a source is its share in each block it is in, by the size of the block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeAlias

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints, all_of
from fusion_service.centre.partial import Unknown

__all__ = ["Fusing", "fuse_known"]

Fusing: TypeAlias = Callable[[Floats, Floats, Floats | None, Ints, Ints], tuple[Floats, Floats, Floats]]
"""means (N, m, B), covariances (N, m, m, B), weights (N, B) or None, which components (m,) of the space these are, and
which elements (B,) of the batch -> mean (m, B), covariance (m, m, B), influences (N, B)."""


def fuse_known(
    means: Floats, covariances: Floats, weights: Floats | None, unknown: Unknown, information: bool, rule: Fusing
) -> tuple[Floats, Floats, Floats]:
    """Fuse N sources, means (N, n, B) and covariances (N, n, n, B) in the space of `unknown`, by `rule`, which is in
    information form or not: mean (n, B), covariance (n, n, B), padded where no source knows, influences (N, B)."""
    N, n, count = means.shape
    known = unknown.known(covariances.transpose(1, 2, 0, 3))
    if all_of(known):
        return rule(means, covariances, weights, np.arange(n), np.arange(count))
    one, spread, gains = np.zeros((n, count)), np.zeros((n, n, count)), np.zeros((N, count))
    spread[range(n), range(n)] = unknown.pad[:, None]
    for kind, at in _kinds(known, information):
        share = None if weights is None else weights[:, at]
        x, P = means[:, :, at], covariances[:, :, :, at]
        there = np.flatnonzero(kind.any(axis=1))
        blocks = [(there, np.arange(N))] if information or N == 1 else list(_blocks(kind))
        mean, covariance, gain = _chained(x, P, share, blocks, kind, at, rule)
        one[np.ix_(there, at)] = mean[there]
        spread[np.ix_(there, there, at)] = covariance[np.ix_(there, there)]
        gains[:, at] = gain / len(there)
    return one, spread, gains


def _kinds(known: Bools, information: bool) -> Iterator[tuple[Bools, Ints]]:
    """The elements (some of B,) of `known` (n, N, B) by what their sources know (n, N); for a rule in information form
    by what any of them does (n, 1)."""
    n, _, count = known.shape
    seen = known.any(axis=1, keepdims=True) if information else known
    kinds, which = np.unique(seen.reshape(-1, count), axis=1, return_inverse=True)
    for number, kind in enumerate(kinds.T):
        yield kind.reshape(n, -1), np.flatnonzero(which.reshape(-1) == number)


def _blocks(kind: Bools) -> Iterator[tuple[Ints, Ints]]:
    """The components that the same sources know, with these sources, most sources first: all come first."""
    knowing, which = np.unique(kind[kind.any(axis=1)], axis=0, return_inverse=True)
    there = np.flatnonzero(kind.any(axis=1))
    for number in np.lexsort((np.arange(len(knowing)), -knowing.sum(axis=1))).tolist():
        yield there[which.reshape(-1) == number], np.flatnonzero(knowing[number])


def _chained(
    x: Floats, P: Floats, weights: Floats | None, blocks: list[tuple[Ints, Ints]], kind: Bools, at: Ints, rule: Fusing
) -> tuple[Floats, Floats, Floats]:
    """Mean (n, B) and covariance (n, n, B) of the blocks, one placed after the other, and the sum (N, B) of influences
    by the size of each."""
    N, n, count = x.shape
    mean, spread, gains = np.zeros((n, count)), np.zeros((n, n, count)), np.zeros((N, count))
    placed = np.zeros(0, dtype=np.intp)
    for block, sources in blocks:
        beside = placed[kind[np.ix_(placed, sources)].all(axis=1)] if len(placed) else placed
        here = np.concatenate([beside, block])
        share = None if weights is None else _renewed(weights[sources])
        some = np.ix_(sources, here, here)
        own, P_own, gain = rule(x[np.ix_(sources, here)], P[some], share, here, at)
        gains[sources] += gain * len(block)
        k = len(beside)
        if not k:
            mean[block], spread[np.ix_(block, block)] = own, P_own
        else:
            turn = linalg.product(P_own[k:, :k], linalg.inverse(P_own[:k, :k]))
            mean[block] = own[k:] + linalg.matvec(turn, mean[beside] - own[:k])
            cross = linalg.product(turn, spread[np.ix_(beside, placed)])
            spread[np.ix_(block, placed)] = cross
            spread[np.ix_(placed, block)] = cross.swapaxes(0, 1)
            rest = P_own[k:, k:] - linalg.product(turn, P_own[:k, k:])
            spread[np.ix_(block, block)] = linalg.symmetrise(
                rest + linalg.congruence(turn, spread[np.ix_(beside, beside)])
            )
        placed = np.concatenate([placed, block])
    return mean, spread, gains


def _renewed(weights: Floats) -> Floats:
    """Weights (k, B) with sum 1, equal ones where all are 0."""
    total = linalg.total(weights)
    return np.where(total > 0, weights / np.where(total > 0, total, 1.0), 1.0 / len(weights))
