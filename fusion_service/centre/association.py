"""Track-to-track association over all sources at once.

The cross-covariance of two local tracks is unknown, so the distance of a pair is
d2 = (xi - xj)' (Pi + Pj)^-1 (xi - xj), gated by chi-square (Sharma eq. (88), inverse restored); pairs are
ranked by d2 + log det(Pi + Pj), so that a vague track does not win over a sharp one. Rows are in canonical
order (source, epoch, id) and ties go to the first, so the order of arrival does not matter.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fusion_service import linalg
from fusion_service.arrays import Floats, Ints, all_of, marked
from fusion_service.densities import Mixtures, log_sum

__all__ = [
    "CROWDED",
    "SOUND",
    "by_size",
    "candidate_pairs",
    "cluster",
    "leave_one_out",
    "near_pairs",
    "overlap",
    "pair_distance",
    "uniform_ci",
    "within",
]

Label = TypeVar("Label", bound=np.generic)

LIGHTEST = 0.05
"""Components of less weight do not open a gate."""
SOUND = 1e-10
"""Least pivot, relative to its variance, of what is inverted."""
SOUND_WIDE = 1e-13 if np.finfo(np.longdouble).eps < 2e-19 else 1.0
TIERS = (8, 64)
"""Neighbours sought of a row, and again of one that has as many; one that has the last number is crowded."""
CROWDED = TIERS[-1]
CROWD = 256
"""Partners sought of a crowded row, shared evenly between the sources."""
FEW = 512
"""Labels up to which groups of them are kept."""
CHUNK = 4096
"""Rows or pairs worked on at a time: bounds memory, and how long a signal has to wait."""


def by_size(labels: NDArray[Label]) -> Iterator[tuple[NDArray[Label], Ints]]:
    """Groups of equal labels (M,), gathered by their size k: (labels (G,), row indices (G, k)).

    Groups come in order of label within a size, rows in their own order within a group.
    """
    if len(labels) > FEW or labels.dtype != np.uint64:
        yield from _by_size(labels)
    elif len(labels):
        yield from _few_by_size(labels.tobytes())


@lru_cache(maxsize=64)
def _few_by_size(labels: bytes) -> tuple[tuple[Any, Ints], ...]:
    """The same of few: a step asks it several times of the same, and the next step again."""
    groups = tuple(_by_size(np.frombuffer(labels, dtype=np.uint64)))
    for column in (column for group in groups for column in group):
        column.flags.writeable = False
    return groups


def _by_size(labels: NDArray[Label]) -> Iterator[tuple[NDArray[Label], Ints]]:
    if not len(labels):
        return
    order = labels.argsort(kind="stable")
    ranked = labels[order]
    new = marked(ranked[1:] != ranked[:-1])
    edges = np.zeros(len(new) + 2, dtype=np.intp)
    edges[1:-1], edges[-1] = new + 1, len(labels)
    starts, counts = edges[:-1], edges[1:] - edges[:-1]
    unique, size = ranked[starts], int(counts[0])
    if all_of(counts == size):
        yield unique, order.reshape(len(unique), size)
        return
    for k in marked(np.bincount(counts)).tolist():
        chosen = counts == k
        yield unique[chosen], order[starts[chosen][:, None] + np.arange(k)]


def uniform_ci(means: Floats, covariances: Floats) -> tuple[Floats, Floats]:
    """Covariance intersection with equal weights: (k, n, B), (k, n, n, B) -> (n, B), (n, n, B).

    Where rounding could spoil the result (a correlation singular to within `SOUND`) it is computed in longdouble; where
    it could even there (`SOUND_WIDE`), the source with the smallest determinant stands for all.
    """
    if len(means) == 1:
        return means[0], covariances[0]
    least_sound = SOUND if means.dtype == np.float64 else SOUND_WIDE
    information, _, least = linalg.sweep(covariances[0])
    vector = linalg.matvec(information, means[0])
    for mean, covariance in zip(means[1:], covariances[1:], strict=True):
        inverse, _, margin = linalg.sweep(covariance)
        information = information + inverse
        vector = vector + linalg.matvec(inverse, mean)
        least = np.minimum(least, margin)
    covariance, _, margin = linalg.sweep(information)
    x, C = linalg.matvec(covariance, vector), covariance * float(len(means))
    sound = (np.minimum(least, margin) > least_sound) & np.isfinite(x).all(axis=0) & np.isfinite(C).all(axis=(0, 1))
    bad = marked(~sound)
    if len(bad) and means.dtype == np.float64:
        x[:, bad], C[:, :, bad] = uniform_ci(
            means[:, :, bad].astype(np.longdouble), covariances[:, :, :, bad].astype(np.longdouble)
        )
    elif len(bad):
        size = np.stack([linalg.logdet(P[:, :, bad]) for P in covariances])
        best = np.argmin(np.where(np.isfinite(size), size, np.inf), axis=0)
        x[:, bad] = means[best, :, bad].T
        C[:, :, bad] = np.moveaxis(covariances[best, :, :, bad], 0, 2)
    return x, C


def leave_one_out(labels: NDArray[np.generic], means: Floats, covariances: Floats) -> Floats:
    """d2 (M,) of each row to the equal-weight fusion of the other rows of its label; NaN where it is alone."""
    distance = np.full(len(labels), np.nan)
    for _, rows in by_size(labels):
        k = rows.shape[1]
        for i in range(k if k > 1 else 0):
            others = [rows[:, j] for j in range(k) if j != i]
            mean, covariance = uniform_ci(
                np.stack([means[:, j] for j in others]), np.stack([covariances[:, :, j] for j in others])
            )
            one = rows[:, i]
            distance[one] = linalg.quadratic(covariances[:, :, one] + covariance, means[:, one] - mean)
    return distance


def pair_distance(means: Floats, covariances: Floats, i: Ints, j: Ints) -> tuple[Floats, Floats]:
    """d2 and log det(Pi + Pj) of the pairs (i, j), each (K,)."""
    distance, spread = np.empty(len(i)), np.empty(len(i))
    for part in linalg.blocks(len(means), len(i)):
        a, b = i[part], j[part]
        both = covariances[:, :, a] + covariances[:, :, b]
        distance[part] = linalg.quadratic(both, means[:, a] - means[:, b])
        spread[part] = linalg.logdet(both)
    return distance, spread


def overlap(first: Mixtures, second: Mixtures) -> tuple[Floats, Floats]:
    """How near K pairs of mixtures are: d2 (K,) of their nearest components of weight `LIGHTEST` or more, and
    -2 log of the overlap integral (without the 2 pi), less that d2: for Gaussians d2 and log det(Pi + Pj)."""
    nearest = np.full(len(first), np.inf)
    n = len(first.means)
    logs = []
    for a in range(len(first.log_weights)):
        for b in range(len(second.log_weights)):
            total = first.covariances[:, :, a] + second.covariances[:, :, b]
            distance = linalg.quadratic(total, first.means[:, a] - second.means[:, b])
            weight = first.log_weights[a] + second.log_weights[b]
            logs.append(weight - 0.5 * (distance + linalg.logdet(total)))
            heavy = np.minimum(first.log_weights[a], second.log_weights[b]) >= np.log(LIGHTEST)
            nearest = np.where(heavy, np.fmin(nearest, distance), nearest)
    if not logs or not n:
        return nearest, nearest
    return nearest, -2.0 * log_sum(np.stack(logs)) - nearest


def candidate_pairs(positions: Floats, sigma: Floats, reach: float, source: Ints) -> tuple[Ints, Ints]:
    """Pairs i < j of different sources with |xi - xj|^2 <= reach^2 (sigma_i^2 + sigma_j^2), in order: a superset
    of the gated ones, but for crowds.

    positions (d, M); sigma (M,) no less than the largest standard deviation of each position; source (M,), -1
    for a global track, which pairs with every row. A row that is not finite has no partner. Rows are sorted
    into octaves of sigma with one tree each and sought from the sharper side, so that a few vague tracks do
    not make every pair a candidate.

    A row with more than some 64 neighbours no sharper than itself is crowded: of those only the nearest are
    sure to be among its partners, 256 shared evenly between the sources and at least one of each. So memory
    and time are bounded by rows times max(256, sources), even if all tracks coincide. Between equally near
    ones (to within a thousandth of the smallest sigma) the place in the canonical order decides: coincident
    sources are paired first with first, second with second.
    """
    return near_pairs(positions, sigma, reach, source)[:2]


def within(positions: Floats, sigma: Floats, reach: float, source: Ints, one: Ints, two: Ints) -> NDArray[np.bool_]:
    """Which of the pairs (K,) are pairs of `candidate_pairs`."""
    square = ((positions[:, one] - positions[:, two]) ** 2).sum(axis=0)
    near = square <= (1 + 1e-9) * reach**2 * (sigma[one] ** 2 + sigma[two] ** 2)
    near &= (one != two) & ((source[one] != source[two]) | (source[one] < 0))
    return np.asarray(near)


def near_pairs(positions: Floats, sigma: Floats, reach: float, source: Ints) -> tuple[Ints, Ints, bool]:
    """`candidate_pairs`, and whether any row is crowded."""
    count = len(sigma)
    fit = marked(np.isfinite(positions).all(axis=0) & np.isfinite(sigma))
    sigma = np.maximum(sigma, 1e-9)
    names, rank = [], np.zeros(count)
    for labels, rows in by_size(source[fit]):
        names += labels.tolist()
        rank[fit[rows]] = np.arange(rows.shape[1])
    points = np.vstack([positions, rank * (1e-3 * sigma[fit].min(initial=1.0) / max(count, 1))]).T
    keys: list[Ints] = [np.zeros(0, dtype=np.intp)]

    def keep(one: Ints, two: Ints) -> None:
        near = within(positions, sigma, reach, source, one, two)
        one, two = one[near], two[near]
        keys.append(np.minimum(one, two) * count + np.maximum(one, two))

    octave = np.ceil(np.log2(sigma[fit]))
    groups = [(float(2.0**level), fit[octave == level]) for level in np.unique(octave)]
    trees = [cKDTree(points[rows]) for _, rows in groups]
    crowded: list[Ints] = [np.zeros(0, dtype=np.intp)]
    for a, (size_a, rows_a) in enumerate(groups):
        for rows in _chunks(rows_a):
            found = np.zeros(len(rows), dtype=np.intp)
            for (size_b, rows_b), tree in zip(groups[a:], trees[a:], strict=True):
                bound = 1.001 * reach * (size_a + size_b) + 0.001 * size_a
                seek = marked(found < TIERS[-1])
                for k in TIERS:
                    one, two, number = _nearest(tree, points[rows[seek]], k, bound)
                    full = number == k
                    keep(rows[seek[one[~full[one]]]], rows_b[two[~full[one]]])
                    found[seek] += np.where(full & (k < TIERS[-1]), 0, number)
                    seek = seek[full]
            crowded.append(rows[found >= TIERS[-1]])
    for name in names if any(map(len, crowded)) else ():
        rows_b = fit[source[fit] == name]
        tree = cKDTree(points[rows_b])
        for rows in _chunks(np.concatenate(crowded)):
            rows = rows[(source[rows] != name) | (name < 0)]
            one, two, _ = _nearest(tree, points[rows], max(1, CROWD // len(names)), np.inf)
            keep(rows[one], rows_b[two])
    key = np.sort(np.concatenate(keys))
    key = key[np.diff(key, prepend=-1) > 0]
    return key // max(count, 1), key % max(count, 1), any(map(len, crowded))


def _chunks(rows: Ints) -> Iterator[Ints]:
    return (rows[start : start + CHUNK] for start in range(0, len(rows), CHUNK))


def _nearest(tree: Any, points: Floats, k: int, bound: float) -> tuple[Ints, Ints, Ints]:
    """The k nearest of each point (R, d) within `bound`, as (index of the point, index in the tree), and how
    many each has (R,)."""
    _, index = tree.query(points, k=np.arange(1, k + 1), distance_upper_bound=bound)
    there = index < tree.n
    return np.nonzero(there)[0], index[there], there.sum(axis=1)


def cluster(
    i: Ints, j: Ints, cost: Floats, members: NDArray[Any], whole: NDArray[np.bool_]
) -> tuple[list[int], list[tuple[int, int, float]]]:
    """Greedy complete-link clustering of nodes under "at most one track per source".

    (i, j), i < j, are the gated pairs and `cost` their rank; members[k] is the set of sources of node k as bits;
    whole[k] says that the node is a global track, of which a cluster holds at most one. Two clusters are
    joined when every pair across them is gated and their sources are disjoint, cheapest pair first. Returns
    for each node the smallest node of its cluster, and the joins made as (node, node, cost).
    """
    count = len(members)
    root, bits, holds = np.arange(count), members.copy(), whole.copy()
    nodes: dict[int, list[int]] = {}
    keys: Any = np.sort(i * count + j)
    gated = memoryview(keys)
    joins: list[tuple[int, int, float]] = []
    apart: dict[int, set[int]] = {}  # clusters with a pair that is not gated: never to be joined

    def has(x: int, y: int) -> bool:
        key = min(x, y) * count + max(x, y)
        at = bisect_left(gated, key)
        return at < len(gated) and bool(gated[at] == key)

    for pairs in _chunks(np.lexsort((j, i, cost))):
        one, two = root[i[pairs]], root[j[pairs]]
        # what cannot be joined now never can: clusters only grow
        pairs = pairs[(one != two) & ((bits[one] & bits[two]) == 0) & ~(holds[one] & holds[two])]
        for first, second, price in zip(i[pairs].tolist(), j[pairs].tolist(), cost[pairs].tolist(), strict=True):
            a, b = sorted((int(root[first]), int(root[second])))
            if a == b or bits[a] & bits[b] or (holds[a] and holds[b]):
                continue
            if b in apart.get(a, ()):
                continue
            left, right = nodes.get(a, [a]), nodes.get(b, [b])
            if not all(has(x, y) for x in left for y in right if {x, y} != {first, second}):
                apart.setdefault(a, set()).add(b)
                apart.setdefault(b, set()).add(a)
                continue
            for other in apart.pop(b, ()):
                apart[other].discard(b)
                apart[other].add(a)
                apart.setdefault(a, set()).add(other)
            root[right] = a
            nodes[a] = left + right
            nodes.pop(b, None)
            bits[a] |= bits[b]
            holds[a] |= holds[b]
            joins.append((first, second, price))
    return root.tolist(), joins
