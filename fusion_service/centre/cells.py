"""Intensities (PHDs) of several sources fused place by place.

An intensity D_i(x) = sum_c w_c N(x; m_c, P_c) integrates over a place to the number of targets that source i expects
there. A **cell** is what may be one target: at most one component of each source, each two within a gate. What a
source says of the place of a cell:

* It has a component in it: that one's weight. But not where it declares a coverage that does not hold the place
  (what it has there is a memory), unless nobody else has a say.
* It has none, and declares a coverage that holds the place: it missed whatever is there. Targets of one place, Poisson
  with mean lambda, each detected with probability p, fall apart into detected and missed ones, which are independent
  Poisson numbers of means p lambda and (1 - p) lambda. That nothing was detected says nothing of the missed ones:
  it expects (1 - p) lambda, as in the PHD filter's update, D = (1 - p) D_predicted + detections. lambda is the mean
  of what those with a component expect. Where p is not declared it is 1: what is there is seen. One report is
  counted, not how many were silent before it.
* It has none, declares such a coverage, and has a component within the gate of one of the cell's: it did not miss the
  target, it has it elsewhere, and says nothing here. Not so where a third source has a component in both cells: then
  they are two targets, and the silence is of one of them.
* It has none, and declares no coverage: nothing.

Those that say something are the set S of the cell, with equal weights 1/|S|:

* aa: sum of D_i / |S|, each cell merged to one Gaussian with its mass and moments kept (Li-2nd 5, Li-AA (6)). What d
  of S deny keeps 1 - sum_d p_i / |S| of its mass.
* ga: prod D_i^(1/|S|), the power of a sum as the sum of the powers (Li-2nd (49)-(51)), the product taken within a cell
  only, as Li-2nd 5.2 advises for one target: uniform covariance intersection with a mass, that of the product at its
  peak over that of a density. Exact where cells are far apart. What d of S deny keeps prod_d (1 - p_i)^(1/|S|): nothing
  where one of them is certain. It loses mass as means lie apart, the more the more sources (docs/mixtures.md).
* hybrid (Li-2nd 5.2): the mass of aa at the place of ga, which those of S that have a component there give. With
  cardinality "consistent" the mass of all cells with one and the same S becomes the cardinality-consistent mean of the
  expected numbers lambda_i that the sources of S state in these cells (Uney (52)-(53), corrected: `fuse_poisson`).

Registration. All that source i reports is shifted by one and the same error of covariance R_i. In the picture's frame
its intensity is therefore D_i convolved with N(0, R_i): each P_c becomes P_c + R_i. Cells are found with these, and all
rules are of these; without R_i nothing changes. But the shift is common to neighbours, and their distance from each
other is as sure as before. So the fused covariance is kept in two parts: `covariance`, by which components are told
apart and merged, has no R in it, and `common` is what R adds. Their sum is the covariance of the place, and that is
what is published, and what tracks are followed with. Fused by gains W_i = P (P_i + R_i)^-1 / k with P the result of
covariance intersection, the parts are k sum W_i P_i W_i' and k sum W_i R_i W_i'; their sum is P itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import prod

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.centre.association import by_size, candidate_pairs, cluster, pair_distance, uniform_ci
from fusion_service.densities import Mixture, Mixtures, log_gaussian
from fusion_service.existence import fuse_poisson
from fusion_service.linalg import total

__all__ = [
    "Components",
    "Covering",
    "Stated",
    "cells_and_reach",
    "find_cells",
    "fuse_cells",
    "merge_near",
    "reduced",
]

Covering = Callable[[Floats], Bools]
"""Which of N sources declare a coverage that holds the means (n, M): (N, M)."""


@dataclass(frozen=True, slots=True, eq=False)
class Stated:
    """What N sources say of themselves: declared (N,): whether they declare a coverage; miss (N,): 1 less the
    detection probability in it; registration (n, n, N): covariance of the error common to all that one reports, None
    where nobody states one."""

    declared: Bools
    miss: Floats
    registration: Floats | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Components:
    """C weighted Gaussians: weight (C,) > 0, mean (n, C), covariance (n, n, C); share (N, C): how much of the weight
    came from each of N sources, with sum 1; common (n, n, C): what registration adds to the covariance, or None."""

    weight: Floats
    mean: Floats
    covariance: Floats
    share: Floats
    common: Floats | None = None

    def take(self, rows: NDArray[np.integer] | Bools) -> Components:
        """Those given."""
        common = None if self.common is None else self.common[:, :, rows]
        columns = self.weight[rows], self.mean[:, rows], self.covariance[:, :, rows], self.share[:, rows]
        return Components(*columns, common)

    @property
    def spread(self) -> Floats:
        """Covariance of the place in the picture's frame, registration included (n, n, C)."""
        return self.covariance if self.common is None else self.covariance + self.common

    @property
    def mass(self) -> float:
        """The expected number."""
        return float(total(self.weight)) if len(self.weight) else 0.0

    def sound(self) -> Bools:
        """Which are finite and positive definite (C,)."""
        finite = np.isfinite(self.weight) & np.isfinite(self.mean).all(axis=0)
        if self.common is not None:
            finite &= linalg.is_positive_definite(self.spread)
        return finite & linalg.is_positive_definite(self.covariance)

    def mixture(self) -> Mixture | None:
        """The intensity, None if there is nothing."""
        if not len(self.weight):
            return None
        return Mixture(self.weight, self.mean.T, self.spread.transpose(2, 0, 1))


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
    common = None if parts.common is None else mean_of(parts.common)
    return Components(weight, mean, covariance, mean_of(parts.share), common)


