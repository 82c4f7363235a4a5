"""Places on the WGS84 ellipsoid, and Gaussian states moved between frames.

Latitude and longitude in degrees, altitude in m above the ellipsoid, ENU about an origin: x east, y north,
z up. Positions follow Bowring (1976), iterated twice, in its form without trigonometry.

`transform` uses only element-wise arithmetic and square roots, which IEEE 754 rounds exactly, so a state's
result is the same, bit for bit, whatever batch surrounds it.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from fusion_service.arrays import Bools, Floats
from fusion_service.errors import FusionError
from fusion_service.linalg import congruence, matvec, outer, to_first, to_last
from schemas import Ecef, Enu, Frame, Height, Local

__all__ = [
    "FrameError",
    "axis_turn",
    "ecef_to_geodetic",
    "enu_to_geodetic",
    "geodetic_to_ecef",
    "geodetic_to_enu",
    "level_axes",
    "surface",
    "transform",
    "vertical",
]

Triple = tuple[Floats, Floats, Floats]

A = 6378137.0
"""Semi-major axis, m."""
F = 1 / 298.257223563
"""Flattening."""
B = A * (1 - F)
E2 = F * (2 - F)

NEWTON_STEPS = 4
"""From the paraboloid onto the height surface: two reach 1e-9 m at 1,000 km, three at 3,000 km, four at 5,000 km."""
MAX_HEIGHT_ERROR = 1e-6

DERIVATIVES = (("x", "y", "z"), ("vx", "vy", "vz"), ("ax", "ay", "az"))


class FrameError(FusionError, ValueError):
    """A state cannot be moved from one frame to the other; the message says which and why."""


def geodetic_to_ecef(lat: ArrayLike, lon: ArrayLike, alt: ArrayLike) -> Triple:
    """ECEF x, y, z in m (...) of latitude and longitude in degrees (...) and altitude in m (...)."""
    phi, lam, h = np.radians(lat), np.radians(lon), np.asarray(alt, dtype=np.float64)
    sin_phi, cos_phi = np.sin(phi), np.cos(phi)
    normal = A / np.sqrt(1 - E2 * sin_phi * sin_phi)
    p = (normal + h) * cos_phi
    return p * np.cos(lam), p * np.sin(lam), (normal * (1 - E2) + h) * sin_phi


def ecef_to_geodetic(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Triple:
    """Latitude and longitude in degrees and altitude in m (...) of ECEF x, y, z in m (...). NaN at the centre."""
    x, y, z = (np.asarray(v, dtype=np.float64) for v in (x, y, z))
    (nx, ny, nz), alt = _normal_and_altitude(x, y, z)
    return np.degrees(np.arctan2(nz, np.sqrt(nx * nx + ny * ny))), np.degrees(np.arctan2(y, x)), alt


def geodetic_to_enu(lat: ArrayLike, lon: ArrayLike, alt: ArrayLike, origin: Enu) -> Triple:
    """East, north, up in m (...) about `origin`."""
    axes, centre = _axes(origin)
    dx, dy, dz = (v - c for v, c in zip(geodetic_to_ecef(lat, lon, alt), centre, strict=True))
    east, north, up = (e[0] * dx + e[1] * dy + e[2] * dz for e in axes)
    return east, north, up


def enu_to_geodetic(x: ArrayLike, y: ArrayLike, z: ArrayLike, origin: Enu) -> Triple:
    """Latitude and longitude in degrees and altitude in m (...) of east, north, up in m (...) about `origin`."""
    (e, n, u), centre = _axes(origin)
    east, north, up = (np.asarray(v, dtype=np.float64) for v in (x, y, z))
    return ecef_to_geodetic(*(centre[i] + e[i] * east + n[i] * north + u[i] * up for i in range(3)))


def transform(
    means: Floats,
    covariances: Floats,
    space: tuple[str, ...],
    source: Frame,
    target: Frame,
    height: Height | None = None,
) -> tuple[Floats, Floats]:
    """Gaussian states (..., n), (..., n, n) of `space`, moved from frame `source` to frame `target`.

    With z in the space: exact rotation and translation of position, velocity and acceleration. A derivative
    that the space lacks counts as zero (between ENU frames only). turn_rate passes.

    Without z, between ENU frames: the place is where the source's vertical through (x, y) meets the surface
    `height.value` (default 0) above the ellipsoid, and its (x, y) in the target are kept. The covariance goes
    by the Jacobian J of that map; velocities and accelerations turn with J at the mean, their terms in the
    curvature (|v|/R per metre) are left out. `height.sigma` adds to the covariance of the position. A vertical
    that misses the surface (thousands of km away) gives NaN.

    Equal frames return the arguments themselves. Raises `FrameError` between frames that have no relation
    (local ones, ECEF without z) or where a derivative in the space cannot be moved.
    """
    if source == target:
        return means, covariances
    _check(space, source, target)
    batch = means.shape[:-1]
    x, P = to_last(means, 1), to_last(covariances, 2)
    with np.errstate(all="ignore"):
        if "z" in space:
            x, P = _rigid(x, P, space, source, target)
        else:
            x, P = _on_surface(x, P, space, source, target, height or Height())
    return to_first(x, batch, 1), to_first(P, batch, 2)


def vertical(means: Floats, space: tuple[str, ...], frame: Enu | Ecef) -> Floats:
    """Up (3, B), of length 1 in the axes of `frame`, at the places of states (n, B) of `space`, which has x, y and z:
    the outward normal of the ellipsoid. NaN at the centre of the earth."""
    axes, centre = _axes(frame)
    x, y, z = (means[space.index(name)] for name in "xyz")
    with np.errstate(all="ignore"):
        place = [centre[i] + axes[0, i] * x + axes[1, i] * y + axes[2, i] * z for i in range(3)]
        normal, _ = _normal_and_altitude(*place)
        return np.stack([_dot(list(row), normal) for row in axes])


def level_axes(means: Floats, space: tuple[str, ...], frame: Enu | Ecef) -> tuple[Floats, Floats]:
    """East and north (3, B), of length 1 in the axes of `frame`, at the places of states (n, B) of `space`; without z
    those on the plane z = 0. NaN at the poles."""
    axes, _ = _axes(frame)
    x, y = (means[space.index(name)] for name in "xy")
    z = means[space.index("z")] if "z" in space else np.zeros_like(x)
    up, pole = vertical(np.stack([x, y, z]), ("x", "y", "z"), frame), axes[:, 2]
    with np.errstate(all="ignore"):
        east = _cross(list(pole), list(up))
        length = np.sqrt(_dot(east, east))
        east = [part / length for part in east]
    return np.stack(east), np.stack(_cross(list(up), east))


def axis_turn(means: Floats, space: tuple[str, ...], source: Frame, target: Frame) -> Floats:
    """By how much (B,), rad, a heading in `source` grows when it is told in `target`, at the places of states (n, B) in
    `target`: headings count from x to y, in an ECEF frame from east to north. That the planes of two ENU frames are
    tilted against each other is left out: (distance / Earth radius)^2 / 4 at most. 0 where nothing relates them."""
    if source == target or isinstance(source, Local) or isinstance(target, Local):
        return np.zeros(means.shape[1:])
    east, north = level_axes(means, space, target)
    to_axes, _ = _axes(target)
    x = east if isinstance(source, Ecef) else (to_axes @ _axes(source)[0][0])[:, None] + np.zeros_like(east)
    along = (_dot(x, east), _dot(x, north)) if isinstance(target, Ecef) else (x[0], x[1])
    return np.nan_to_num(np.arctan2(along[1], along[0]))


def _cross(a: list[Floats], b: list[Floats]) -> list[Floats]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _check(space: tuple[str, ...], source: Frame, target: Frame) -> None:
    for frame, other in ((source, target), (target, source)):
        if isinstance(frame, Local):
            raise FrameError(f"the local frame {frame.name!r} has no known relation to {_name(other)}")
    with_ecef = isinstance(source, Ecef) or isinstance(target, Ecef)
    if with_ecef and "z" not in space:
        raise FrameError(f"from {_name(source)} to {_name(target)} a state needs z (its space: {' '.join(space)})")
    for names in DERIVATIVES[1:]:
        present = [name for name in names if name in space]
        if "z" not in space and names[2] in space:
            raise FrameError(f"{names[2]} cannot be moved between frames without z (space: {' '.join(space)})")
        if with_ecef and present and len(present) < 3:
            raise FrameError(f"to or from ECEF a state needs all of {' '.join(names)} or none, not {' '.join(present)}")


def _name(frame: Frame) -> str:
    if isinstance(frame, Enu):
        return f"ENU about {frame.lat:g} {frame.lon:g} {frame.alt:g}"
    return f"the local frame {frame.name!r}" if isinstance(frame, Local) else "ECEF"


def _rigid(x: Floats, P: Floats, space: tuple[str, ...], source: Frame, target: Frame) -> tuple[Floats, Floats]:
    """Rotation and translation of states with z: x (n, B), P (n, n, B)."""
    axes, centre = _axes(source)
    to_axes, to_centre = _axes(target)
    rotation = to_axes @ axes.T
    jacobian = np.eye(len(space))
    for i, j, row, column in _pairs(space):
        jacobian[i, j] = rotation[row, column]
    shift = np.zeros((len(space), 1))
    shift[[space.index(name) for name in "xyz"], 0] = to_axes @ (centre - to_centre)
    return matvec(jacobian, x) + shift, congruence(jacobian, P)


def _on_surface(
    x: Floats, P: Floats, space: tuple[str, ...], source: Frame, target: Frame, height: Height
) -> tuple[Floats, Floats]:
    """States without z, x (n, B) and P (n, n, B), moved along the surface of equal altitude."""
    (e, n, u), _ = _axes(source)
    to_axes, to_centre = _axes(target)
    ix, iy = space.index("x"), space.index("y")
    assert isinstance(source, Enu)
    place, _, normal, lost = _meeting(x[ix], x[iy], source, height.value)
    slope = 1 / _dot(u, normal)
    dz = (-_dot(e, normal) * slope, -_dot(n, normal) * slope)
    along = [[axis[i] + u[i] * d for i in range(3)] for axis, d in zip((e, n), dz, strict=True)]
    jacobian = np.zeros((len(space), *x.shape))
    jacobian[range(len(space)), range(len(space))] = 1.0
    for i, j, row, column in _pairs(space):
        jacobian[i, j] = _dot(to_axes[row], along[column])

    moved, covariance = matvec(jacobian, x), congruence(jacobian, P)
    offset = [place[i] - to_centre[i] for i in range(3)]
    moved[ix], moved[iy] = _dot(to_axes[0], offset), _dot(to_axes[1], offset)
    if height.sigma > 0:
        lift = np.zeros_like(x)
        lift[ix], lift[iy] = (height.sigma * slope * _dot(to_axes[k], u) for k in range(2))
        covariance = covariance + outer(lift, lift)
    moved[:, lost] = np.nan
    covariance[:, :, lost] = np.nan
    return moved, covariance


def surface(x: Floats, y: Floats, origin: Enu, alt: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Where verticals of `origin` through (x, y), m, (B,) meet the surface `alt` m above the ellipsoid: z there, dz/dx,
    dz/dy and dz/dalt (B,). NaN where they miss it, thousands of km away."""
    with np.errstate(all="ignore"):
        (e, n, u), _ = _axes(origin)
        _, z, normal, lost = _meeting(x, y, origin, alt)
        rise = 1 / _dot(u, normal)
        found = (z, -_dot(e, normal) * rise, -_dot(n, normal) * rise, rise)
        z, slope_x, slope_y, rise = (np.where(lost, np.nan, part) for part in found)
    return z, slope_x, slope_y, rise


