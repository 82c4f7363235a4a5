"""Whose covariances are called wrong, from pairs of sources and the factors that were found of them (`hat`)."""

from __future__ import annotations

import numpy as np

from fusion_service.arrays import Bools, Floats
from fusion_service.centre.supervision.hat import Factors, Pairs, decidable
from fusion_service.centre.supervision.scale import high_bound

__all__ = ["MATTERS", "beyond", "contradicted", "mean_scale", "pair_beyond", "unexplained", "with_innovations"]

MATTERS = 1.25
"""A factor on variances below which nothing is said, though it may be no chance."""


def with_innovations(pairs: Pairs, S: int, own: list[tuple[int, float, float]], z: float) -> tuple[Pairs, Bools]:
    """The pairs, with what sources say of themselves where the pairs alone leave it open who is wrong; and of whom
    (S,) it is known then. Only of sources that contradict another: innovations depend on the motion that is declared
    too, and tell which of two is wrong, not whether one is."""
    sure, k = decidable(pairs, S), pairs.k
    against = contradicted(pairs, pair_beyond(pairs, z), S)
    open_ = [one for one in own if against[one[0]] and not sure[one[0]]]
    if not open_:
        return pairs, sure
    at = np.array([i for i, _, _ in open_], dtype=np.intp)
    ratio, freedom = np.array([r for _, r, _ in open_]), np.array([f for _, _, f in open_])
    pairs = pairs.join(Pairs(at, at, ratio, np.ones(len(at)), np.maximum(freedom, 1.0) / k, k))
    return pairs, decidable(pairs, S)


def beyond(found: Factors, z: float, against: Bools) -> Bools:
    """Whose factors (S,) are above 1 by more than chance, and more than matters, of those `against` whom (S,) another
    speaks at all: where every pair differs no more than both say, as with errors that all have in common, the factors
    that explain the pairs best may be above 1 only because others are held at 0."""
    freedom = np.maximum(found.freedom, 0.2)
    skewed = (high_bound(freedom, z) - 1.0) / np.sqrt(2.0 / freedom)
    more = (found.value > MATTERS) & (found.value - 1.0 > np.maximum(skewed, z) * found.sigma)
    return np.asarray(more & against)


def contradicted(pairs: Pairs, suspect: Bools, S: int) -> Bools:
    """Which sources (S,) are in a `suspect` pair."""
    return np.isin(np.arange(S), np.concatenate([pairs.first[suspect], pairs.second[suspect]]))


def unexplained(pairs: Pairs, value: Floats, suspect: Bools) -> Bools:
    """Which sources (S,) of `suspect` pairs differ from the other by more than the factors `value` (S,) explain, where
    these are known by innovations only: an offset of place or clock is in none, and which of two has it is not known
    from them."""
    explained = value[pairs.first] * pairs.share + value[pairs.second] * (1.0 - pairs.share)
    some = suspect & (pairs.scale > MATTERS * explained)
    S, real = len(value), pairs.first != pairs.second
    alone = ~decidable(pairs.take(real), S)
    return alone & contradicted(pairs, some, S)


def pair_beyond(pairs: Pairs, z: float) -> Bools:
    """Which pairs (K,) differ by more than both say, beyond chance and what matters."""
    return np.asarray(pairs.scale > np.maximum(high_bound(pairs.k * pairs.count / 1.1, z), MATTERS))


def mean_scale(pairs: Pairs, S: int) -> tuple[Floats, Floats]:
    """Mean of the scales of each source's pairs (S,), NaN without, and how many independent differences it has."""
    weight, value, most = np.zeros(S), np.zeros(S), np.zeros(S)
    real = pairs.first != pairs.second
    for side in (pairs.first[real], pairs.second[real]):
        np.add.at(weight, side, pairs.count[real])
        np.add.at(value, side, (pairs.count * pairs.scale)[real])
        np.maximum.at(most, side, pairs.count[real])
    return np.where(weight > 0.0, value / np.where(weight > 0.0, weight, 1.0), np.nan), most
