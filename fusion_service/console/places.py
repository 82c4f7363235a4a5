"""Where a picture's tracks, and what a source says of its own place and coverage, lie on a map.

A picture in an ENU or ECEF frame is shown by longitude and latitude, degrees; one in a named local frame by x and y, m,
and so is one in an ENU frame where Mercator's map has no room, at the poles. Longitudes go on beyond 180 degrees, so
that what is near is near on the map on both sides of the antimeridian.
An ellipse is that of one standard deviation in the horizontal plane at the track: half axes in m, and the angle of the
long one, rad, anticlockwise from east (from x). What a density says not at all (WIRE.md, State spaces) is left out.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fusion_service.arrays import Bools, Floats
from fusion_service.densities import moments
from fusion_service.geodesy import ecef_to_geodetic, enu_to_geodetic, level_axes, surface
from schemas import Disk, Ecef, Enu, Frame, GlobalTracks, Local, Polygon, Sector, SensorInfo
from schemas.spaces import UNKNOWN_SIGMA

__all__ = ["Places", "flat_name", "frame_words", "near", "places", "source_place"]

ARC = 48
"""Corners of the outline of a disk."""
EARTH = 6378137.0
EDGE = 85.05
"""Degrees of latitude at which Mercator's map ends."""
POLAR = 84.0
"""From which latitude on a picture is shown by its own east and north."""


class Places(NamedTuple):
    """(T,) each. x, y: longitude and latitude in degrees where the frame is on the Earth, else m; height: m, NaN where
    not known; major, minor: half axes, m; turn: rad; vx, vy: m/s to the east and north (along x and y), NaN where not
    known; sound: whether it can be drawn at all."""

    x: Floats
    y: Floats
    height: Floats
    major: Floats
    minor: Floats
    turn: Floats
    vx: Floats
    vy: Floats
    sound: Bools


def flat_name(frame: Frame) -> str | None:
    """The name of a frame that is shown by its own x and y; None for one that is shown on the Earth."""
    if isinstance(frame, Local):
        return frame.name
    if isinstance(frame, Enu) and abs(frame.lat) > POLAR:
        return f"east and north of {frame.lat:.6g}, {frame.lon:.6g}"
    return None


def places(picture: GlobalTracks, around: float = 0.0) -> Places:
    """Where the tracks of a picture are; around: the longitude about which they lie, degrees."""
    means, covariances = moments(picture.means, picture.covariances, picture.weights, picture.counts)
    space, count = picture.space, len(picture.ids)
    place, spread = _part(means, covariances, space, ("x", "y", "z"))
    speed, speed_spread = _part(means, covariances, space, ("vx", "vy", "vz"))
    unknown_z = ~(spread[:, 2, 2] < UNKNOWN_SIGMA["z"] ** 2) if "z" in space else np.ones(count, dtype=np.bool_)
    place[unknown_z, 2] = 0.0
    spread[unknown_z, 2, :] = spread[unknown_z, :, 2] = 0.0
    limit = UNKNOWN_SIGMA["vx"] ** 2
    still = ~((speed_spread[:, 0, 0] < limit) & (speed_spread[:, 1, 1] < limit)) | ("vx" not in space)
    speed[speed_spread[:, 2, 2] >= limit, 2] = 0.0
    with np.errstate(all="ignore"):
        if flat_name(picture.frame) is not None or isinstance(picture.frame, Local):
            x, y, height = place.T
            axes = np.broadcast_to(np.eye(3)[:2], (count, 2, 3))
        else:
            x, y, height, axes = _on_earth(place, unknown_z, picture.frame)
            x = near(x, around)
            y = np.where(np.abs(y) <= EDGE, y, np.nan)
        flat = axes @ spread @ axes.transpose(0, 2, 1)
        velocity = np.einsum("tij,tj->ti", axes, speed)
        major, minor, turn = _ellipse(flat)
    velocity[still] = np.nan
    height = np.where(unknown_z, np.nan, height)
    sound = np.isfinite(x) & np.isfinite(y) & np.isfinite(major) & np.isfinite(minor)
    return Places(x, y, height, major, minor, turn, velocity[:, 0], velocity[:, 1], sound)


def near(longitude: Floats, around: float) -> Floats:
    """The same longitudes, as those that are nearest to `around`, degrees."""
    return longitude - 360.0 * np.rint((longitude - around) / 360.0)


