"""How good an estimate is when the truth is known: GOSPA, OSPA, NEES, identity switches."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import gammaincinv

from fusion_service import linalg

__all__ = ["Gospa", "assign", "gospa", "identity_switches", "nees", "nees_bounds", "ospa"]

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

DENSE = 2500
"""Pairs up to which all of them are assigned at once."""


class Gospa(NamedTuple):
    """`distance`^p = `localisation` + `missed` + `false`, which are p-th powers.

    `assignment` (T,): index of the estimate assigned to each true object, -1 for a missed one.
    """

    distance: float
    localisation: float
    missed: float
    false: float
    assignment: NDArray[np.intp]


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


def assign(truth: Floats, estimates: Floats, c: float, p: float = 2.0) -> tuple[Indices, Indices, Floats]:
    """The assignment of (T, d) to (M, d) that both metrics use: rows and columns (K,) of its pairs closer than c, by
    row, and their distances (K,).

    It minimises the sum of min(distance, c)^p over min(T, M) pairs, which is to maximise the sum of c^p - distance^p
    over pairs closer than c: these alone are looked at, and each connected part of them is an assignment of its own.
    """
    if len(truth) * len(estimates) <= DENSE:
        gap = truth[:, None, :] - estimates[None, :, :]
        distance = np.sqrt((gap * gap).sum(axis=-1))
        rows, columns = linear_sum_assignment(np.minimum(distance, c) ** p)
        close = distance[rows, columns] < c
        rows, columns = rows[close], columns[close]
        return rows, columns, distance[rows, columns]
    tree = cKDTree(estimates)
    near = tree.query_ball_point(truth, c)
    i = np.repeat(np.arange(len(truth)), [len(one) for one in near])
    j = np.array([column for one in near for column in one], dtype=np.intp)
    gap = truth[i] - estimates[j]
    d = np.sqrt((gap * gap).sum(axis=-1))
    i, j, d = i[d < c], j[d < c], d[d < c]
    nodes = len(truth) + len(estimates)
    _, part = connected_components(coo_array((np.ones(len(i)), (i, len(truth) + j)), (nodes, nodes)), directed=False)
    order = np.lexsort((j, i, part[i]))
    i, j, d = i[order], j[order], d[order]
    begins = np.flatnonzero(np.diff(part[i], prepend=-1))
    ends = np.append(begins[1:], len(i))
    alone = ends - begins == 1
    chosen = [begins[alone]]
    for begin, end in zip(begins[~alone], ends[~alone], strict=True):
        some, row = np.unique(i[begin:end], return_inverse=True)
        others, column = np.unique(j[begin:end], return_inverse=True)
        cost = np.zeros((len(some), len(others)))
        cost[row, column] = d[begin:end] ** p - c**p
        pair = np.full(cost.shape, -1)
        pair[row, column] = np.arange(begin, end)
        found = pair[linear_sum_assignment(cost)]
        chosen.append(found[found >= 0])
    kept = np.sort(np.concatenate(chosen))
    kept = kept[np.argsort(i[kept], kind="stable")]
    return i[kept], j[kept], d[kept]


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
    bounds are wider.
    """
    if n < 1 or samples < 1 or not 0 < probability < 1:
        raise ValueError(f"bounds need n, samples >= 1 and 0 < probability < 1: {n}, {samples}, {probability}")
    freedom = n * samples
    low, high = (2 * float(gammaincinv(freedom / 2, (1 + s * probability) / 2)) / freedom for s in (-1, 1))
    return low, high


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