def reduced(parts: Components, prune: float, distance: float, most: int) -> Components:
    """Without weights below `prune`, `merge_near`, and of these the `most` heaviest; of more than twice as many only
    the heaviest are looked at. What is dropped is lost from the mass."""
    heaviest = np.argsort(-parts.weight, kind="stable")
    heaviest = heaviest[(parts.weight > 0)[heaviest] & (parts.weight >= prune)[heaviest]]
    merged = merge_near(parts.take(heaviest[: 2 * most]), distance)
    return merged.take(np.arange(min(most, len(merged.weight))))


def find_cells(parts: Components, source: Ints, places: list[int], gate: float) -> Ints:
    """The cell (C,) of each component, as by `cells_and_reach`, where no source states a registration error."""
    return cells_and_reach(parts, source, places, gate)[0]


def cells_and_reach(
    parts: Components, source: Ints, places: list[int], gate: float, registration: Floats | None = None
) -> tuple[Ints, Bools]:
    """The cell (C,) of each component, 0 ... M-1, and which sources (N, M) have a component in reach of one of the
    cell's, in another cell that may be the same target.

    source (C,): where a component comes from; places: the rows of its position; registration (n, n, N). Every two of a
    cell have d2 = (m_i - m_j)' (P_i + R_i + P_j + R_j)^-1 (m_i - m_j) within `gate`. Pairs are joined in the order of
    their overlap w_i w_j N(m_i; m_j, P_i + R_i + P_j + R_j), so that what is heavy and near finds its like first. Two
    cells in which one and the same source has a component are two targets.
    """
    covariance = parts.covariance if registration is None else parts.covariance + registration[:, :, source]
    sigma = np.sqrt(total(np.stack([covariance[place, place] for place in places])))
    i, j = candidate_pairs(parts.mean[places], sigma, float(np.sqrt(gate)), source)
    distance, spread = pair_distance(parts.mean, covariance, i, j)
    near, logs = distance <= gate, np.log(parts.weight)
    i, j, cost = i[near], j[near], (distance + spread - 2.0 * (logs[i] + logs[j]))[near]
    bits = np.array([1 << one for one in source.tolist()], dtype=np.int64 if source.max(initial=0) < 62 else object)
    root, _ = cluster(i, j, cost, bits, np.zeros(len(source), dtype=np.bool_))
    cell = np.asarray(np.unique(np.array(root, dtype=np.intp), return_inverse=True)[1])
    count = int(cell.max(initial=-1)) + 1
    present = np.zeros((len(parts.share), count), dtype=np.bool_)
    present[source, cell] = True
    reached = np.zeros_like(present)
    apart = np.flatnonzero(cell[i] != cell[j])
    for part in linalg.blocks(1, len(apart), len(present)):
        a, b = i[apart[part]], j[apart[part]]
        same = ~(present[:, cell[a]] & present[:, cell[b]]).any(axis=0)
        reached[source[b[same]], cell[a[same]]] = True
        reached[source[a[same]], cell[b[same]]] = True
    return cell, reached


