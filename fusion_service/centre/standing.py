"""Where each source stands: the platform of its newest tracks, else what its SensorInfo says; and what a heading that
is not quite known does to all that is reported from there.

An error d of the heading turns all tracks about the place p of the sensor. With u the vertical there and v_p the
velocity of the platform, to first order

    position  u x (r - p) d,      velocity  u x (v - v_p) d,      acceleration  u x a d

is what it makes of a state; with d ~ (0, heading_sigma^2) the covariance of a track grows by heading_sigma^2 g g', g
the effect of one radian. It is one error of all rows of the source and is the same again in their next versions, so it
is added to what the tracker says in every step, and is never averaged out.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.centre.partial import Unknown
from fusion_service.centre.places import Place, before
from fusion_service.centre.sources import Source
from fusion_service.centre.tracks import Tracks
from fusion_service.densities import Mixtures
from fusion_service.geodesy import FrameError, ecef_to_geodetic, transform
from schemas import Ecef, Frame, Platform

__all__ = ["heading_sigma_of", "place_in", "place_of", "turned"]

AXES = (("x", "y", "z"), ("vx", "vy", "vz"), ("ax", "ay", "az"))
TRIFLE = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class _Stand:
    """In the picture's frame: position (3,), m, velocity (3,), m/s, and the vertical (3,) there."""

    position: Floats
    velocity: Floats
    up: Floats


def heading_sigma_of(source: Source) -> float:
    """rad: what a source says of the error of its heading, 0 where it says nothing."""
    said = None if source.place is None else source.place.platform.heading_sigma
    if said is None and source.info is not None:
        said = source.info.heading_sigma
    return 0.0 if said is None else said


def place_of(source: Source) -> Place | None:
    """Where a source stands: by its newest tracks that say so, else by its info."""
    if source.place is not None or source.info is None:
        return source.place
    return Place(-1, source.info.frame, Platform(source.info.position))


def place_in(place: Place, frame: Frame) -> Floats | None:
    """The position (3,), m, of a place in `frame`; None where there is no way into it."""
    try:
        means, _ = transform(
            np.array([place.platform.position], dtype=np.float64), np.zeros((1, 3, 3)), AXES[0], place.frame, frame
        )
    except FrameError:
        return None
    return means[0] if np.isfinite(means[0]).all() else None


def _stand(source: Source, frame: Frame) -> _Stand | None:
    place = place_of(source)
    here = None if place is None else place_in(place, frame)
    if place is None or here is None:
        return None
    velocity, last = np.zeros(3), before(source.places) if source.places else None
    there = None if last is None else place_in(last, frame)
    if last is not None and there is not None:
        velocity = (here - there) / ((place.time - last.time) / 1e9)
    up = np.array([0.0, 0.0, 1.0])
    if isinstance(frame, Ecef):
        lat, lon, _ = (np.radians(one) for one in ecef_to_geodetic(*here))
        up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    return _Stand(here, velocity, up)


def turned(tracks: Tracks, source: Source, space: tuple[str, ...], frame: Frame | None) -> Tracks:
    """Tracks of a source, in the picture's space and frame, with what the error of its heading adds."""
    sigma = heading_sigma_of(source)
    stand = None if frame is None or not sigma or not len(tracks.id) else _stand(source, frame)
    if stand is None:
        return tracks
    unknown = Unknown.of(space)
    if not len(tracks.log_weight):
        more = _effect(tracks.mean, tracks.covariance, space, stand, unknown) * sigma
        return replace(tracks, covariance=tracks.covariance + _square(more))
    more = _effect(tracks.part_mean, tracks.part_covariance, space, stand, unknown) * sigma
    parts = tracks.part_covariance + _square(more)
    mean, covariance = Mixtures(tracks.log_weight, tracks.part_mean, parts).moments()
    return replace(tracks, mean=mean, covariance=covariance, part_covariance=parts)


def _square(more: Floats) -> Floats:
    """Covariances (n, n, ...) of an error `more` (n, ...), on the diagonal by a trifle larger: what it is added to may
    be less than what is lost in rounding."""
    out: Floats = more[:, None] * more[None]
    for k in range(len(more)):
        out[k, k] *= 1.0 + TRIFLE
    return out


def _effect(mean: Floats, covariance: Floats, space: tuple[str, ...], stand: _Stand, unknown: Unknown) -> Floats:
    """What one radian makes (n, ...) of states (n, ...); nothing of components that are not known."""
    out = np.zeros_like(mean)
    for axes, origin in zip(AXES, (stand.position, stand.velocity, np.zeros(3)), strict=True):
        if axes[0] not in space or axes[1] not in space:
            continue
        x, y = (mean[space.index(name)] - at for name, at in zip(axes[:2], origin, strict=False))
        z = mean[space.index(axes[2])] - origin[2] if axes[2] in space else np.zeros_like(x)
        u, v, w = stand.up.tolist()
        for name, value in zip(axes, (v * z - w * y, w * x - u * z, u * y - v * x), strict=True):
            if name in space:
                out[space.index(name)] = value
    return np.where(unknown.known(covariance), out, 0.0)
