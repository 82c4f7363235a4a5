"""Which tracks of two sources are the same targets, where errors are too large for any link.

A clock 3 s late at 100 m/s puts every track 300 m off: nothing passes a gate, and nothing would ever be learned. So one
error is supposed to be all that is wrong, and each pair of tracks, one of either source, whose velocities agree says
how large it then is: the offset of a clock, a shift, a turn about the second source's place, an offset of its ranges.
Each such hypothesis is verified with all pairs: it brings so many tracks together within their gate, one to one. The
best is taken if it has enough of them, and clearly more than the best that brings others together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.centre.supervision.bias import CLOCK, HEADING, RANGE, X, Y, design
from fusion_service.centre.supervision.estimate import inverse_2x2
from fusion_service.metrics import chi2_quantile

__all__ = ["FEWEST", "Tracks2", "match"]

FEWEST = 4
"""Tracks that a hypothesis has to bring together."""
MOST_PAIRS = 3000
MOST_HYPOTHESES = 240
"""Of each kind."""
SHARE = 0.4
"""Of the tracks of that source which has fewer near the other's."""
RIVAL = 0.6
"""Of the best, that the best of other pairs must not reach."""
GATE = chi2_quantile(0.99, 2)
FAR_SIGMAS = 3.5
MANOEUVRE = 5.0
"""m/s by which velocities may differ besides."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracks2:
    """Tracks of one source, in the plane: place, velocity (2, T), m, m/s, and their covariances (2, 2, T)."""

    place: Floats
    velocity: Floats
    spread: Floats
    speed_spread: Floats

    def __len__(self) -> int:
        return int(self.place.shape[1])


def match(one: Tracks2, other: Tracks2, site: Floats, sigma: Floats) -> tuple[Ints, Ints]:
    """Tracks of `one` and `other` that are the same targets, (K,) each; none where that is not clear. site (2,): where
    the other stands; sigma (7,): how large its errors beside those of the one may be."""
    none = np.zeros(0, dtype=np.intp)
    i, j = _candidates(one, other, site, sigma)
    near = min(len(np.unique(i)), len(np.unique(j)))
    if near < FEWEST:
        return none, none
    away = other.place[:, j] - one.place[:, i]
    spread = one.spread[:, :, i] + other.spread[:, :, j]
    H = design(one.place[:, i], one.velocity[:, i], np.repeat(site[:, None], len(i), axis=1))
    kinds = [(CLOCK,), (X, Y), (HEADING,), (RANGE,)]
    found = [_verify(kind, H, away, spread, i, j, sigma) for kind in kinds if all(sigma[k] > 0 for k in kind)]
    if not found:
        return none, none
    score = np.concatenate([scores for scores, _ in found])
    inside = np.concatenate([which for _, which in found])
    if not len(score):
        return none, none
    best = int(np.argmax(score))
    kept = _one_to_one(i, j, inside[best], away, spread)
    same = np.zeros(len(i), dtype=np.bool_)
    same[kept] = True
    others = inside & ~same
    rival = int(_count(others, i, j).max(initial=0))
    if len(kept) < max(FEWEST, SHARE * near) or rival > RIVAL * len(kept):
        return none, none
    return i[kept], j[kept]


def _candidates(one: Tracks2, other: Tracks2, site: Floats, sigma: Floats) -> tuple[Ints, Ints]:
    """Pairs (i, j) whose velocities agree and whose places do within what errors may make of them."""
    speed = np.hypot(*one.velocity)
    far = np.hypot(*(one.place - site[:, None]))
    reach = (
        (sigma[CLOCK] * speed) ** 2 + sigma[X] ** 2 + sigma[Y] ** 2 + (sigma[HEADING] * far) ** 2 + sigma[RANGE] ** 2
    )
    own = one.spread[0, 0] + one.spread[1, 1]
    its = other.spread[0, 0] + other.spread[1, 1]
    i, j = _in_strips(one.place, other.place, FAR_SIGMAS * np.sqrt(reach + own + its.max(initial=0.0)))
    away = other.place[:, j] - one.place[:, i]
    good = away[0] ** 2 + away[1] ** 2 <= FAR_SIGMAS**2 * (reach + own)[i] + FAR_SIGMAS**2 * its[j]
    i, j = i[good], j[good]
    spread = one.speed_spread[:, :, i] + other.speed_spread[:, :, j]
    turn = sigma[HEADING] * speed[i]
    for k in (0, 1):
        spread[k, k] += MANOEUVRE**2 + turn**2
    agree = _square(spread, other.velocity[:, j] - one.velocity[:, i]) <= GATE
    i, j = i[agree], j[agree]
    if len(i) > MOST_PAIRS:
        every = -(-len(i) // MOST_PAIRS)
        i, j = i[::every], j[::every]
    return i, j


def _in_strips(one: Floats, other: Floats, reach: Floats) -> tuple[Ints, Ints]:
    """Pairs (i, j), in order, of places (2, .) no farther apart than the `reach` of i along that axis on which the
    others are spread most."""
    spread = [float(np.ptp(axis)) if len(axis) else 0.0 for axis in other]
    a, b = one[int(np.argmax(spread))], other[int(np.argmax(spread))]
    order = np.argsort(b, kind="stable")
    wide = reach * (1.0 + 1e-9)
    first, last = np.searchsorted(b[order], a - wide, "left"), np.searchsorted(b[order], a + wide, "right")
    number = np.maximum(last - first, 0)
    i = np.repeat(np.arange(len(a)), number)
    j = order[np.arange(len(i)) - np.repeat(np.cumsum(number) - number, number) + np.repeat(first, number)]
    ordered = np.argsort(i * max(len(b), 1) + j, kind="stable")
    return i[ordered], j[ordered]


def _verify(
    kind: tuple[int, ...], H: Floats, away: Floats, spread: Floats, i: Ints, j: Ints, sigma: Floats
) -> tuple[Ints, Bools]:
    """How many tracks each hypothesis of a kind brings together one to one, and which pairs (h, K) it does."""
    if len(kind) == 2:
        value = away.copy()
        possible = (np.abs(value) <= FAR_SIGMAS * sigma[list(kind)][:, None]).all(axis=0)
    else:
        h = H[:, kind[0]]
        W = inverse_2x2(spread)
        Wh = np.stack([W[k, 0] * h[0] + W[k, 1] * h[1] for k in (0, 1)])
        size = h[0] * Wh[0] + h[1] * Wh[1]
        scalar = (Wh[0] * away[0] + Wh[1] * away[1]) / np.where(size > 0, size, np.inf)
        value = scalar[None]
        possible = (np.abs(scalar) <= FAR_SIGMAS * sigma[kind[0]]) & (_square(spread, away - h * scalar) <= GATE)
    which = np.flatnonzero(possible)
    every = max(1, -(-len(which) // MOST_HYPOTHESES))
    which = which[::every]
    inside = np.zeros((len(which), len(i)), dtype=np.bool_)
    for row, at in enumerate(which.tolist()):
        explained = sum(H[:, k] * value[place, at] for place, k in enumerate(kind))
        inside[row] = _square(2.0 * spread, away - explained) <= GATE
    return _count(inside, i, j), inside


def _count(inside: Bools, i: Ints, j: Ints) -> Ints:
    """How many tracks pairs (h, K) have on that side that has fewer."""
    out = []
    for key in (i, j):
        order = np.argsort(key, kind="stable")
        start = np.flatnonzero(np.diff(key[order], prepend=-1))
        part = np.logical_or.reduceat(inside[:, order], start, axis=1) if len(start) else inside
        out.append(part.sum(axis=1))
    return np.asarray(np.minimum(out[0], out[1]))


def _one_to_one(i: Ints, j: Ints, inside: Bools, away: Floats, spread: Floats) -> Ints:
    """Of the pairs inside those whose tracks are in no other."""
    at = np.flatnonzero(inside)
    single = (np.bincount(i[at])[i[at]] == 1) & (np.bincount(j[at])[j[at]] == 1)
    return np.asarray(at[single])


def _square(spread: Floats, x: Floats) -> Floats:
    W = inverse_2x2(spread)
    return np.asarray(sum(x[a] * W[a, b] * x[b] for a in (0, 1) for b in (0, 1)))
