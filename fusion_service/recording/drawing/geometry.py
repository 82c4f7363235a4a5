"""Where things are drawn: one frame for a whole recording, ellipses, fields of view, a grid.

Everything is moved into the chart's frame; its plane is east and -north in m (a 2D view's y axis points
down), and on a map the same places are latitude and longitude. An ellipse holds 95 % of the position of a
Gaussian: (p - mean)' P^-1 (p - mean) = q, q the chi-square quantile with two degrees of freedom, -2 ln 0.05.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service import geodesy
from fusion_service.arrays import Floats
from fusion_service.densities import moments
from schemas import Disk, Ecef, Enu, Frame, GlobalTracks, Height, LocalTracks, Polygon, Sector, SensorInfo

__all__ = [
    "CORNERS",
    "QUANTILE",
    "RING",
    "Chart",
    "Outline",
    "Place",
    "circle",
    "ellipses",
    "grid",
    "level",
    "outline",
    "rings",
    "track_moments",
]


QUANTILE = -2 * math.log(0.05)
"""A Gaussian's position lies inside (p - mean)' P^-1 (p - mean) = QUANTILE with 95 %."""
CORNERS = 24


def circle(corners: int = CORNERS) -> Floats:
    """Points (2, corners + 1) of the unit circle, the last one the first again."""
    return np.stack([f(np.linspace(0, 2 * np.pi, corners + 1)) for f in (np.cos, np.sin)])


RING = circle()


class Place(NamedTuple):
    """Positions in a chart: xy (T, 2) east and north in m, z (T,) up, covariance (T, 2, 2) of xy."""

    xy: Floats
    z: Floats
    covariance: Floats


class Outline(NamedTuple):
    """S line strips, one after the other: xy (P, 2) in m, their lengths (S,) and whose they are (S,)."""

    xy: Floats
    lengths: NDArray[np.int64]
    owner: NDArray[np.int64]


def track_moments(message: LocalTracks | GlobalTracks) -> tuple[Floats, Floats]:
    """Mean (T, n) and covariance (T, n, n) of each track: a mixture by its moments."""
    return moments(message.means, message.covariances, message.weights, message.counts)


class Chart:
    """The frame of the drawing. `frame` ECEF draws in ENU about `near`, a position (x, y, z) in ECEF, m. Raises
    `geodesy.FrameError` where that has no vertical."""

    def __init__(self, frame: Frame, near: tuple[float, float, float] | None = None) -> None:
        if isinstance(frame, Ecef):
            there = level(*(near or (geodesy.A, 0.0, 0.0)))
            frame = Enu(there.lat, there.lon)
        self.frame = frame

    def place(
        self,
        means: Floats,
        covariances: Floats,
        space: tuple[str, ...],
        frame: Frame,
        height: Height | None = None,
    ) -> Place:
        """Positions of states (T, n), (T, n, n). Raises `geodesy.FrameError` if `frame` has none."""
        names = tuple(name for name in "xyz" if name in space)
        index = [space.index(name) for name in names]
        means, covariances = means[:, index], covariances[:, index][:, :, index]
        if len(means):
            means, covariances = geodesy.transform(means, covariances, names, frame, self.frame, height)
        xy = means[:, :2]
        if len(names) == 3:
            z = means[:, 2]
        else:
            origin = self.frame.alt if isinstance(self.frame, Enu) else 0.0
            z = (height.value if height else 0.0) - origin - (xy * xy).sum(axis=1) / (2 * geodesy.A)
        return Place(xy, z, covariances[:, :2, :2])

    def plane(self, xy: Floats) -> Floats:
        """(..., 2) as a 2D view draws it."""
        return xy * (1.0, -1.0)

    def geo(self, xy: Floats, z: Floats) -> Floats | None:
        """Latitude and longitude (..., 2) in degrees, None in a frame that is not about a place on Earth."""
        if not isinstance(self.frame, Enu):
            return None
        lat, lon, _ = geodesy.enu_to_geodetic(xy[..., 0], xy[..., 1], z, self.frame)
        return np.stack([lat, lon], axis=-1)


def ellipses(place: Place, dashed: NDArray[np.bool_], corners: int = CORNERS) -> Outline:
    """The 95 % ellipse of each position, a polygon of `corners` (a divisor of 24); that of a `dashed` (T,) one in
    every second of three."""
    a, b, c = (place.covariance[:, i, j] for i, j in ((0, 0), (1, 0), (1, 1)))
    across = np.sqrt(a)
    slope = b / across
    along = np.sqrt(np.maximum(c - slope * slope, 0.0))
    cos, sin = RING[:, :: CORNERS // corners]
    offsets = np.stack([across[:, None] * cos, slope[:, None] * cos + along[:, None] * sin], axis=-1)
    rings = place.xy[:, None, :] + math.sqrt(QUANTILE) * offsets
    solid, broken = np.flatnonzero(~dashed), np.flatnonzero(dashed)
    strips = corners // 3
    return Outline(
        np.concatenate([rings[solid].reshape(-1, 2), rings[broken, :corners].reshape(-1, 2)]),
        np.concatenate([np.full(len(solid), corners + 1), np.full(strips * len(broken), 3)]),
        np.concatenate([solid, np.repeat(broken, strips)]),
    )


def level(x: float, y: float, z: float) -> Enu:
    """The ENU frame about a position in ECEF, m. Raises `geodesy.FrameError` where there is no vertical: near the
    centre of the Earth."""
    lat, lon, alt = (float(one) for one in geodesy.ecef_to_geodetic(x, y, z))
    if not all(math.isfinite(one) for one in (lat, lon, alt)):
        raise geodesy.FrameError(f"{x:g}, {y:g}, {z:g} in ECEF is no place on Earth")
    return Enu(lat, lon, alt)


def outline(info: SensorInfo) -> tuple[list[Floats], Frame]:
    """The edges of a sensor's field of view as (P, 2) strips of x, y in m, and the frame they are in."""
    frame, centre = info.frame, np.array(info.position[:2])
    if isinstance(info.coverage, Polygon):
        return [np.array([*info.coverage.points, info.coverage.points[0]])], frame
    if isinstance(frame, Ecef):
        frame, centre = level(*info.position), np.zeros(2)
    return [centre + edge for edge in _edges(info.coverage)], frame


