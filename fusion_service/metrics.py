"""How good an estimate is when the truth is known: GOSPA, OSPA, NEES, identity switches."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, min_weight_full_bipartite_matching
from scipy.spatial import cKDTree
from scipy.special import gammaincinv

from fusion_service import linalg
from fusion_service.arrays import Floats, Ints

__all__ = [
    "DENSE",
    "Gospa",
    "assign",
    "assign_near",
    "chi2_quantile",
    "gospa",
    "identity_switches",
    "near_pairs",
    "nees",
    "nees_bounds",
    "ospa",
]

Tree: TypeAlias = cKDTree

DENSE = 2500
"""Pairs up to which all of them are looked at, and assigned at once."""
SPARSE = 64
"""Rows and columns of a connected part above which its assignment is made on its pairs alone."""


class Gospa(NamedTuple):
    """`distance`^p = `localisation` + `missed` + `false`, which are p-th powers.

    `assignment` (T,): index of the estimate assigned to each true object, -1 for a missed one.
    """

    distance: float
    localisation: float
    missed: float
    false: float
    assignment: Ints


def gospa(truth: Floats, estimates: Floats, c: float, p: float = 2.0, alpha: float = 2.0) -> Gospa:
    """Generalised optimal sub-pattern assignment of `truth` (T, d) and `estimates` (M, d), Euclidean distance.

    Rahmathullah, Garcia-Fernandez, Svensson (2017), Definition 1 and, for alpha = 2, Proposition 1: assigned
    pairs, all closer than c, cost their distance^p, every other object and estimate c^p / 2. For alpha < 2
    the |M - T| left over cost c^p / alpha each, and a pair that is c or more apart c^p / 2 on either side.
    """
    objects, tracks = len(truth), len(estimates)
    rows, columns, distance = assign(truth, estimates, c, p)
    assignment = np.full(objects, -1)
    assignment[rows] = columns
    localisation = float((distance**p).sum())
    apart = min(objects, tracks) - len(rows)
    missed = c**p * (apart / 2 + max(objects - tracks, 0) / alpha)
    false = c**p * (apart / 2 + max(tracks - objects, 0) / alpha)
    return Gospa((localisation + missed + false) ** (1 / p), localisation, missed, false, assignment)


def near_pairs(truth: Floats | Tree, estimates: Floats, c: float) -> tuple[Ints, Ints, Floats]:
    """All pairs of `truth` (T, d), or a tree of it, and `estimates` (M, d) closer than c: rows and columns (K,), by
    row and then column, and their distances (K,)."""
    places = truth.data if isinstance(truth, cKDTree) else truth
    if len(places) * len(estimates) <= DENSE:
        gap = places[:, None, :] - estimates[None, :, :]
        distance = np.sqrt((gap * gap).sum(axis=-1))
        i, j = np.nonzero(distance < c)
        return i, j, distance[i, j]
    tree = truth if isinstance(truth, cKDTree) else cKDTree(truth)
    near = tree.sparse_distance_matrix(cKDTree(estimates), c, output_type="ndarray")
    order = np.lexsort((near["j"], near["i"]))
    i, j = near["i"][order].astype(np.intp), near["j"][order].astype(np.intp)
    gap = places[i] - estimates[j]
    distance = np.sqrt((gap * gap).sum(axis=-1))
    close = distance < c
    return i[close], j[close], distance[close]


def assign(truth: Floats, estimates: Floats, c: float, p: float = 2.0) -> tuple[Ints, Ints, Floats]:
    """The assignment of (T, d) to (M, d) that both metrics use: rows and columns (K,) of its pairs closer than c, by
    row, and their distances (K,)."""
    i, j, d = near_pairs(truth, estimates, c)
    kept = assign_near(i, j, c**p - d**p, (len(truth), len(estimates)))
    return i[kept], j[kept], d[kept]


def assign_near(i: Ints, j: Ints, gain: Floats, shape: tuple[int, int]) -> Ints:
    """Which of the pairs (i, j), by row and then column, are assigned: one for each row and each column at most, with
    the largest sum of gains, all above 0. In the order of the pairs.

    With gain = c^p - distance^p of the pairs closer than c, that minimises the sum of min(distance, c)^p over
    min(T, M) pairs. Each connected part of the pairs is an assignment of its own.
    """
    if shape[0] * shape[1] <= DENSE:
        return np.sort(_best(i, j, gain)) if len(i) else np.zeros(0, dtype=np.intp)
    graph = coo_array((np.ones(len(i)), (i, shape[0] + j)), (sum(shape), sum(shape)))
    _, part = connected_components(graph, directed=False)
    order = np.argsort(part[i], kind="stable")
    begins = np.flatnonzero(np.diff(part[i][order], prepend=-1))
    ends = np.append(begins[1:], len(i))
    alone = ends - begins == 1
    chosen = [order[begins[alone]]]
    for begin, end in zip(begins[~alone].tolist(), ends[~alone].tolist(), strict=True):
        at = order[begin:end]
        chosen.append(at[_best(i[at], j[at], gain[at])])
    return np.sort(np.concatenate(chosen))


def _best(i: Ints, j: Ints, gain: Floats) -> Ints:
    """The same for one part, K > 0 pairs; in any order."""
    if len(i) == 2:  # they share a row or a column
        return np.array([int(gain[1] > gain[0])]) if i[0] == i[1] or j[0] == j[1] else np.arange(2)
    some, row = np.unique(i, return_inverse=True)
    others, column = np.unique(j, return_inverse=True)
    if min(len(some), len(others)) > SPARSE:
        # a column of its own for every row, at no gain, makes a full matching; a cost of 0 would be no edge
        top, rows = 1 + float(gain.max()), np.arange(len(some))
        cost = np.concatenate([top - gain, np.full(len(some), top)])
        edges = np.concatenate([row, rows]), np.concatenate([column, len(others) + rows])
        matched = min_weight_full_bipartite_matching(coo_array((cost, edges)).tocsr())
        wanted = matched[0] * (len(others) + len(some)) + matched[1]
        found: Ints = np.flatnonzero(np.isin(row * (len(others) + len(some)) + column, wanted))
        return found
    worth = np.zeros((len(some), len(others)))
    worth[row, column] = gain
    pair = np.full(worth.shape, -1)
    pair[row, column] = np.arange(len(i))
    kept: Ints = pair[linear_sum_assignment(worth, maximize=True)]
    return kept[kept >= 0]


def ospa(truth: Floats, estimates: Floats, c: float, p: float = 2.0) -> float:
    """Optimal sub-pattern assignment distance of (T, d) and (M, d), at most c; Schuhmacher, Vo, Vo (2008), (3)."""
    larger = max(len(truth), len(estimates))
    return gospa(truth, estimates, c, p, alpha=1.0).distance / larger ** (1 / p) if larger else 0.0


def nees(errors: Floats, covariances: Floats) -> Floats:
    """Normalised estimation error squared e' P^-1 e (...) of errors (..., n) and covariances (..., n, n)."""
    batch = np.broadcast_shapes(errors.shape[:-1], covariances.shape[:-2])
    e = np.broadcast_to(errors, (*batch, errors.shape[-1]))
    P = np.broadcast_to(covariances, (*batch, *covariances.shape[-2:]))
    return linalg.quadratic(linalg.to_last(P, 2), linalg.to_last(e, 1)).reshape(batch)


