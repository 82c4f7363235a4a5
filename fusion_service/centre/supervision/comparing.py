"""What the sources say of the targets that they share in one step, in the form that the estimate takes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Floats, Ints, picked
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.supervision.bias import design
from fusion_service.centre.supervision.estimate import Group, inverse_2x2
from fusion_service.centre.supervision.lasting import Lasting
from fusion_service.centre.tracks import Tracks

__all__ = ["MOST_TARGETS", "Compared", "Treated", "chosen_rows", "compared", "labels"]

MOST_TARGETS = 48
"""Shared targets that are looked at in a step; of more those whose turn it is, for some time in a row."""
TURN = 64
"""Steps."""
LARGEST = 1e8
"""m, m/s, m2."""
FINEST = 1e-4
"""m2: no place is taken for better known."""


@dataclass(frozen=True, slots=True, eq=False)
class Treated:
    """How the sources of the estimate (S,) stand, and what is taken off their rows already: site (2, S); value (S, 7);
    common (S, 7, 7), what was added to the covariances of all their rows for it; shift (2, 2, S) likewise, as stated.
    """

    site: Floats
    value: Floats
    common: Floats
    shift: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """M rows of G targets, in order of (target, row). row (M,): index into the step's rows; group: their weights are
    the inverses of `own` (2, 2, M), m2, the errors of their own; velocity (2, G) and place (2, G) of the targets."""

    row: Ints
    group: Group
    own: Floats
    place: Floats
    velocity: Floats


def labels(rows: Rows, same: Mapping[int, int]) -> NDArray[np.uint64]:
    """The target of each row (M,): the global track it is linked to, or that which this is the `same` as; 0: none."""
    if not same:
        return rows.tracks.link
    old = np.array(sorted(same), dtype=np.uint64)
    new = np.array([same[one] for one in old.tolist()], dtype=np.uint64)
    at = np.minimum(np.searchsorted(old, rows.tracks.link), len(old) - 1)
    return np.where(old[at] == rows.tracks.link, new[at], rows.tracks.link)


def chosen_rows(rows: Rows, label: NDArray[np.uint64], now: Picture, whose: Ints, lasting: Lasting, step: int) -> Ints:
    """Rows that are compared in this step, in order of (target, row): versions not used yet, of targets that two of
    the sources of the estimate or more tell something new of. whose (N,): the number of each source there, or -1."""
    mine = np.flatnonzero((label != NO_TRACK) & (whose[rows.source] >= 0))
    if not len(mine) or not len(now.id):
        return mine[:0]
    at = np.minimum(now.find(label[mine]), len(now.id) - 1)
    mine = mine[(now.id[at] == label[mine]) & (now.time[at] >= 0) & _plausible(rows.tracks, mine) & _plausible(now, at)]
    target, group, count = np.unique(label[mine], return_inverse=True, return_counts=True)
    new = np.bincount(group[rows.fresh[mine]], minlength=len(target)) > 0
    some = np.flatnonzero((count > 1) & new)
    every = -(-len(some) // MOST_TARGETS)
    if every > 1:
        turn = np.uint64((step // TURN) % every)
        some = some[target[some] % np.uint64(every) == turn][: 2 * MOST_TARGETS]
    taken = np.zeros(len(target), dtype=np.bool_)
    taken[some] = True
    mine = mine[taken[group]]
    tracks = rows.tracks
    mine = mine[lasting.unused(whose[rows.source[mine]], tracks.id[mine], tracks.updated[mine])]
    order = np.lexsort((mine, rows.source[mine], label[mine]))
    mine = mine[order]
    double = np.zeros(len(mine), dtype=np.bool_)
    double[1:] = (label[mine][1:] == label[mine][:-1]) & (rows.source[mine][1:] == rows.source[mine][:-1])
    mine = mine[~double]
    _, group, count = np.unique(label[mine], return_inverse=True, return_counts=True)
    return np.asarray(mine[count[group] > 1])


def _plausible(tracks: Tracks | Picture, at: Ints) -> Bools:
    """Which states (K,) are near enough, slow enough and known well enough to be compared."""
    state = np.abs(picked(tracks.mean, at)).max(axis=0, initial=0.0) < LARGEST
    variance = tracks.covariance[0, 0, at] + tracks.covariance[1, 1, at]
    return np.asarray(state & (variance < LARGEST))


def compared(
    rows: Rows, row: Ints, label: NDArray[np.uint64], now: Picture, whose: Ints, how: Treated,
    space: tuple[str, ...],
) -> Compared:  # fmt: skip
    """The rows as observations of the errors of their sources, linear about what is taken off them already."""
    source = whose[rows.source[row]]
    ids, start, group = np.unique(label[row], return_index=True, return_inverse=True)
    at = now.find(ids)
    place = now.mean[[space.index("x"), space.index("y")]][:, at]
    velocity = np.zeros_like(place)
    if "vx" in space and "vy" in space:
        v = [space.index("vx"), space.index("vy")]
        velocity = _calibrated(now.mean[v][:, at], sum(now.covariance[k, k, at] for k in v))
    H = design(place[:, group], velocity[:, group], how.site[:, source])
    xy = [space.index("x"), space.index("y")]
    value = how.value[source]
    z = rows.tracks.mean[xy][:, row] - place[:, group]
    z = z + sum(H[:, k] * value[:, k] for k in range(value.shape[1]))
    own = picked(rows.tracks.covariance[np.ix_(xy, xy)], row)
    if how.common.any() or how.shift.any():
        own = _own(own, H, how.common[source], how.shift[..., source])
    own = own + FINEST * np.eye(2)[:, :, None]
    made = Group(source, group, start, H, z, inverse_2x2(own))
    return Compared(row, made, own, place, velocity)


def _calibrated(velocity: Floats, noise: Floats) -> Floats:
    """Velocities (2, G) as they are to be expected of targets whose own differ by no more than they seem to: noise (G,)
    in what an error is multiplied by would tell a clock from a shift where nothing does (regression calibration)."""
    if velocity.shape[1] < 2:
        return velocity
    mean = velocity.mean(axis=1, keepdims=True)
    apart = velocity - mean
    own = max(float((apart**2).sum()) / (velocity.shape[1] - 1) - float(noise.mean()), 0.0)
    return np.asarray(mean + apart * (own / (own + noise)))


def _own(spread: Floats, H: Floats, common: Floats, shift: Floats) -> Floats:
    """Covariances (2, 2, M) less what all rows of a source have in common; not less than a hundredth of them."""
    part = np.zeros_like(spread)
    for i in (0, 1):
        along = sum(H[i, k] * common[:, k].T for k in range(H.shape[1]))
        for j in (0, 1):
            part[i, j] = sum(along[m] * H[j, m] for m in range(H.shape[1]))
    part = 0.5 * (part + part.transpose(1, 0, 2)) + shift
    less = spread - part
    sound = (less[0, 0] > 0.01 * spread[0, 0]) & (less[1, 1] > 0.01 * spread[1, 1])
    sound &= less[0, 0] * less[1, 1] - less[0, 1] ** 2 > 1e-4 * (spread[0, 0] * spread[1, 1] - spread[0, 1] ** 2)
    return np.where(sound, less, spread)
