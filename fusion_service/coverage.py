"""Which places a sensor covers, by its own word (disk, sector or polygon; WIRE.md, sensor_info)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusion_service.arrays import Bools, Floats
from fusion_service.geodesy import FrameError, transform
from schemas import Coverage, Disk, Frame, Platform, Polygon, Sector, SensorInfo

__all__ = ["at_platform", "covers", "region_holds"]


def covers(info: SensorInfo, positions: Floats, frame: Frame) -> Bools:
    """Whether each place, positions (2 or 3, M) in `frame`, m, is covered: (M,).

    Nothing is covered by a sensor that states no coverage, or whose frame cannot be reached from `frame`.
    """
    count = positions.shape[1]
    if info.coverage is None:
        return np.zeros(count, dtype=np.bool_)
    axes = ("x", "y", "z")[: len(positions)]
    try:
        means, _ = transform(positions.T, np.zeros((count, len(axes), len(axes))), axes, frame, info.frame)
    except FrameError:
        return np.zeros(count, dtype=np.bool_)
    return region_holds(info.coverage, means.T, info.position[:2])


def at_platform(info: SensorInfo, platform: Platform, frame: Frame) -> SensorInfo:
    """What a sensor says of itself, where its platform is, in `frame`; a polygon stays where it is."""
    if isinstance(info.coverage, Polygon):
        return info
    return replace(info, frame=frame, position=platform.position)


def region_holds(region: Coverage, positions: Floats, centre: tuple[float, ...] = (0.0, 0.0)) -> Bools:
    """Which places (2 or 3, M), m, lie in a region of the same frame; a disk or sector is about `centre`: (M,)."""
    x, y = positions[0], positions[1]
    if isinstance(region, (Disk, Sector)):
        east, north = x - centre[0], y - centre[1]
        distance = np.hypot(east, north)
        inside = (distance >= region.inner) & (distance <= region.radius)
        if isinstance(region, Sector):
            off = np.arctan2(east, north) - region.azimuth
            inside &= np.abs(np.arctan2(np.sin(off), np.cos(off))) <= region.width / 2
        return np.asarray(inside)
    return _in_polygon(region.points, x, y)


def _in_polygon(points: tuple[tuple[float, float], ...], x: Floats, y: Floats) -> Bools:
    """Even-odd rule: an odd number of edges lies to the right of the place."""
    inside = np.zeros(len(x), dtype=np.bool_)
    for (x1, y1), (x2, y2) in zip(points, (*points[1:], points[0]), strict=True):
        if y1 != y2:
            between = (y1 > y) != (y2 > y)
            inside ^= between & (x < x1 + (y - y1) * (x2 - x1) / (y2 - y1))
    return inside
