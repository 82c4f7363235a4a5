"""Whose covariances are wrong, from how far sources differ two by two (the three-cornered hat, with known shares).

Of sources i and j with errors of covariance a_i P_i and a_j P_j, independent of each other, a difference r of two of
their tracks of one target has

    E r' S^-1 r / k = a_i p + a_j q,   S = P_i + P_j,   p = tr(S^-1 P_i) / k,   q = tr(S^-1 P_j) / k = 1 - p.

Its scale s and p are known for each pair; the a are their weighted least squares, none below 0, with a weak prior at
1. All that can be known of them is known where the pairs of a group of sources hold a circle of odd length (three that
share targets do); else, as of two sources alone, what one is given too much the other has too little.

Errors with a part in common, as the process noise of one target gives them, make the differences smaller: a of honest
sources is then below 1, of .5 to .7 as a rule, and what is above 1 is no effect of that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.linalg import total

__all__ = ["Factors", "Pairs", "decidable", "solved"]

PRIOR = 3.0
"""One sigma of what a source adds to the differences, more or less than it says."""
LEAST = 0.05
MOST_JOINT = 64
"""Sources that are solved for at once; more are in turn, the others as they were found last."""
EFFICIENCY = 1.1
"""Variance of a robust scale, over that of a mean of squares."""


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """K pairs of sources first, second (K,), or one alone (first = second); scale, share, and count (K,) of
    independent differences of k components behind it."""

    first: Ints
    second: Ints
    scale: Floats
    share: Floats
    count: Floats
    k: int

    def take(self, some: Bools) -> Pairs:
        """Some of them."""
        return Pairs(self.first[some], self.second[some], self.scale[some], self.share[some], self.count[some], self.k)

    def join(self, other: Pairs) -> Pairs:
        """These, then others."""
        one = np.concatenate
        return Pairs(
            one([self.first, other.first]),
            one([self.second, other.second]),
            one([self.scale, other.scale]),
            one([self.share, other.share]),
            one([self.count, other.count]),
            self.k,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Factors:
    """Of S sources: value, a (S,); sigma (S,), of it if it were 1; freedom (S,), degrees of freedom that its
    distribution has then, about."""

    value: Floats
    sigma: Floats
    freedom: Floats


def decidable(pairs: Pairs, sources: int) -> Bools:
    """Of which sources (S,) the factor follows from the pairs."""
    return _decidable(pairs.first.astype(np.int64).tobytes(), pairs.second.astype(np.int64).tobytes(), sources)


@lru_cache(maxsize=32)
def _decidable(first: bytes, second: bytes, S: int) -> Bools:
    """The same by the pairs alone, which are mostly those of the last look."""
    i, j = np.frombuffer(first, np.int64), np.frombuffer(second, np.int64)
    cover = coo_array((np.ones(2 * len(i)), (np.concatenate([i, i + S]), np.concatenate([j + S, j]))), (2 * S, 2 * S))
    label = connected_components(cover, directed=False)[1]
    out = np.asarray(label[:S] == label[S:])
    out.flags.writeable = False
    return out


def solved(pairs: Pairs, last: Floats) -> Factors:
    """The factors; last (S,): what they were."""
    value, sigma, freedom = last.copy(), np.full(len(last), np.inf), np.zeros(len(last))
    known = np.unique(np.concatenate([pairs.first, pairs.second]))
    for start in range(0, len(known), MOST_JOINT):
        mine = known[start : start + MOST_JOINT]
        some = np.isin(pairs.first, mine) | np.isin(pairs.second, mine)
        value[mine], sigma[mine], freedom[mine] = _block(pairs.take(some), mine, value)
    return Factors(value, sigma, freedom)


def _block(pairs: Pairs, mine: Ints, value: Floats) -> tuple[Floats, Floats, Floats]:
    """Factors, sigmas and freedoms of the sources `mine` (m,), the others being as in `value`."""
    place = np.full(len(value), -1, dtype=np.intp)
    place[mine] = np.arange(len(mine))
    i, j, alone = place[pairs.first], place[pairs.second], pairs.first == pairs.second
    p, q = np.where(alone, 1.0, pairs.share), np.where(alone, 0.0, 1.0 - pairs.share)
    unit = EFFICIENCY * 2.0 / (pairs.k * pairs.count)
    w = 1.0 / (unit * np.maximum(pairs.scale, LEAST) ** 2)
    fixed = np.where(i < 0, p * value[pairs.first], 0.0) + np.where(j < 0, q * value[pairs.second], 0.0)
    p, q = np.where(i < 0, 0.0, p), np.where(j < 0, 0.0, q)
    A = np.zeros((len(mine), len(w)))
    columns = np.arange(len(w))
    A[i, columns] += p
    A[j, columns] += q
    M, b = _normal(A, w, pairs.scale - fixed, pairs.scale)
    a, inverse = _above_zero(M, b)
    gain = total((inverse[:, :, None] * (A * w)[None]).swapaxes(0, 1))
    null = np.maximum(np.minimum(A + total(A * a[:, None]) - A * a[:, None] + fixed, pairs.scale), LEAST)
    null = np.where(A > 0.0, null, np.maximum(pairs.scale, LEAST))
    part = gain**2 * null**2 * unit
    variance = np.add.reduce(part, axis=1)
    count = np.where(A > 0.0, pairs.count, 0.0)
    most = np.maximum(count.max(axis=1, initial=0.0), 0.1)
    ours = np.add.reduce(part * (A > 0.0), axis=1)
    freedom = pairs.k * np.add.reduce(part * count, axis=1) / np.maximum(ours, 1e-300)
    shared = EFFICIENCY * 2.0 / (pairs.k * most)  # the errors of one source are the same ones in all its pairs
    return a, np.sqrt(variance + shared), freedom


def _normal(A: Floats, w: Floats, s: Floats, scale: Floats) -> tuple[Floats, Floats]:
    """M (m, m) and b (m,) of M a = b, the prior included, which is the weaker the larger the least `scale` (K,) of a
    source's pairs is: a factor of 100 is not held back by it, and a sound source beside one with that factor is."""
    weighted = A * w
    M = np.add.reduce(weighted[:, None] * A[None], axis=2)
    b = np.add.reduce(weighted * s, axis=1)
    weight = np.add.reduce(w * (A > 0.0), axis=1)
    least = np.where(A > 0.0, scale, np.inf).min(axis=1, initial=np.inf)
    least = np.where(np.isfinite(least), np.maximum(least, 1.0), 1.0)
    prior = np.diagonal(M) / np.maximum(weight, 1e-300) / (PRIOR * least) ** 2
    prior = np.where(prior > 0.0, prior, 1.0)
    M[range(len(M)), range(len(M))] += prior
    return M, b + prior


def _above_zero(M: Floats, b: Floats) -> tuple[Floats, Floats]:
    """The solution of M a = b with none below 0, and the inverse of M where it is free."""
    held = np.zeros(len(b), dtype=np.bool_)
    for _ in range(3):
        free = np.where(held[:, None] | held[None], np.eye(len(b)), M)
        inverse = np.linalg.inv(free)
        a = total((inverse * np.where(held, 0.0, b)).T)
        if not (a < 0.0).any():
            break
        held |= a < 0.0
    return np.maximum(a, 0.0), inverse
