"""What is doubtful in tracks that can be read: where they are, how they move, what they are numbered by."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.coverage import region_holds
from fusion_service.geodesy import geodetic_to_ecef
from schemas import Coverage, Enu, Frame, LocalIntensity, LocalTracks, Sector

__all__ = [
    "SOME",
    "Glimpse",
    "angles_doubt",
    "coverage_doubt",
    "frame_doubt",
    "glimpse",
    "ids_doubt",
    "order_doubt",
    "places_doubt",
]

SOME = 64
"""Tracks of a message that are looked at, and kept."""
FAR = 500e3
"""Metres between frames of one picture beyond which something is said."""
MOST_SIGMAS = 4.0
"""Velocities that differ by less than so many standard deviations of the places' change say nothing."""
ORDERS = (("x", "vx", "y", "vy"), ("y", "x", "vy", "vx"), ("vx", "vy", "x", "y"), ("x", "y", "vy", "vx"))


class Glimpse(NamedTuple):
    """What is kept of a message: of its first tracks the places ids (T,), means (T, n), covariances (T, n, n); plain:
    whether these are tracks of one component each; moves: whether its sensor says where it is itself."""

    time: int
    epoch: int
    sent: int
    space: tuple[str, ...]
    frame: Frame
    ids: NDArray[np.uint64]
    means: Floats
    covariances: Floats
    plain: bool
    moves: bool


def glimpse(message: LocalTracks | LocalIntensity) -> Glimpse:
    """What is kept of it; holds nothing else of the message."""
    tracks = message if isinstance(message, LocalTracks) else None
    few = len(message.means) <= SOME
    return Glimpse(
        message.time,
        message.epoch,
        message.sent,
        message.space,
        message.frame,
        np.zeros(0, dtype=np.uint64) if tracks is None else tracks.ids[:SOME].copy(),
        message.means if few else message.means[:SOME].copy(),
        message.covariances if few else message.covariances[:SOME].copy(),
        plain=tracks is not None and tracks.counts is None,
        moves=tracks is not None and tracks.platform is not None,
    )


@lru_cache(maxsize=1024)
def frame_doubt(frame: Enu, picture: Enu) -> str:
    """A frame whose origin is far from that of the picture, where another reading of it is not."""
    away = _apart(frame, picture)
    if away < FAR:
        return ""
    told = f"its frame is at lat {frame.lat:g}, lon {frame.lon:g}, {away / 1000:.0f} km from that of the picture"
    if abs(frame.lon) <= 90.0 and _apart(Enu(frame.lon, frame.lat), picture) < FAR:
        return f"{told}: are lat and lon swapped?"
    lat, lon = math.degrees(frame.lat), math.degrees(frame.lon)
    if abs(lat) <= 90.0 and abs(lon) <= 360.0 and _apart(Enu(lat, lon), picture) < FAR:
        return f"{told}: are lat and lon in rad? they must be in degrees"
    if _apart(Enu(frame.lat, -frame.lon), picture) < FAR:
        return f"{told}: is the sign of lon wrong? east is positive"
    if _apart(Enu(-frame.lat, frame.lon), picture) < FAR:
        return f"{told}: is the sign of lat wrong? north is positive"
    return f"{told}: is its origin right?"


def _apart(one: Enu, other: Enu) -> float:
    a, b = (np.array(geodetic_to_ecef(frame.lat, frame.lon, 0.0), dtype=float) for frame in (one, other))
    return float(np.linalg.norm(a - b))


def places_doubt(message: Glimpse) -> str:
    """Positions that are no metres, by their standard deviations."""
    if not len(message.means):
        return ""
    x, y = message.space.index("x"), message.space.index("y")
    variances = message.covariances[:, [x, y], [x, y]].max(axis=1)
    if not np.isfinite(variances).all() or not 1e-24 < np.median(variances) < 1e-6:
        return ""
    means = np.abs(message.means)
    told = f"its positions have standard deviations of {math.sqrt(max(float(np.median(variances)), 0.0)):.1g} m"
    if (means[:, [x, y]] <= 180.0).all():
        return f"{told}, and x and y look like degrees: x and y are metres east and north of the frame's origin"
    return f"{told}: are covs in m2, and is x in m?"