def fuse_cells(
    rule: str,
    cardinality: str,
    parts: Components,
    source: Ints,
    cell: Ints,
    covering: Covering,
    stated: Stated | None = None,
    reached: Bools | None = None,
) -> Components:
    """The fused intensity: a component per cell, by rule "aa", "ga" or "hybrid", the last with cardinality "average"
    or "consistent". cell (C,) and reached (N, M) as of `cells_and_reach`; stated: by default every source declares
    its coverage and sees what is in it. What has no weight left is left out."""
    sources, count = len(parts.share), int(cell.max(initial=-1)) + 1
    weight = np.zeros((sources, count))
    weight[source, cell] = parts.weight
    if stated is None:
        stated = Stated(np.ones(sources, dtype=np.bool_), np.zeros(sources))
    heard, silent, counted = _voices(weight > 0, covering(_merged(parts, cell).mean), stated.declared, reached)
    number, voices = counted.sum(axis=0), heard.sum(axis=0)
    expected = total(np.where(heard, weight, 0.0)) / voices
    said = np.where(silent, stated.miss[:, None] * expected, np.where(heard & counted, weight, 0.0))
    mass = total(said) / number
    if rule == "hybrid" and cardinality == "consistent":
        mass = mass * _consistency(said, counted)
    if rule == "ga":
        with np.errstate(divide="ignore"):
            missed = np.log(stated.miss)[:, None]
        left = np.exp(total(np.where(silent, missed, 0.0)) / number)
        mass, share = np.where(left > 0, mass, 0.0), heard / voices
    else:
        share = np.where(heard, weight, 0.0) / (expected * voices)
    n = len(parts.mean)
    mean, covariance = np.zeros((n, count)), np.zeros((n, n, count))
    common = None if stated.registration is None else np.zeros((n, n, count))
    used = np.flatnonzero(heard[source, cell] & (mass[cell] > 0))
    for ids, groups in by_size(cell[used]):
        rows = used[groups].T
        logs, means, covariances = np.log(parts.weight[rows]), parts.mean[:, rows], parts.covariance[:, :, rows]
        shift = None if stated.registration is None else stated.registration[:, :, source[rows]]
        if rule == "aa":
            mean[:, ids], covariance[:, :, ids] = Mixtures(logs, means, covariances).moments()
            if common is not None and shift is not None:
                part = np.exp(logs) / total(np.exp(logs))
                common[:, :, ids] = total(np.moveaxis(part * shift, 2, 0))
            continue
        wide = covariances if shift is None else covariances + shift
        x, P = uniform_ci(np.moveaxis(means, 1, 0), np.moveaxis(wide, 2, 0))
        mean[:, ids], covariance[:, :, ids] = x, P
        if common is not None and shift is not None:
            covariance[:, :, ids], common[:, :, ids] = (_carried(P, wide, of) for of in (covariances, shift))
        if rule == "ga":
            parts_there = logs + log_gaussian(x[:, None] - means, *linalg.ldl(wide))
            peak = total(parts_there) / len(rows) - log_gaussian(np.zeros_like(x), *linalg.ldl(P))
            mass[ids] = left[ids] * np.exp(peak)
    return Components(mass, mean, linalg.symmetrise(covariance), share, common).take(~(mass <= 0))


def _voices(present: Bools, cover: Bools, declared: Bools, reached: Bools | None) -> tuple[Bools, Bools, Bools]:
    """Of each cell, (N, M): the sources whose components make it up, those that deny it, and the set S."""
    deny = cover & ~present
    if reached is not None:
        deny &= ~reached
    counted = deny | (present & (cover | ~declared[:, None]))
    counted = np.where(counted.any(axis=0), counted, present)
    heard = present & counted
    return np.where(heard.any(axis=0), heard, present), deny, counted


def _carried(P: Floats, wide: Floats, of: Floats) -> Floats:
    """k sum W_i Q_i W_i', W_i = P wide_i^-1 / k: (n, n, B) for P (n, n, B), wide and Q = `of` (n, n, k, B)."""
    gains = [linalg.product(P, linalg.inverse(wide[:, :, i])) for i in range(wide.shape[2])]
    parts = [linalg.congruence(W, of[:, :, i]) for i, W in enumerate(gains)]
    return np.asarray(total(np.stack(parts)) / len(parts))


def _consistency(said: Floats, counted: Bools) -> Floats:
    """For each cell (M,), the consistent number of all cells that have the same S, relative to the average."""
    patterns, region = np.unique(counted, axis=1, return_inverse=True)
    factor = np.zeros(counted.shape[1])
    for index in range(patterns.shape[1]):
        at = np.asarray(region).reshape(-1) == index
        rates = total(said[patterns[:, index]][:, at].T)
        factor[at] = fuse_poisson(rates) / fuse_poisson(rates, "average") if rates.any() else 0.0
    return factor
