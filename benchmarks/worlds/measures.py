"""What a picture is worth when the truth is known, over the steps of a world.

A confirmed track is near a target closer than the cutoff c. GOSPA has p = 2, alpha = 2. For ids, switches and leaps a
target keeps the track of the step before as long as that is near, and the rest is assigned as GOSPA does (the
correspondence of CLEAR MOT, Bernardin, Stiefelhagen, 2008): where targets cross or stand close, the assignment of one
step alone changes by noise. A track follows the target that it had last, or, where it never had one, that it was
nearest to first.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.metrics import gospa, identity_switches

__all__ = ["Picture", "Scores", "average", "correspondence", "impure", "score"]

Floats = NDArray[np.float64]


class Picture(NamedTuple):
    """The confirmed tracks of one step: id (M,), place (M, 2), m, and its covariance (M, 2, 2)."""

    id: NDArray[np.uint64]
    place: Floats
    covariance: Floats


@dataclass(frozen=True, slots=True)
class Scores:
    """ids: distinct ids that followed a target over the run, mean and worst over targets; nearest: distinct ids that
    were the nearest to it, and near. switches: how often a target's id was another than its last. gospa and its parts:
    means over steps, m and m2. duplicates: mean number of confirmed tracks near a target that are not assigned to one.
    ghosts: mean number near no target. leap: the largest sqrt(e' P^-1 e) of a confirmed track from the target that it
    followed. confirmed: distinct ids in all."""

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
    nearest_mean: float
    nearest_worst: float


def score(truth: Sequence[Floats] | Floats, pictures: Iterable[Picture], cutoff: float) -> Scores:
    """Scores of pictures against `truth`, (T, 2) for each step, NaN where a target is not there; cutoff c, m."""
    targets = len(truth[0])
    nearest: list[set[int]] = [set() for _ in range(targets)]
    had: list[set[int]] = [set() for _ in range(targets)]
    history: list[dict[int, int]] = []
    parts: list[tuple[float, ...]] = []
    follows: dict[int, int] = {}
    leap, everyone, last = 0.0, set[int](), dict[int, int]()
    for there, picture in zip(truth, pictures, strict=True):
        ids = picture.id.tolist()
        everyone.update(ids)
        leap = max(leap, _leap(there, picture, follows, cutoff))
        gap = np.linalg.norm(there[:, None] - picture.place[None], axis=2)
        near = gap < cutoff  # NaN is not near
        present = np.isfinite(there[:, 0])
        found = gospa(there[present], picture.place, cutoff)
        covered = int(near.any(axis=0).sum())
        parts.append((*found[:4], covered - int((found.assignment >= 0).sum()), len(ids) - covered))
        last = correspondence(last, there, picture, cutoff)
        history.append(last)
        gap = np.where(near, gap, np.inf)
        for target in np.flatnonzero(near.any(axis=1)).tolist():
            nearest[target].add(ids[int(gap[target].argmin())])
        follows.update({one: target for target, one in last.items()})
        for track in np.flatnonzero(near.any(axis=0)).tolist():
            follows.setdefault(ids[track], int(gap[:, track].argmin()))
        for one in ids:
            if one in follows:
                had[follows[one]].add(one)
    means = np.mean(parts, axis=0).tolist()
    counts, closest = ([len(one) for one in sets] for sets in (had, nearest))
    gospa_mean, localisation, missed, false, duplicates, ghosts = means
    return Scores(
        ids_mean=float(np.mean(counts)),
        ids_worst=max(counts),
        switches=identity_switches(history),
        gospa=gospa_mean,
        localisation=localisation,
        missed=missed,
        false=false,
        duplicates=duplicates,
        ghosts=ghosts,
        leap=leap,
        confirmed=len(everyone),
        nearest_mean=float(np.mean(closest)),
        nearest_worst=max(closest),
    )


def correspondence(last: Mapping[int, int], there: Floats, picture: Picture, cutoff: float) -> dict[int, int]:
    """Target -> id at one step: as in the step before, `last`, where both are there and near; the rest by GOSPA."""
    ids = picture.id.tolist()
    row = {one: j for j, one in enumerate(ids)}
    kept = {
        target: one
        for target, one in last.items()
        if one in row and np.linalg.norm(there[target] - picture.place[row[one]]) < cutoff
    }
    taken = {row[one] for one in kept.values()}
    left = [t for t in np.flatnonzero(np.isfinite(there[:, 0])).tolist() if t not in kept]
    free = [j for j in range(len(ids)) if j not in taken]
    found = gospa(there[left], picture.place[free], cutoff).assignment.tolist()
    return kept | {t: ids[free[j]] for t, j in zip(left, found, strict=True) if j >= 0}


def _leap(there: Floats, picture: Picture, follows: Mapping[int, int], cutoff: float) -> float:
    """The largest error, in stated sigmas, of tracks from the target that they follow or, if less, from one near that:
    in a formation nobody can tell which of two it is. Of targets that are there."""
    rows = [j for j, one in enumerate(picture.id.tolist()) if one in follows]
    followed = there[[follows[one] for one in picture.id[rows].tolist()]]
    error = picture.place[rows][:, None] - there[None]
    near = np.linalg.norm(followed[:, None] - there[None], axis=2) < cutoff
    track, target = np.nonzero(near)
    solved = np.linalg.solve(picture.covariance[rows][track], error[track, target][..., None])[..., 0]
    square = np.full(near.shape, np.inf)
    square[track, target] = (error[track, target] * solved).sum(axis=1)
    least = square.min(axis=1, initial=np.inf)
    return float(np.sqrt(least[np.isfinite(least)].max(initial=0.0)))


def impure(groups: Iterable[Sequence[int]]) -> int:
    """How many global tracks have contributors of different targets; each group the targets of one's contributors."""
    return sum(len(set(group)) > 1 for group in groups)


def average(runs: Sequence[Scores]) -> Scores:
    """Over runs: the worst of what is a worst or a leap, the mean of the rest."""
    columns = {name: [getattr(run, name) for run in runs] for name in asdict(runs[0])}
    worst = ("ids_worst", "nearest_worst", "leap")
    return Scores(**{name: float(max(c) if name in worst else np.mean(c)) for name, c in columns.items()})
