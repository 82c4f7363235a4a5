"""Is a reported covariance honest? Moments of errors and covariances over groups of Monte Carlo runs, the largest
eigenvalue of the one relative to the other, and both drawn as ellipses.

    MSE = E e e',    excess = largest eigenvalue of C^-1 MSE C^-T,    E P = C C'

Conservative means excess <= 1: no direction in which the error is larger than reported. Where the reported covariance
depends on the data (HMD-GA, AA, CU) its mean stands for it, as in Sharma's figures.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from studies import correlation
from studies.pictures import colour, ellipse
from studies.statistics import Estimate, jackknife, mean
from studies.study import Floats, Row

__all__ = ["GROUPS", "Chance", "Consistency", "by_chance", "consistency", "draw", "excess", "moments", "rows"]

GROUPS = 50


class Consistency(NamedTuple):
    """Traces of reported and true covariance, `excess`, and both matrices (n, n)."""

    reported: Estimate
    true: Estimate
    excess: Estimate
    covariance: Floats
    mse: Floats


def moments(errors: Floats, covariances: Floats, groups: int = GROUPS) -> Floats:
    """Means of e e' and of P over each of `groups` groups of runs (2, n, n, G), from errors (n, M) and P (n, n, M);
    G = M where there are fewer runs."""
    parts = np.array_split(np.arange(errors.shape[1]), min(groups, errors.shape[1]))
    squares = [errors[:, part] @ errors[:, part].T / len(part) for part in parts]
    reported = [covariances[..., part].mean(axis=-1) for part in parts]
    return np.stack([np.stack(squares, axis=-1), np.stack(reported, axis=-1)])


def excess(blocks: Floats) -> float:
    """Largest eigenvalue of the MSE relative to the mean reported covariance, of `moments`."""
    mse, P = blocks.mean(axis=-1)
    return float(correlation.excess(mse, P))


def consistency(blocks: Floats) -> Consistency:
    """What `moments` say, with errors over the groups (0 of a covariance that no chance is in)."""
    mse, P = blocks.mean(axis=-1)
    true, reported = (mean(np.trace(part)) for part in blocks)
    if reported.stderr < 1e-9 * reported.value:
        reported = Estimate(reported.value, 0.0)
    return Consistency(reported, true, jackknife(excess, blocks, blocks.shape[-1]), P, mse)


class Chance(NamedTuple):
    """What an honest filter shows: its `excess` (times,) in so many repetitions; worth: how many independent errors the
    steps of one run are worth, as far as mean squares go."""

    excess: Floats
    worth: float


def by_chance(A: Floats, P: Floats, steps: int, runs: int, rng: np.random.Generator, times: int = 100) -> Chance:
    """The excess over `runs` runs of `steps` steps of errors e' = A e + w that have the covariance P all along.

    Mean squares of W e, P^-1 = W' W, whose correlation over k steps is W A^k W^-1, scatter as those of
    steps / (1 + 2 sum_k (1 - k / steps) |W A^k W^-1|^2 / n) independent ones.
    """
    n = len(P)
    L = np.linalg.cholesky(P)
    values, V = np.linalg.eigh(P - A @ P @ A.T)
    noise = V * np.sqrt(np.maximum(values, 0.0))
    found = []
    for _ in range(times):
        e = L @ rng.standard_normal((n, runs))
        square = np.zeros((n, n))
        for _ in range(steps):
            e = A @ e + noise @ rng.standard_normal((n, runs))
            square += e @ e.T / (runs * steps)
        found.append(float(correlation.excess(square, P)))
    between, power, lost = np.linalg.solve(L, A @ L), np.eye(n), 0.0
    for k in range(1, steps):
        power = power @ between
        lost += 2.0 * (1.0 - k / steps) * float((power**2).sum()) / n
    return Chance(np.array(found), steps / (1.0 + lost))


def rows(name: str, one: Consistency, where: str = "") -> list[Row]:
    """Reported and true trace and the excess of rule `name`; `where` begins the quantities' names."""
    quantities = (("trace reported", one.reported), ("trace true", one.true), ("excess", one.excess))
    return [Row(name, where + quantity, None, value, stderr or None) for quantity, (value, stderr) in quantities]


def draw(figure: Any, shown: Mapping[str, Consistency], title: str, columns: int = 6) -> None:
    """One panel a rule: 86.5 % ellipses, reported solid, true dashed, on a grey one, the first rule's true one. A rule
    too sure of itself in some direction is named in red; what reports far more than the others is cut off."""
    count = len(shown)
    panels = figure.subplots(-(-count // columns), columns, sharex=True, sharey=True, squeeze=False).ravel()
    reach = np.sort([2 * np.sqrt(max(one.covariance.max(), one.mse.max())) for one in shown.values()])
    limit = 1.08 * np.max(reach, where=reach <= 1.8 * np.nanmedian(reach), initial=0.0)
    reference = ellipse(np.zeros(2), next(iter(shown.values())).mse)
    for axes, (label, one) in zip(panels, shown.items(), strict=False):
        axes.fill(*reference, color="#d4d4d4", zorder=0)
        axes.plot(*ellipse(np.zeros(2), one.covariance), color=colour(label), linewidth=1.6)
        axes.plot(*ellipse(np.zeros(2), one.mse), color="#000000", linewidth=1.1, linestyle=(0, (4, 2)))
        rule, _, options = label.partition(":")
        unsure = one.excess.value - 1 > 3 * one.excess.stderr + 1e-9
        axes.set_title(f"{rule}\n{options}\nexcess {one.excess.value:.2f}", fontsize=8)
        axes.title.set_color("#b2182b" if unsure else "#000000")
        axes.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
        axes.tick_params(labelsize=7)
    for axes in panels[count:]:
        axes.set_axis_off()
    figure.supxlabel("error of the first component", fontsize=9)
    figure.supylabel("error of the second component", fontsize=9)
    figure.suptitle(title, fontsize=10)
