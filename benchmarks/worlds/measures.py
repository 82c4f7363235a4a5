"""What a picture is worth when the truth is known, over the steps of a world.

A confirmed track is near a target closer than the cutoff c. Assignments are those of GOSPA (p = 2, alpha = 2, cut off at
c). A track follows the target that it was assigned to last, or, where it has none, that it was nearest to.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.metrics import gospa, identity_switches

__all__ = ["Picture", "Scores", "average", "impure", "score"]

Floats = NDArray[np.float64]


class Picture(NamedTuple):
    """The confirmed tracks of one step: id (M,), place (M, 2), m, and its covariance (M, 2, 2)."""

    id: NDArray[np.uint64]
    place: Floats
    covariance: Floats


@dataclass(frozen=True, slots=True)
class Scores:
    """ids: distinct ids nearest to a target, and near it, over the run: mean and worst over targets. switches: how often
    a target's assigned id was another than its last. gospa and its parts: means over steps, m and m2. duplicates: mean
    number of confirmed tracks near a target that are not assigned to one. ghosts: mean number near no target. leap: the
    largest sqrt(e' P^-1 e) of a confirmed track from the target that it followed. confirmed: distinct ids in all."""

    ids_mean: float
    ids_worst: float
    switches: float
    gospa: float
    localisation: float
    missed: float
    false: float
    duplicates: float
    ghosts: float
    leap: float
    confirmed: float


def score(truth: Sequence[Floats] | Floats, pictures: Iterable[Picture], cutoff: float) -> Scores:
    """Scores of pictures against `truth`, (T, 2) for each step, NaN where a target is not there; cutoff c, m."""
    nearest: list[set[int]] = [set() for _ in range(len(truth[0]))]
    assigned: list[dict[int, int]] = []
    parts: list[tuple[float, ...]] = []
    follows: dict[int, int] = {}
    leap, everyone = 0.0, set()
    for there, picture in zip(truth, pictures, strict=True):
        targets = np.flatnonzero(np.isfinite(there[:, 0]))
        ids = picture.id.tolist()
        everyone.update(ids)
        leap = max(leap, _leap(there, picture, follows))
        found = gospa(there[targets], picture.place, cutoff)
        pairs = [(int(targets[i]), j) for i, j in enumerate(found.assignment.tolist()) if j >= 0]
        gap = np.linalg.norm(there[targets][:, None] - picture.place[None], axis=2)
        near = gap < cutoff
        if len(ids) and len(targets):
            closest = gap.argmin(axis=1)
            for i in np.flatnonzero(near.any(axis=1)).tolist():
                nearest[targets[i]].add(ids[closest[i]])
            followed = targets[gap.argmin(axis=0)]
            taken = {j for _, j in pairs}
            for j in np.flatnonzero(near.any(axis=0)).tolist():
                if j not in taken:
                    follows.setdefault(ids[j], int(followed[j]))
        follows.update({ids[j]: target for target, j in pairs})
        assigned.append({target: ids[j] for target, j in pairs})
        covered = int(near.any(axis=0).sum()) if len(targets) else 0
        parts.append((*found[:4], covered - len(pairs), len(ids) - covered))
    mean = np.mean(parts, axis=0).tolist()
    counts = [len(one) for one in nearest]
    return Scores(
        float(np.mean(counts)), max(counts), identity_switches(assigned), *mean[:4], mean[4], mean[5], leap, len(everyone)
    )  # fmt: skip


def _leap(there: Floats, picture: Picture, follows: Mapping[int, int]) -> float:
    """The largest error, in stated sigmas, of the tracks that follow a target which is still there."""
    rows = [j for j, one in enumerate(picture.id.tolist()) if one in follows]
    if not rows:
        return 0.0
    error = picture.place[rows] - there[[follows[one] for one in picture.id[rows].tolist()]]
    known = np.isfinite(error[:, 0])
    solved = np.linalg.solve(picture.covariance[rows][known], error[known][..., None])[..., 0]
    square = (error[known] * solved).sum(axis=1)
    return float(np.sqrt(square.max(initial=0.0)))


def impure(groups: Iterable[Sequence[int]]) -> int:
    """How many global tracks have contributors of different targets; each group the targets of one's contributors."""
    return sum(len(set(group)) > 1 for group in groups)


def average(runs: Sequence[Scores]) -> Scores:
    """Over runs: the worst of `ids_worst` and `leap`, the mean of the rest."""
    columns = {name: [getattr(run, name) for run in runs] for name in asdict(runs[0])}
    worst = ("ids_worst", "leap")
    return Scores(**{name: float(max(c) if name in worst else np.mean(c)) for name, c in columns.items()})