def _edges(coverage: Disk | Sector | None) -> list[Floats]:
    """As seen from the sensor."""
    if coverage is None:
        return []
    if isinstance(coverage, Disk) or coverage.width >= 2 * math.pi:
        return [_arc(radius, 0.0, 2 * math.pi) for radius in (coverage.radius, coverage.inner) if radius > 0]
    return [_sector(coverage)]


def _arc(radius: float, azimuth: float, width: float) -> Floats:
    """Points at `radius` from `azimuth` on through `width` clockwise."""
    angles = azimuth + np.linspace(0.0, width, max(2, math.ceil(abs(width) / math.radians(4)) + 1))
    return radius * np.stack([np.sin(angles), np.cos(angles)], axis=-1)


def _sector(sector: Sector) -> Floats:
    half = sector.width / 2
    outer = _arc(sector.radius, sector.azimuth - half, sector.width)
    inner = _arc(sector.inner, sector.azimuth + half, -sector.width)
    return np.concatenate([outer, inner, outer[:1]])


def rings(reach: float) -> tuple[list[float], list[str]]:
    """Radii at every round number of metres up to `reach`, and their labels."""
    step = _round(2 * reach)
    unit, scale = ("km", 1e-3) if step >= 1000 else ("m", 1.0)
    radii = [step * k for k in range(1, max(math.floor(reach / step), 1) + 1)]
    return radii, [f"{radius * scale:g} {unit}" for radius in radii]


def _round(size: float) -> float:
    """The least of 1, 2, 5 times a power of ten, m, of which at most eight make `size`."""
    step = 10.0 ** math.floor(math.log10(max(size, 1.0) / 4))
    return step * next(f for f in (1, 2, 5, 10) if size / (f * step) <= 8)


def grid(low: Floats, high: Floats) -> tuple[list[Floats], list[str]]:
    """Lines every round number of metres over the square `low`..`high` (2,) of east and north, and their labels."""
    step = _round(float(np.max(high - low)))
    low, high = np.floor(low / step) * step, np.ceil(high / step) * step
    unit, scale = ("km", 1e-3) if step >= 1000 else ("m", 1.0)
    lines, labels = [], []
    for axis, name in enumerate("EN"):
        for value in np.arange(low[axis], high[axis] + step / 2, step):
            ends = np.array([low, high])
            ends[:, axis] = value
            lines.append(ends)
            labels.append(f"{name} {value * scale:g} {unit}")
    return lines, labels