def _part(means: Floats, covariances: Floats, space: tuple[str, ...], names: tuple[str, ...]) -> tuple[Floats, Floats]:
    """Mean (T, 3) and covariance (T, 3, 3) of three components, 0 for those that the space lacks."""
    mean = np.zeros((len(means), 3))
    covariance = np.zeros((len(means), 3, 3))
    there = [(k, space.index(name)) for k, name in enumerate(names) if name in space]
    for k, i in there:
        mean[:, k] = means[:, i]
        for other, j in there:
            covariance[:, k, other] = covariances[:, i, j]
    return mean, covariance


def _on_earth(place: Floats, level: Bools, frame: Enu | Ecef) -> tuple[Floats, Floats, Floats, Floats]:
    """Longitude, latitude, height, and east and north (T, 2, 3) in the frame's axes; level: which have no height, and
    are put on the ellipsoid."""
    x, y, z = place.T
    if isinstance(frame, Enu):
        on_surface = np.nan_to_num(surface(x, y, frame, 0.0)[0]) if level.any() else z
        z = np.where(level, on_surface, z)
        lat, lon, alt = enu_to_geodetic(x, y, z, frame)
    else:
        z = np.where(level, np.nan, z)
        lat, lon, alt = ecef_to_geodetic(x, y, z)
    east, north = level_axes(np.stack([x, y, z]), ("x", "y", "z"), frame)
    return lon, lat, alt, np.nan_to_num(np.stack([east, north]).transpose(2, 0, 1))


def _ellipse(flat: Floats) -> tuple[Floats, Floats, Floats]:
    """Half axes and angle of covariances (T, 2, 2)."""
    a, b, d = flat[:, 0, 0], flat[:, 0, 1], flat[:, 1, 1]
    half, radius = (a + d) / 2, np.hypot((a - d) / 2, b)
    return np.sqrt(half + radius), np.sqrt(np.maximum(half - radius, 0.0)), 0.5 * np.arctan2(2 * b, a - d)


def frame_words(frame: Frame) -> dict[str, Any]:
    """A frame for the page: kind, and its name or origin."""
    if (name := flat_name(frame)) is not None:
        return {"kind": "local", "name": name[:64]}
    if not isinstance(frame, Enu):
        return {"kind": "ecef"}
    return {"kind": "enu", "lat": frame.lat, "lon": frame.lon}


def source_place(info: SensorInfo) -> dict[str, Any] | None:
    """Place and outline of the coverage of a source, as lists of pairs; local: the name of its frame, where that is not
    shown on the Earth. None where it is nowhere."""
    frame: Enu | Ecef | Local = info.frame
    centre = info.position
    if isinstance(frame, Ecef):
        origin = [float(value) for value in ecef_to_geodetic(*centre)]
        if not all(map(math.isfinite, origin)):
            return None
        frame, centre = Enu(*origin), (0.0, 0.0, 0.0)
    outline = _outline(info, centre)
    points = np.array([centre[:2], *outline], dtype=np.float64)
    said: dict[str, Any] = {}
    name = flat_name(frame)
    if name is not None or isinstance(frame, Local):
        said["local"] = (name or "")[:64]
    else:
        lat, lon, _ = enu_to_geodetic(points[:, 0], points[:, 1], np.full(len(points), centre[2]), frame)
        points = np.stack([near(lon, float(lon[0])), lat], axis=1)
    if not np.isfinite(points).all():
        return None
    return {**said, "place": points[0].tolist(), "outline": points[1:].tolist()}


def _outline(info: SensorInfo, centre: tuple[float, float, float]) -> list[tuple[float, float]]:
    """The outline of a coverage about `centre` in the source's plane; none where none is told, or the Earth's size."""
    region = info.coverage
    if isinstance(region, Polygon):
        return list(region.points)
    if not isinstance(region, (Disk, Sector)) or region.radius > EARTH:
        return []
    if isinstance(region, Sector) and region.width < 2 * math.pi:
        begin, end = region.azimuth - region.width / 2, region.azimuth + region.width / 2
        angles = np.linspace(begin, end, ARC).tolist()
        back = [(region.inner, angle) for angle in reversed(angles)] if region.inner else [(0.0, 0.0)]
        corners = [*((region.radius, angle) for angle in angles), *back]
    else:
        corners = [(region.radius, 2 * math.pi * k / ARC) for k in range(ARC)]
    return [(centre[0] + r * math.sin(angle), centre[1] + r * math.cos(angle)) for r, angle in corners]
