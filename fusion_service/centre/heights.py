"""Sources on the plane in a picture with height: what a source says of the height of what it sees becomes z.

A 2-D source tells x and y about its own vertical. Where it states a height with a sigma (`Height`: above the
ellipsoid), that is information: z is where the vertical through (x, y) meets that height, with the sigma. Where it
states no sigma, the height serves to find the place (`geodesy.transform`), and z stays unknown.

In an ECEF picture nothing can stay unknown upwards, since up is along no axis. There a height without sigma has one of
`VERTICAL` m, which takes in all that flies, and vertical speed and acceleration that are not told are 0 with a sigma of
`CLIMB` and `HEAVE`: in the source's own frame, before it is turned.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusion_service.geodesy import FrameError, surface
from schemas import Ecef, Enu, Frame, Height, LocalTracks

__all__ = ["lifted_space", "with_height"]

VERTICAL = 1e4
"""m: how uncertain a height is of which no sigma is stated."""
CLIMB = 100.0
"""m/s."""
HEAVE = 20.0
"""m/s2."""
VERTICALS = ((("vx", "vy"), "vz", CLIMB), (("ax", "ay"), "az", HEAVE))


def lifted_space(
    space: tuple[str, ...], frame: Frame, target: Frame, wanted: tuple[str, ...], sigma: float
) -> tuple[str, ...]:
    """The space in which tracks of `space` and `frame` are brought into the frame `target` of a picture in `wanted`,
    where their height is stated with `sigma`, m."""
    if not isinstance(frame, Enu):
        return space
    to_ecef = isinstance(target, Ecef)
    more: tuple[str, ...] = ("z",) if "z" in wanted and "z" not in space and (to_ecef or sigma > 0.0) else ()
    if to_ecef:
        more += tuple(name for plane, name, _ in VERTICALS if name not in space and set(plane) <= set(space))
    return space + more


def with_height(message: LocalTracks, default: Height, target: Frame, wanted: tuple[str, ...]) -> LocalTracks:
    """The message in its `lifted_space`. default: the height of a source that states none.

    `FrameError` for tracks in ECEF without z. What has no place at that height becomes NaN.
    """
    space, height = message.space, message.height or default
    if isinstance(message.frame, Ecef) and "z" not in space:
        raise FrameError(f"in ECEF a state needs z (its space: {' '.join(space)})")
    whole = lifted_space(space, message.frame, target, wanted, height.sigma)
    if whole == space:
        return message
    assert isinstance(message.frame, Enu)
    n, m, count = len(space), len(whole), len(message.means)
    means, covariances = np.zeros((count, m)), np.zeros((count, m, m))
    means[:, :n], covariances[:, :n, :n] = message.means, message.covariances
    if "z" in whole[n:]:
        ix, iy, k = space.index("x"), space.index("y"), whole.index("z")
        z, slope_x, slope_y, rise = surface(means[:, ix], means[:, iy], message.frame, height.value)
        means[:, k] = z
        tie = slope_x[:, None] * covariances[:, ix, :n] + slope_y[:, None] * covariances[:, iy, :n]
        own = slope_x * tie[:, ix] + slope_y * tie[:, iy]
        covariances[:, k, :n] = covariances[:, :n, k] = tie
        covariances[:, k, k] = own + (rise * (height.sigma or VERTICAL)) ** 2
    for _, name, sigma in VERTICALS:
        if name in whole[n:]:
            covariances[:, whole.index(name), whole.index(name)] = sigma**2
    return replace(message, space=whole, means=means, covariances=covariances)
