"""The extent of a global track, fused over its sources and over time.

Log length, log width and heading (modulo pi) are each fused on their own, in every step in which a source of the track
says something new of them: the mean of what is said and of what was known, weighted by inverse variances,

    x = sum w_i x_i,   w_i = (1 / s_i^2) / sum_j (1 / s_j^2),   s = sum w_i s_i,

whose standard deviation s holds whatever the correlation of what is averaged: several reports smooth each other and
never make the result surer than its parts. What was known grows vaguer with time, the heading by `TURN` (a ship that
turns), the sizes by `DRIFT`. Standard deviations that are not told are `USUAL`, none is below `LEAST`. A blob, which
may be several objects, says nothing of the extent of one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.centre.extents import BLOB
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.rows import Rows
from fusion_service.centre.tracks import FUSED_ROWS
from fusion_service.records import altered
from schemas import MAX_EXTENT, SHAPES

__all__ = ["extent_columns", "fused_extents"]

USUAL = np.array([[0.3], [0.3], [0.3]])
"""Of a log size, and of a heading, rad."""
LEAST = 0.01
DRIFT, TURN = 0.001, 0.05
"""1/s and rad/s."""
VAGUE = np.array([[1.0], [1.0], [np.pi / np.sqrt(12.0)]])
"""From such a standard deviation on nothing is known."""


def fused_extents(rows: Rows, picture: Picture, seconds: float) -> Picture:
    """The picture, so many seconds after the last, with what the rows that are believed and new say of extents."""
    if not len(rows.tracks.extent) and not len(picture.extent):
        return picture
    known, spread = picture.extent[0:3].copy(), picture.extent[3:6].copy()
    box = picture.extent[6].copy() if len(picture.extent) else np.full(len(picture.id), np.nan)
    if not len(picture.extent):
        known, spread = np.full((2, 3, len(picture.id)), np.nan)
    spread += np.array([[DRIFT], [DRIFT], [TURN]]) * max(seconds, 0.0)
    known[spread >= VAGUE] = np.nan
    if len(rows.tracks.extent):
        at, value, sigma, boxes = _said(rows, picture)
        told = np.zeros(len(picture.id), dtype=np.bool_)
        told[at] = True
        for k in range(3):
            known[k], spread[k] = _averaged(known[k], spread[k], at, value[k], sigma[k], modulo=k == 2)
        box[at] = boxes
    spread[np.isnan(known)] = np.nan
    if np.isnan(known).all():
        return altered(picture, extent=np.zeros((0, len(picture.id))))
    extent = np.concatenate([known, spread, box[None]])
    assert len(extent) == FUSED_ROWS
    return altered(picture, extent=extent)


def _said(rows: Rows, picture: Picture) -> tuple[Ints, Floats, Floats, Floats]:
    """Of K rows that say something: their track's place in the picture, log sizes and heading (3, K), standard
    deviations (3, K), and whether it is a box (K,)."""
    inside = rows.inside()
    column = rows.tracks.extent[:, inside]
    some = rows.fresh[inside] & (column[7] != BLOB) & np.isfinite(column[0:3]).any(axis=0)
    column, inside = column[:, some], inside[some]
    value, sigma = column[0:3].copy(), column[3:6].copy()
    value[:2] = np.log(column[:2])
    sigma[:2] /= column[:2]
    sigma = np.maximum(np.where(np.isnan(sigma), USUAL, sigma), LEAST)
    value = np.where(sigma >= VAGUE, np.nan, value)
    return picture.find(rows.tracks.link[inside]), value, sigma, column[6]


def _averaged(
    known: Floats, spread: Floats, at: Ints, value: Floats, sigma: Floats, modulo: bool
) -> tuple[Floats, Floats]:
    """Mean and standard deviation (G,) of what was known (G,) and what is said (K,) of the tracks `at` (K,)."""
    some = np.isfinite(value)
    at, value, sigma = at[some], value[some], sigma[some]
    if not len(at):
        return known, spread
    count = len(known)
    whole, first = np.unique(at, return_index=True)
    base = known.copy()
    base[whole] = np.where(np.isnan(known[whole]), value[first], known[whole])
    offset = value - base[at]
    if modulo:
        offset = _wrapped(offset)
    had = np.isfinite(known)
    weight = np.where(had, 1.0 / np.where(had, spread, 1.0) ** 2, 0.0)
    total = weight + np.bincount(at, 1.0 / sigma**2, minlength=count)
    shift = np.bincount(at, offset / sigma**2, minlength=count)
    linear = np.where(had, 1.0 / np.where(had, spread, 1.0), 0.0) + np.bincount(at, 1.0 / sigma, minlength=count)
    mean, deviation = known.copy(), spread.copy()
    mean[whole] = base[whole] + shift[whole] / total[whole]
    deviation[whole] = linear[whole] / total[whole]
    return (np.mod(mean, np.pi) if modulo else mean), deviation


def _wrapped(angle: Floats) -> Floats:
    """Angles modulo pi, from -pi/2 on."""
    return np.asarray(np.mod(angle + np.pi / 2, np.pi) - np.pi / 2)


def extent_columns(picture: Picture) -> dict[str, Any]:
    """The columns of a message that tell the extents, none where nothing is known of any."""
    if not len(picture.extent) or not np.isfinite(picture.extent[0:3]).any():
        return {}
    known, spread = picture.extent[0:3].T.copy(), picture.extent[3:6].T.copy()
    known[:, :2] = np.clip(np.exp(known[:, :2]), 1e-6, MAX_EXTENT)
    spread[:, :2] *= known[:, :2]
    turned: Bools = known[:, 1] > known[:, 0]
    known[turned, :2], spread[turned, :2] = known[turned, 1::-1], spread[turned, 1::-1]
    known[turned, 2] = np.mod(known[turned, 2] + np.pi / 2, np.pi)
    there = np.isfinite(known).any(axis=1)
    box = bool((picture.extent[6, there] == 1.0).all())
    sigma = np.minimum(spread, MAX_EXTENT)
    return {"extent": known, "extent_sigma": sigma, "shape": SHAPES[int(box)]}
