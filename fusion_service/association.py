"""Track-to-track association over all sources at once.

The cross-covariance of two local tracks is unknown, so the distance of a pair is
d2 = (xi - xj)' (Pi + Pj)^-1 (xi - xj), gated by chi-square (Sharma eq. (88), inverse restored); pairs are
ranked by d2 + log det(Pi + Pj), so that a vague track does not win over a sharp one. Rows are in canonical
order (source, epoch, id) and ties go to the first, so the order of arrival does not matter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fusion_service import linalg

__all__ = ["by_size", "candidate_pairs", "cluster", "leave_one_out", "pair_distance", "uniform_ci"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Label = TypeVar("Label", bound=np.generic)


def by_size(labels: NDArray[Label]) -> Iterator[tuple[NDArray[Label], Ints]]:
    """Groups of equal labels (M,), gathered by their size k: (labels (G,), row indices (G, k)).

    Groups come in order of label within a size, rows in their own order within a group.
    """
    order = np.argsort(labels, kind="stable")
    unique, starts, counts = np.unique(labels[order], return_index=True, return_counts=True)
    for k in np.unique(counts):
        chosen = counts == k
        yield unique[chosen], order[starts[chosen][:, None] + np.arange(k)]


def uniform_ci(means: Floats, covariances: Floats) -> tuple[Floats, Floats]:
    """Covariance intersection with equal weights: (k, n, B), (k, n, n, B) -> (n, B), (n, n, B)."""
    if len(means) == 1:
        return means[0], covariances[0]
    information = linalg.inverse(covariances[0])
    vector = linalg.matvec(information, means[0])
    for mean, covariance in zip(means[1:], covariances[1:], strict=True):
        inverse = linalg.inverse(covariance)
        information = information + inverse
        vector = vector + linalg.matvec(inverse, mean)
    covariance = linalg.inverse(information)
    return linalg.matvec(covariance, vector), covariance * float(len(means))


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
    total = covariances[:, :, i] + covariances[:, :, j]
    return linalg.quadratic(total, means[:, i] - means[:, j]), linalg.logdet(total)


def candidate_pairs(positions: Floats, sigma: Floats, reach: float) -> tuple[Ints, Ints]:
    """All i < j with |position difference| <= reach (sigma_i + sigma_j): a superset of the gated pairs.

    positions (d, M), sigma (M,) the largest standard deviation of each position. Rows are sorted into octaves
    of sigma with one tree each, so that a few vague tracks do not make every pair a candidate.
    """
    octave = np.ceil(np.log2(np.maximum(sigma, 1e-9))).astype(np.int64)
    groups = [(float(2.0**level), np.flatnonzero(octave == level)) for level in np.unique(octave)]
    trees = [cKDTree(positions[:, rows].T) for _, rows in groups]
    firsts: list[Ints] = []
    seconds: list[Ints] = []
    for a, (size_a, rows_a) in enumerate(groups):
        for b in range(a, len(groups)):
            size_b, rows_b = groups[b]
            found = trees[a].query_ball_tree(trees[b], reach * (size_a + size_b))
            lengths = np.fromiter(map(len, found), dtype=np.intp, count=len(found))
            one = np.repeat(rows_a, lengths)
            flat = np.fromiter((k for near in found for k in near), dtype=np.intp, count=int(lengths.sum()))
            two = rows_b[flat]
            chosen = one < two if a == b else np.ones(len(one), dtype=np.bool_)
            firsts.append(np.minimum(one, two)[chosen])
            seconds.append(np.maximum(one, two)[chosen])
    i = np.concatenate(firsts) if firsts else np.zeros(0, dtype=np.intp)
    j = np.concatenate(seconds) if seconds else np.zeros(0, dtype=np.intp)
    return i, j


def cluster(
    i: Ints, j: Ints, cost: Floats, members: Sequence[int], whole: Sequence[bool]
) -> tuple[list[int], list[tuple[int, int, float]]]:
    """Greedy complete-link clustering of nodes under "at most one track per source".

    (i, j) are the gated pairs and `cost` their rank; members[k] is the set of sources of node k as bits;
    whole[k] says that the node is a global track, of which a cluster holds at most one. Two clusters are
    joined when every pair across them is gated and their sources are disjoint, cheapest pair first. Returns
    for each node the smallest node of its cluster, and the joins made as (node, node, cost).
    """
    root = list(range(len(members)))
    nodes = {k: [k] for k in root}
    bits, holds = list(members), list(whole)
    gated = set(zip(i.tolist(), j.tolist(), strict=True))
    joins: list[tuple[int, int, float]] = []
    for at in np.lexsort((j, i, cost)).tolist():
        first, second = int(i[at]), int(j[at])
        a, b = sorted((root[first], root[second]))
        if a == b or bits[a] & bits[b] or (holds[a] and holds[b]):
            continue
        if not all(((x, y) if x < y else (y, x)) in gated for x in nodes[a] for y in nodes[b]):
            continue
        for node in nodes[b]:
            root[node] = a
        nodes[a] += nodes.pop(b)
        bits[a] |= bits[b]
        holds[a] = holds[a] or holds[b]
        joins.append((first, second, float(cost[at])))
    return root, joins