def angles_doubt(message: Glimpse) -> str:
    """A turn rate that only makes sense in degrees."""
    if "turn_rate" not in message.space or not len(message.means):
        return ""
    rates = np.abs(message.means[:, message.space.index("turn_rate")])
    most = float(np.max(rates, initial=0.0))
    if not 1.5 < most <= 180.0:
        return ""
    return f"a turn_rate of {most:.3g} rad/s: is it in degrees a second? angles are in rad ({math.radians(most):.3g})"


def coverage_doubt(region: Coverage, places: Floats, position: tuple[float, ...]) -> str:
    """A coverage that does not hold the tracks at places (2 or 3, M), m in its sensor's frame."""
    inside = region_holds(region, places, position[:2])
    if inside.mean() >= 0.2:
        return ""
    told = f"its coverage holds {int(inside.sum())} of its {len(inside)} tracks"
    if isinstance(region, Sector):
        turned = replace(region, azimuth=math.remainder(math.pi / 2 - region.azimuth, 2 * math.pi))
        if region_holds(turned, places, position[:2]).mean() > 0.8:
            return f"{told}: is azimuth counted from east? it is clockwise from north"
        if region_holds(replace(region, width=2 * math.pi), places, position[:2]).mean() > 0.8:
            return f"{told}, though they are in its range: is azimuth in rad and clockwise from north?"
    if region_holds(region, places + 0.0, (0.0, 0.0)).mean() > 0.8:
        return f"{told}, but would if the sensor stood at 0, 0: is position in the frame of the sensor_info?"
    radius = getattr(region, "radius", None)
    farthest = float(np.hypot(places[0] - position[0], places[1] - position[1]).max())
    if radius is not None and farthest < 3000.0 * radius and radius < farthest:
        return f"{told}: the farthest is {farthest:.0f} m from it and radius {radius:g} m: is radius in m?"
    return f"{told}: are position and coverage right?"


def ids_doubt(before: Glimpse, now: Glimpse) -> str:
    """Numbers that do not last from one message to the next."""
    if before.epoch != now.epoch or min(len(before.ids), len(now.ids)) < 3:
        return ""
    same = np.isin(now.ids, before.ids).mean()
    if same > 0.1 or (now.time - before.time) / 1e9 > 30.0:
        return ""
    return "its ids are new in every message: one id must stand for the same track as long as that lives"


def order_doubt(before: Glimpse, now: Glimpse) -> str:
    """Components in another order than `space` says, or velocities in another unit, by how the places change."""
    space, seconds = now.space, (now.time - before.time) / 1e9
    if space != before.space or before.epoch != now.epoch or not 0.01 < seconds < 60.0:
        return ""
    if not {"x", "y", "vx", "vy"} <= set(space) or not (before.plain and now.plain):
        return ""
    _, old, new = np.intersect1d(before.ids, now.ids, return_indices=True)
    if not len(old):
        return ""
    first, last = before.means[old], now.means[new]
    if not (np.isfinite(first).all() and np.isfinite(last).all()):
        return ""
    columns = dict(zip(space, range(len(space)), strict=True))
    told = tuple(name for name in space if name in ("x", "y", "vx", "vy"))
    slots = [columns[name] for name in told]
    errors = {}
    for order in (told, *ORDERS):
        at = dict(zip(order, slots, strict=True))
        rate = (last[:, [at["x"], at["y"]]] - first[:, [at["x"], at["y"]]]) / seconds
        said = last[:, [at["vx"], at["vy"]]]
        size = np.maximum(np.hypot(*rate.T), np.hypot(*said.T))
        errors[order] = float(np.median(np.hypot(*(rate - said).T) / np.maximum(size, 1e-9))), float(np.median(size))
    wrong, size = errors[told]
    places = [columns["x"], columns["y"]]
    spread = (before.covariances[old][:, places, places] + now.covariances[new][:, places, places]).sum(axis=1)
    noise = float(np.median(np.sqrt(np.maximum(spread, 0.0)))) / seconds
    if wrong < 0.8 or size < max(1.0, MOST_SIGMAS * noise):
        return ""
    best = min(ORDERS, key=lambda order: errors[order][0])
    if errors[best][0] < 0.25 and best != told:
        names = ", ".join(best)
        return f"its tracks move as if the numbers were in the order {names}, not {', '.join(told)}: is space right?"
    return "its tracks do not move by the velocities that they say: are vx and vy in m/s, in the axes of the frame?"