def _meeting(x: Floats, y: Floats, origin: Enu, alt: float) -> tuple[list[Floats], Floats, Triple, Bools]:
    """The place in ECEF where verticals of `origin` through (x, y) reach the altitude, z there, the normal of the
    ellipsoid below it, and which never do."""
    (e, n, u), centre = _axes(origin)
    foot = [centre[i] + e[i] * x + n[i] * y for i in range(3)]
    z = (alt - origin.alt) - (x * x + y * y) / (2 * A)
    for _ in range(NEWTON_STEPS):
        normal, altitude = _normal_and_altitude(*(foot[i] + u[i] * z for i in range(3)))
        z = z - (altitude - alt) / _dot(u, normal)
    place = [foot[i] + u[i] * z for i in range(3)]
    normal, altitude = _normal_and_altitude(*place)
    return place, z, normal, ~(np.abs(altitude - alt) <= MAX_HEIGHT_ERROR)


def _pairs(space: tuple[str, ...]) -> list[tuple[int, int, int, int]]:
    """(i, j, axis of i, axis of j) for components i, j of `space` that are one derivative of the position."""
    return [
        (space.index(to), space.index(name), row, column)
        for names in DERIVATIVES
        for row, to in enumerate(names)
        for column, name in enumerate(names)
        if to in space and name in space
    ]


