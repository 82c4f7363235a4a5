"""What the local tracks of one global track say together, and what each of them says of the others.

The fusion here is covariance intersection with equal weights: it decides nothing but who agrees with whom, so it need
not be the rule of the picture, and it promises to be conservative whatever the correlation of the sources.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Floats, Ints, filled, marked, picked
from fusion_service.centre.association import SOUND as SOUND_ALONE
from fusion_service.centre.association import by_size, uniform_ci
from fusion_service.compiled.either import FAST

__all__ = ["Consensus", "consensus"]

SOUND = 1e-8
"""Least pivot, relative to its variance, of an information matrix that is inverted; below, `uniform_ci` decides."""


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """Of M rows in G groups: mean (n, G) and covariance (n, n, G) of all rows of each group; others_mean (n, M) and
    others_covariance (n, n, M) of the group without the row (NaN where it is alone); size (M,) of its group; groups:
    rows (g, k) of the groups of each size k (left empty where some were made anew)."""

    labels: NDArray[np.uint64]
    mean: Floats
    covariance: Floats
    others_mean: Floats
    others_covariance: Floats
    size: Ints
    groups: list[Ints]


def consensus(labels: NDArray[np.uint64], means: Floats, covariances: Floats) -> Consensus:
    """Of rows (n, M), (n, n, M) with labels (M,). Groups come in the order of their label.

    All but one: sums of information from the left and from the right of each row, so N rows cost 2 N sums and not N^2.
    """
    count = means.shape[1]
    sized = list(by_size(labels))
    partner, size = filled(count, -1, np.intp), np.ones(count, dtype=np.intp)
    more: list[tuple[Ints, Floats, Floats]] = []
    compiled = "intersect" in FAST
    blank = np.nan, np.float64
    others = (filled(means.shape, *blank), filled(covariances.shape, *blank)) if compiled else None
    parts: list[tuple[Floats, Floats]] = [(means[:, :0], covariances[..., :0])]
    for _, rows in sized:
        k = rows.shape[1]
        size[rows] = k
        columns = [rows[:, j] for j in range(k)]
        if k > 1 and others is not None:
            parts.append(_compiled(rows, means, covariances, *others))
            continue
        xs, Ps = [picked(means, one) for one in columns], [picked(covariances, one) for one in columns]
        if k == 1:
            parts.append((xs[0], Ps[0]))
        elif k == 2:
            parts.append(uniform_ci(np.stack(xs), np.stack(Ps)))
            partner[columns[0]], partner[columns[1]] = columns[1], columns[0]
        else:
            whole, without = _all_but_one(xs, Ps)
            parts.append(whole)
            more += [(one, *other) for one, other in zip(columns, without, strict=True)]
    if others is None:
        others = _partners(partner, means, covariances)
    for one, x, P in more:
        others[0][:, one], others[1][:, :, one] = x, P
    groups = [rows for _, rows in sized]
    if len(sized) == 1:
        unique, (mean, covariance) = sized[0][0], parts[1]
    else:
        unique = np.concatenate([labels[:0], *(names for names, _ in sized)])
        order = np.argsort(unique)
        unique = unique[order]
        mean, covariance = (np.concatenate(part, axis=-1).take(order, axis=-1) for part in zip(*parts, strict=True))
    return Consensus(unique, mean, covariance, others[0], others[1], size, groups)


def _partners(partner: Ints, means: Floats, covariances: Floats) -> tuple[Floats, Floats]:
    """Means and covariances of the rows `partner` (M,), NaN for -1."""
    alone = marked(partner < 0)
    if len(alone) == len(partner):
        return np.full(means.shape, np.nan), np.full(covariances.shape, np.nan)
    mean, covariance = means.take(partner, axis=-1), covariances.take(partner, axis=-1)
    mean[:, alone], covariance[:, :, alone] = np.nan, np.nan
    return mean, covariance


def _compiled(
    rows: Ints, means: Floats, covariances: Floats, others_mean: Floats, others_covariance: Floats
) -> tuple[Floats, Floats]:
    """Mean (n, G) and covariance (n, n, G) of groups `rows` (G, k), k >= 2, by the compiled kernel; those of the others
    of each row are written into the last two."""
    k = rows.shape[1]
    x, P, margin, beside = FAST["intersect"](means, covariances, rows, (others_mean, others_covariance))
    bad = marked(~(margin > (SOUND_ALONE if k == 2 else SOUND)))
    if len(bad):
        x[:, bad], P[:, :, bad] = _of_groups(rows[bad], means, covariances)
    for j in range(k if k > 2 else 0):
        at = rows[~(beside[rows[:, j]] > SOUND)]
        if len(at):
            one = at[:, j]
            others_mean[:, one], others_covariance[:, :, one] = _of_groups(np.delete(at, j, 1), means, covariances)
    return x, P


def _of_groups(rows: Ints, means: Floats, covariances: Floats) -> tuple[Floats, Floats]:
    """`uniform_ci` of groups (G, k)."""
    return uniform_ci(
        np.ascontiguousarray(np.moveaxis(means[:, rows], 2, 0)),
        np.ascontiguousarray(np.moveaxis(covariances[:, :, rows], 3, 0)),
    )


def _all_but_one(xs: list[Floats], Ps: list[Floats]) -> tuple[tuple[Floats, Floats], list[tuple[Floats, Floats]]]:
    """Fusion of all k rows of B groups, and of all but each."""
    k, count = len(xs), xs[0].shape[1]
    inverse, _, margins = linalg.sweep(np.concatenate(Ps, axis=2))
    vector = linalg.matvec(inverse, np.concatenate(xs, axis=1))
    each = [slice(j * count, (j + 1) * count) for j in range(k)]
    least = margins[each[0]]
    for part in each[1:]:
        least = np.minimum(least, margins[part])
    information, vectors = [inverse[..., part] for part in each], [vector[:, part] for part in each]
    right: list[tuple[Floats, Floats] | None] = [None] * k
    for j in range(k - 1, 0, -1):
        after = right[j] if j < k - 1 else None
        now = (information[j], vectors[j])
        right[j - 1] = now if after is None else (after[0] + now[0], after[1] + now[1])
    left: tuple[Floats, Floats] | None = None
    sums = []
    for j in range(k):
        parts = [part for part in (left, right[j]) if part is not None]
        sums.append(parts[0] if len(parts) == 1 else (parts[0][0] + parts[1][0], parts[0][1] + parts[1][1]))
        left = (information[j], vectors[j]) if left is None else (left[0] + information[j], left[1] + vectors[j])
    assert left is not None
    return _inverted([*sums, left], least, xs, Ps)


def _inverted(
    sums: list[tuple[Floats, Floats]], least: Floats, xs: list[Floats], Ps: list[Floats]
) -> tuple[tuple[Floats, Floats], list[tuple[Floats, Floats]]]:
    """Means and covariances of equal-weight intersections of k sources, from their summed information: of all but each,
    and the last of all. Inverted together: as many calls as for one."""
    k, count = len(xs), xs[0].shape[1]
    inverse, _, margin = linalg.sweep(np.concatenate([one for one, _ in sums], axis=2))
    x = linalg.matvec(inverse, np.concatenate([one for _, one in sums], axis=1))
    inverse[..., : k * count] *= float(k - 1)
    inverse[..., k * count :] *= float(k)
    sound = (np.minimum(np.tile(least, k + 1), margin) > SOUND) & np.isfinite(x).all(axis=0)
    sound &= np.isfinite(inverse).all(axis=(0, 1))
    out = []
    for j in range(k + 1):
        part = slice(j * count, (j + 1) * count)
        one, P, bad = x[:, part], inverse[..., part], marked(~sound[part])
        if len(bad):
            chosen = [i for i in range(k) if i != j]
            one[:, bad], P[:, :, bad] = uniform_ci(
                np.stack([xs[i][:, bad] for i in chosen]), np.stack([Ps[i][:, :, bad] for i in chosen])
            )
        out.append((one, P))
    return out[k], out[:k]
