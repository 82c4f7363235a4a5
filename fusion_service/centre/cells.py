"""Intensities (PHDs) of several sources fused place by place.

An intensity D_i(x) = sum_c w_c N(x; m_c, P_c) integrates over a place to the number of targets that source i expects
there. A **cell** is what may be one target: at most one component of each source, each two within a gate. What a
source does not cover it says nothing of: in a cell, the set S of the sources that cover its place counts, with equal
weights 1/|S|, and a source of S without a component there says that nothing is there.

* aa: sum of D_i / |S|, each cell merged to one Gaussian with its mass and moments kept (Li-2nd 5, Li-AA (6)). What
  one of |S| sources denies keeps (|S| - 1) / |S| of its mass.
* ga: prod D_i^(1/|S|), the power of a sum as the sum of the powers (Li-2nd (49)-(51)), the product taken within a cell
  only, as Li-2nd 5.2 advises for one target: uniform covariance intersection with a mass, that of the product at its
  peak over that of a density. Exact where cells are far apart. What one source of S denies is gone.
* hybrid (Li-2nd 5.2): the mass of aa at the place of ga, which those of S that have a component there give. With
  cardinality "consistent" the mass of all cells with one and the same S becomes the cardinality-consistent mean of the
  expected numbers lambda_i that the sources of S have in these cells (Uney (52)-(53), corrected: `fuse_poisson`).

Of a cell that no source covers, those that have a component in it are S.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import prod

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.centre.association import by_size, candidate_pairs, cluster, pair_distance, uniform_ci
from fusion_service.densities import Mixture, Mixtures, log_gaussian
from fusion_service.existence import fuse_poisson
from fusion_service.linalg import total

__all__ = ["Components", "Covering", "find_cells", "fuse_cells", "merge_near", "reduced"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Covering = Callable[[Floats], NDArray[np.bool_]]
"""Which of N sources cover the means (n, M): (N, M)."""


@dataclass(frozen=True, slots=True, eq=False)
class Components:
    """C weighted Gaussians: weight (C,) > 0, mean (n, C), covariance (n, n, C); share (N, C): how much of the weight
    came from each of N sources, with sum 1."""

    weight: Floats
    mean: Floats
    covariance: Floats
    share: Floats

    def take(self, rows: NDArray[np.integer] | NDArray[np.bool_]) -> Components:
        """Those given."""
        return Components(self.weight[rows], self.mean[:, rows], self.covariance[:, :, rows], self.share[:, rows])

    @property
    def mass(self) -> float:
        """The expected number."""
        return float(total(self.weight)) if len(self.weight) else 0.0

    def sound(self) -> NDArray[np.bool_]:
        """Which are finite and positive definite (C,)."""
        finite = np.isfinite(self.weight) & np.isfinite(self.mean).all(axis=0)
        return finite & linalg.is_positive_definite(self.covariance)

    def mixture(self) -> Mixture | None:
        """The intensity, None if there is nothing."""
        if not len(self.weight):
            return None
        return Mixture(self.weight, self.mean.T, self.covariance.transpose(2, 0, 1))


def merge_near(parts: Components, distance: float) -> Components:
    """Heaviest first, each component takes in the lighter ones with (m_i - m_j)' (P_i + P_j)^-1 (m_i - m_j) below
    `distance`, and keeps their joint mass, mean and covariance. The result is sorted, heaviest first."""
    parts = parts.take(np.argsort(-parts.weight, kind="stable"))
    variance = np.ascontiguousarray(np.einsum("iic->ic", parts.covariance))
    owner = np.full(len(parts.weight), -1)
    for i in range(len(owner)):
        if owner[i] >= 0:
            continue
        owner[i] = i
        free = i + np.flatnonzero(owner[i:] < 0)
        away = parts.mean[:, free] - parts.mean[:, i, None]
        close = (away * away < distance * (variance[:, free] + variance[:, i, None])).all(axis=0)
        free, away = free[close], away[:, close]
        spread = parts.covariance[:, :, free] + parts.covariance[:, :, i, None]
        owner[free[linalg.quadratic(spread, away) < distance]] = i
    _, group = np.unique(owner, return_inverse=True)
    merged = _merged(parts, np.asarray(group))
    return merged.take(np.argsort(-merged.weight, kind="stable"))


def _merged(parts: Components, group: Ints) -> Components:
    """One component per group (C,) of 0 ... G-1, with the mass, mean and covariance of its members."""
    count = int(group.max(initial=-1)) + 1
    weight = np.bincount(group, parts.weight, count).astype(np.float64)
    part = parts.weight / weight[group]

    def mean_of(values: Floats) -> Floats:
        rows = (part * values).reshape(prod(values.shape[:-1]), -1)
        sums = [np.bincount(group, row, count) for row in rows]
        return np.array(sums, dtype=np.float64).reshape(*values.shape[:-1], count)

    _, first = np.unique(group, return_index=True)
    mean = parts.mean[:, first] + mean_of(parts.mean - parts.mean[:, first[group]])
    away = parts.mean - mean[:, group]
    covariance = mean_of(parts.covariance + linalg.outer(away, away))
    return Components(weight, mean, covariance, mean_of(parts.share))


def reduced(parts: Components, prune: float, distance: float, most: int) -> Components:
    """Without weights below `prune`, `merge_near`, and of these the `most` heaviest; of more than twice as many only
    the heaviest are looked at. What is dropped is lost from the mass."""
    heaviest = np.argsort(-parts.weight, kind="stable")
    heaviest = heaviest[(parts.weight > 0)[heaviest] & (parts.weight >= prune)[heaviest]]
    merged = merge_near(parts.take(heaviest[: 2 * most]), distance)
    return merged.take(np.arange(min(most, len(merged.weight))))


def find_cells(parts: Components, source: Ints, places: list[int], gate: float) -> Ints:
    """The cell (C,) of each component, 0 ... M-1. source (C,): where it comes from; places: the rows of its position.

    Every two of a cell have d2 = (m_i - m_j)' (P_i + P_j)^-1 (m_i - m_j) within `gate`. Pairs are joined in the order
    of their overlap w_i w_j N(m_i; m_j, P_i + P_j), so that what is heavy and near finds its like first.
    """
    sigma = np.sqrt(total(np.stack([parts.covariance[place, place] for place in places])))
    i, j = candidate_pairs(parts.mean[places], sigma, float(np.sqrt(gate)), source)
    distance, spread = pair_distance(parts.mean, parts.covariance, i, j)
    near, logs = distance <= gate, np.log(parts.weight)
    i, j, cost = i[near], j[near], (distance + spread - 2.0 * (logs[i] + logs[j]))[near]
    bits = np.array([1 << one for one in source.tolist()], dtype=np.int64 if source.max(initial=0) < 62 else object)
    root, _ = cluster(i, j, cost, bits, np.zeros(len(source), dtype=np.bool_))
    return np.asarray(np.unique(np.array(root, dtype=np.intp), return_inverse=True)[1])


def fuse_cells(
    rule: str, cardinality: str, parts: Components, source: Ints, cell: Ints, covering: Covering
) -> Components:
    """The fused intensity: a component per cell, by rule "aa", "ga" or "hybrid", the last with cardinality "average"
    or "consistent". cell (C,) as of `find_cells`; what has no weight left is left out."""
    sources, count = len(parts.share), int(cell.max(initial=-1)) + 1
    weight = np.zeros((sources, count))
    weight[source, cell] = parts.weight
    present = weight > 0
    cover = covering(_merged(parts, cell).mean)
    cover = np.where(cover.any(axis=0), cover, present)
    counted = np.where(cover, weight, 0.0)
    number = cover.sum(axis=0)
    mass = total(counted) / number
    if rule == "hybrid" and cardinality == "consistent":
        mass = mass * _consistency(counted, cover)
    if rule == "ga":
        mass = np.where((present | ~cover).all(axis=0), mass, 0.0)
        share = cover / number
    else:
        share = counted / np.where(mass > 0, total(counted), 1.0)
    mean, covariance = np.zeros((len(parts.mean), count)), np.zeros((*parts.covariance.shape[:2], count))
    used = np.flatnonzero(cover[source, cell] & (mass[cell] > 0))
    for ids, groups in by_size(cell[used]):
        rows = used[groups].T
        logs, means, covariances = np.log(parts.weight[rows]), parts.mean[:, rows], parts.covariance[:, :, rows]
        if rule == "aa":
            mean[:, ids], covariance[:, :, ids] = Mixtures(logs, means, covariances).moments()
            continue
        x, P = uniform_ci(np.moveaxis(means, 1, 0), np.moveaxis(covariances, 2, 0))
        mean[:, ids], covariance[:, :, ids] = x, P
        if rule == "ga":
            parts_there = logs + log_gaussian(x[:, None] - means, *linalg.ldl(covariances))
            mass[ids] = np.exp(total(parts_there) / len(rows) - log_gaussian(np.zeros_like(x), *linalg.ldl(P)))
    return Components(mass, mean, linalg.symmetrise(covariance), share).take(~(mass <= 0))


def _consistency(counted: Floats, cover: NDArray[np.bool_]) -> Floats:
    """For each cell (M,), the consistent number of all cells that the same sources cover, relative to the average."""
    patterns, region = np.unique(cover, axis=1, return_inverse=True)
    factor = np.zeros(cover.shape[1])
    for index in range(patterns.shape[1]):
        at = np.asarray(region).reshape(-1) == index
        rates = total(counted[patterns[:, index]][:, at].T)
        factor[at] = fuse_poisson(rates) / fuse_poisson(rates, "average") if rates.any() else 0.0
    return factor
