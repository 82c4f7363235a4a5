"""Scores of the sonobuoys' tracks and of what is fused of them: by layout, or all layouts together. Errors are those of
`sonobuoys.fly`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from studies import sonobuoys
from studies.sonobuoys import KNOT, STEPS, Scenario
from studies.study import Floats

__all__ = ["Stats", "averages", "bounds", "curve", "distances", "errors", "gathered", "lost", "over"]

BAD = 1000.0**2
"""Squared error of a run that has diverged, m^2."""


class Stats(dict[str, Floats]):
    """By label: squared position error (m^2), squared velocity error ((m/s)^2) and NEES, (3, K, L, R), of K steps, L
    layouts and R runs in each; "weights LABEL": (K, N, L, R)."""


def errors(true: Floats, mean: Floats, covariance: Floats) -> Floats:
    """(3, K, M) of states (K, n, M) and covariances (K, n, n, M)."""
    e = np.moveaxis(mean - true, 1, 0)
    nees = linalg.quadratic(np.moveaxis(covariance, 0, 2), e)
    return np.stack([e[0] ** 2 + e[1] ** 2, e[2] ** 2 + e[3] ** 2, nees])


def gathered(parts: Sequence[Stats]) -> Stats:
    """The layouts of all parts together."""
    return Stats({key: np.concatenate([part[key] for part in parts], axis=2) for key in parts[0]})


def lost(stats: Floats, at_end: bool = True) -> NDArray[np.bool_]:
    """Whether a run (L, R) is more than 1 km off at the end, or ever; or has broken down on the way."""
    position = stats[0]
    here = position[-1:] if at_end else position
    return np.asarray((here > BAD).any(axis=0) | np.isnan(position).any(axis=0))


def averages(stats: Floats, steps: slice = slice(None)) -> Floats:
    """ARMSE of position (m) and velocity (knots), and mean NEES, (3, L), each layout on its own, without lost runs."""
    kept = ~lost(stats)
    mean = np.where(kept, stats[:, steps], 0.0).sum(axis=-1) / kept.sum(axis=-1)
    return np.stack([np.sqrt(mean[0]).mean(axis=0), np.sqrt(mean[1]).mean(axis=0) / KNOT, mean[2].mean(axis=0)])


def over(values: Floats) -> tuple[float, float]:
    """Mean over layouts (L,) and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def distances(scenario: Scenario, every: int) -> Floats:
    """From the noiseless path to the middles of the sub-regions, (K, N), m, at one step in `every`."""
    x, path = scenario.state(), []
    for _ in range(STEPS + 1):
        path.append(x[:2])
        x = sonobuoys.move(x)
    away = np.array(path)[every // 2 :: every, :, None] - sonobuoys.centres()
    return np.asarray(np.hypot(away[:, 0], away[:, 1]))


def bounds(n: int, runs: int) -> tuple[float, float]:
    """(34), (35): 95 % of the mean NEES of so many runs lies between them."""
    low, high = (n * (1 - 2 / (9 * n * runs) + s * 1.96 * np.sqrt(2 / (9 * n * runs))) ** 3 for s in (-1, 1))
    return float(low), float(high)


def curve(stats: Floats) -> Floats:
    """(3, K): RMSE of position (m) and velocity (knots), ANEES, of all layouts together, without lost runs."""
    mean = stats[:, :, ~lost(stats)].mean(axis=-1)
    return np.stack([np.sqrt(mean[0]), np.sqrt(mean[1]) / KNOT, mean[2]])
