"""By what errors are measured where no source is declared to be right.

What sources say of shared targets tells their errors against each other: nothing is changed where all clocks are off by
the same time, or the whole picture is shifted, turned or stretched. Sources that are connected by shared targets and
have no reference among them are measured by their weighted mean, which is kept at nothing: a weight is the smaller the
more certain a source claims less and the farther it is from the median,

    w = (1 / sigma^2) s^2 / (s^2 + (theta - median)^2),

s^2 its variance, but not more than the middle one: what is far and hardly known does not pull. So
that of three or more the odd one out is the one that is found wrong. Of two nobody can tell: each gets its half of
the difference. An offset of all ranges is no such freedom, and is not kept.
"""

from __future__ import annotations

import numpy as np

from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.centre.supervision.bias import PARAMETERS, RANGE

__all__ = ["SHARED", "connected", "gauge", "gauge_weights", "gauge_words", "halved"]

SHARED = 0.5
"""Shared targets, faded, from which two sources are connected."""
FLOOR = 0.03
"""Of sigma: no two sources are thought to agree better than that."""
KEPT = tuple(at for at in range(len(PARAMETERS)) if at != RANGE)


def connected(shared: Floats) -> Ints:
    """Which sources (S,) hang together by shared targets: the number of the first of them."""
    label = np.arange(len(shared))
    linked = shared >= SHARED
    for _ in range(len(shared)):
        least = np.where(linked, label[None], len(label)).min(axis=1, initial=len(label))
        new = np.minimum(label, least)
        new = new[new]
        if (new == label).all():
            break
        label = new
    return label


def gauge_weights(sigma: Floats, label: Ints, mean: Floats, variance: Floats) -> Floats:
    """How much each error (S, 7) weighs among those of the sources that hang together, besides its sigma (S, 7), by an
    estimate (mean, variance) in whatever gauge: 1 at the median."""
    weight = np.ones(sigma.shape)
    for first in np.unique(label).tolist():
        mine = np.flatnonzero(label == first)
        there = (sigma[mine] > 0)[:, KEPT]
        every = np.array(KEPT)[there.all(axis=0)]
        parts = [(mine, every)] if len(every) else []
        parts += [
            (mine[there[:, k]], np.array([KEPT[k]])) for k in np.flatnonzero(there.any(axis=0) & ~there.all(axis=0))
        ]
        for some, which in parts:
            if len(some) > 2:
                at = np.ix_(some, which)
                off = mean[at] - _median(mean[at])
                spread = np.minimum(variance[at], _median(variance[at])) + (FLOOR * sigma[at]) ** 2
                weight[at] = spread / (spread + off**2)
    return weight


def _median(x: Floats) -> Floats:
    """Of each column of x (K, M), which is finite."""
    ordered = np.sort(x, axis=0)
    return np.asarray(0.5 * (ordered[(len(x) - 1) // 2] + ordered[len(x) // 2]))


def gauge(sigma: Floats, label: Ints, reference: Bools, weights: Floats) -> Floats:
    """Sums (K, S, 7), in units of sigma (S, 7), that are kept at 0; weights (S, 7) as `gauge_weights` gives them."""
    rows = []
    for first in np.unique(label).tolist():
        mine = np.flatnonzero(label == first)
        if len(mine) < 2 or reference[mine].any():
            continue
        for parameter in KEPT:
            some = mine[sigma[mine, parameter] > 0]
            if len(some) < 2:
                continue
            row = np.zeros(sigma.shape)
            row[some, parameter] = weights[some, parameter] / sigma[some, parameter]
            rows.append(row / np.sqrt((row**2).sum()))
    return np.stack(rows) if rows else np.zeros((0, *sigma.shape))


def halved(label: Ints, reference: Bools, at: int) -> bool:
    """Whether the source `at` is measured by the middle between it and one other: as far as it is off that, it may be
    right."""
    mine = label == label[at]
    return int(mine.sum()) == 2 and not reference[mine].any()


def gauge_words(names: tuple[str, ...], at: int, label: Ints, reference: Bools) -> str:
    """By what the errors of the source `at` are measured."""
    mine = np.flatnonzero(label == label[at])
    if reference[at]:
        return "it is the reference: by its clock and place others are measured"
    sure = [names[k] for k in mine.tolist() if reference[k]]
    if sure:
        return "relative to " + ", ".join(sure[:3]) + (" and others" if len(sure) > 3 else "")
    if len(mine) == 2:
        other = names[int(mine[mine != at][0])]
        return f"half of the difference to {other}: which of the two is wrong cannot be told; a reference would tell"
    if len(mine) > 2:
        return f"relative to the weighted mean of {len(mine)} sources, in which those that agree weigh most"
    return "no other source shares targets with it"