def _dot(a: Floats | list[Floats] | Triple, b: Floats | list[Floats] | Triple) -> Floats:
    out: Floats = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return out


@lru_cache(maxsize=1024)
def _axes(frame: Frame) -> tuple[Floats, Floats]:
    """The frame's axes (3, 3), one per row, and its origin (3,), both in ECEF. Read only."""
    if isinstance(frame, Enu):
        phi, lam = math.radians(frame.lat), math.radians(frame.lon)
        sp, cp, sl, cl = math.sin(phi), math.cos(phi), math.sin(lam), math.cos(lam)
        axes = np.array([[-sl, cl, 0.0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])
        origin = np.array(geodetic_to_ecef(frame.lat, frame.lon, frame.alt))
    else:
        axes, origin = np.eye(3), np.zeros(3)
    axes.flags.writeable = origin.flags.writeable = False
    return axes, origin


def _normal_and_altitude(x: Floats, y: Floats, z: Floats) -> tuple[Triple, Floats]:
    """Outward unit normal of the ellipsoid below (x, y, z), and the altitude above it.

    Bowring: tan phi = (z + e'^2 b sin^3 beta) / (p - e^2 a cos^3 beta), tan beta = (1 - f) tan phi, from
    tan beta = a z / (b p); sines and cosines are kept as the sides of a triangle.
    """
    with np.errstate(all="ignore"):
        p = np.sqrt(x * x + y * y)
        sine, cosine = A * z, B * p
        for _ in range(2):
            side = np.sqrt(sine * sine + cosine * cosine)
            sine, cosine = sine / side, cosine / side
            up = z + (E2 / (1 - E2) * B) * (sine * sine * sine)
            out = p - (E2 * A) * (cosine * cosine * cosine)
            sine, cosine = (1 - F) * up, out
        side = np.sqrt(up * up + out * out)
        sine, cosine = up / side, out / side
        altitude = p * cosine + z * sine - A * np.sqrt(1 - E2 * sine * sine)
        pole = p == 0.0
        scale = cosine / np.where(pole, 1.0, p)
        return (x * scale, y * scale, sine), altitude
