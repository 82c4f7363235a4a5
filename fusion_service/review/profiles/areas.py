"""Which places lie in an area."""

from __future__ import annotations

import numpy as np

from fusion_service.arrays import Bools, Floats
from fusion_service.coverage import region_holds
from fusion_service.errors import ReviewError
from fusion_service.geodesy import geodetic_to_enu
from fusion_service.review.profiles.observing import Observed, places_on_earth
from fusion_service.review.profiles.profile import Area
from schemas import Disk, Ecef, Enu, Polygon

__all__ = ["holds", "rest_inside", "targets_inside"]


def targets_inside(area: Area | None, seen: Observed) -> Bools:
    """Where targets exist and are in the area (K, T). None: everywhere. ReviewError for an area that has no meaning in
    the picture's frame, and for heights where truth tells none."""
    inside = seen.exists.copy()
    if area is None:
        return inside
    at = np.flatnonzero(inside)
    place = seen.place.reshape(-1, seen.place.shape[2])[at]
    good = holds(area, place, seen)
    if area.heights is not None:
        height = seen.height.reshape(-1)[at]
        if len(height) and np.isnan(height).all():
            raise ReviewError(f"area {area.name!r} is of heights, and neither truth nor the picture tells any")
        good &= (height >= area.heights[0]) & (height <= area.heights[1])
    inside.reshape(-1)[at] = good
    return inside


def rest_inside(area: Area | None, seen: Observed, place: Floats) -> Bools:
    """Which tracks at places (S, d) are in the area; their heights count where the picture has z."""
    if area is None:
        return np.ones(len(place), dtype=np.bool_)
    good = holds(area, place, seen)
    if area.heights is not None and place.shape[1] > 2:
        on_earth = isinstance(seen.frame, Enu | Ecef)
        height = places_on_earth(place, seen.frame)[2] if on_earth else place[:, 2]
        good &= (height >= area.heights[0]) & (height <= area.heights[1])
    return good


def holds(area: Area, place: Floats, seen: Observed) -> Bools:
    """Which places (R, d) are within the polygon and the disk. Edges of a polygon in degrees are straight in latitude
    and longitude; a disk is about its centre along the ground's tangent plane there."""
    good = np.ones(len(place), dtype=np.bool_)
    if not area.polygon and area.disk is None:
        return good
    if isinstance(seen.frame, Ecef) and not area.degrees:
        raise ReviewError(f"area {area.name!r} is in x and y, and the picture's frame is ECEF: give it in degrees")
    x, y = place[:, 0], place[:, 1]
    if area.degrees:
        x, y, altitude = places_on_earth(place, seen.frame)
    if area.polygon:
        good &= region_holds(Polygon(area.polygon), np.stack([x, y]))
    if area.disk is not None:
        one, other = area.disk
        if area.degrees:
            x, y, _ = geodetic_to_enu(x, y, altitude, Enu(one, other))
            one = other = 0.0
        good &= region_holds(Disk(area.radius), np.stack([x, y]), (one, other))
    return good
