"""The extent of an object, as messages carry it: length, width (full sizes, m) and heading (rad) of its long axis.

The heading is in the frame of the message, counted from x to y; turned by pi it is the same extent. NaN in any of the
three: it is not known. What a message reports of an object need not be its centre: `reference` says what it is, and
`reference_covariances` how far it may lie from the centre.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["MAX_EXTENT", "REFERENCES", "SHAPES", "sound_extents", "sound_offsets", "sound_references", "sound_sigmas"]

SHAPES = ("ellipse", "box")
REFERENCES = ("centre", "antenna", "nearest", "blob")
MAX_EXTENT = 1e4
"""m: longer than any ship; no size, deviation or offset of a message is larger."""
MAX_HEADING = 2 * np.pi
ROUNDING = 1e-9

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def sound_extents(extent: Floats) -> Bools:
    """Which of extents (T, 3) are sound: 0 < length <= MAX_EXTENT, 0 < width <= length (MAX_EXTENT where the length is
    not known), a heading within 2 pi; NaN for what is not known."""
    length, width, heading = extent.T
    most = np.where(np.isnan(length), MAX_EXTENT, length)
    sound = np.isnan(length) | ((length > 0) & (length <= MAX_EXTENT))
    sound &= np.isnan(width) | ((width > 0) & (width <= most))
    return np.asarray(sound & (np.isnan(heading) | (np.abs(heading) <= MAX_HEADING)))


def sound_sigmas(sigma: Floats) -> Bools:
    """Which standard deviations (T, 3) of extents are sound: from 0 to MAX_EXTENT, or NaN."""
    return np.asarray((np.isnan(sigma) | ((sigma >= 0) & (sigma <= MAX_EXTENT))).all(axis=1))


def sound_references(covariances: Floats) -> Bools:
    """Which covariances (T, 2, 2) of a reference point are sound: positive semidefinite, no deviation above MAX_EXTENT;
    NaN throughout: not known."""
    a, b, c = covariances[:, 0, 0], covariances[:, 1, 0], covariances[:, 1, 1]
    most = MAX_EXTENT**2
    with np.errstate(all="ignore"):
        sound = (a >= 0) & (c >= 0) & (a <= most) & (c <= most) & (b * b <= a * c * (1 + ROUNDING))
    return np.asarray(sound | np.isnan(covariances).all(axis=(1, 2)))


def sound_offsets(offset: Floats) -> Bools:
    """Which offsets (T, 2) of a point from the centre of a hull are sound: within MAX_EXTENT, or NaN."""
    return np.asarray((np.isnan(offset) | (np.abs(offset) <= MAX_EXTENT)).all(axis=1))