def nees_bounds(n: int, samples: int, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided bounds for the average of `samples` independent NEES values of dimension n, divided by n.

    For a consistent estimate n * samples * average is chi-square with n * samples degrees of freedom
    (Bar-Shalom, Li, Kirubarajan, 2001, 5.4.2). Errors along one track are correlated: there the true
    bounds are wider. Raises ValueError for n or samples below 1, or a probability not between 0 and 1.
    """
    if n < 1 or samples < 1 or not 0 < probability < 1:
        raise ValueError(f"bounds need n, samples >= 1 and 0 < probability < 1: {n}, {samples}, {probability}")
    freedom = n * samples
    low, high = (2 * float(gammaincinv(freedom / 2, (1 + s * probability) / 2)) / freedom for s in (-1, 1))
    return low, high


def chi2_quantile(probability: float, n: int) -> float:
    """The value below which a chi-square variable of n degrees of freedom lies with this probability; the bits of
    `scipy.stats.chi2.ppf`, without its time to import."""
    return float(2.0 * gammaincinv(n / 2, probability))


def identity_switches(assignments: Iterable[Mapping[Any, Any]]) -> int:
    """How often the track assigned to a true object is another than the last one assigned to it.

    `assignments`: for each time, in order, true object -> track id, without the objects that are missed.
    A time at which the object is missed does not make its last id forgotten (CLEAR MOT's mismatches,
    Bernardin, Stiefelhagen, 2008).
    """
    last: dict[Any, Any] = {}
    switches = 0
    for assigned in assignments:
        for target, track in assigned.items():
            switches += last.get(target, track) != track
            last[target] = track
    return switches
