"""Outlines of objects in the plane: rectangles and ellipses as polygons, and how far a point lies from one."""

from __future__ import annotations

import numpy as np

from fusion_service.arrays import Bools, Floats
from schemas.extents import sound_extents

__all__ = ["CORNERS", "centres", "drawable", "outlines", "to_hulls"]

CORNERS = 48
"""Of an ellipse's polygon, which lies inside it by at most 0.2 % of its size."""
BLOCK = 4096


def drawable(extent: Floats) -> Bools:
    """Which of extents (T, 3), length, width (m) and heading (rad), are sound and known in all three."""
    return np.asarray(np.isfinite(extent).all(axis=1) & sound_extents(extent))


def centres(places: Floats, extent: Floats, offset: Floats | None) -> Floats:
    """The centres (T, 2) of hulls whose points at `offset` (T, 2), along the heading and to the left of it, are at
    `places` (T, 2); an offset that is not known, or beyond the hull's length, counts as none."""
    if offset is None:
        return places
    known = np.isfinite(offset[:, 0]) & (np.abs(offset) <= extent[:, :1]).all(axis=1)
    along, left = np.where(known, offset.T, 0.0)
    c, s = np.cos(extent[:, 2]), np.sin(extent[:, 2])
    return np.asarray(places - np.stack([c * along - s * left, s * along + c * left], axis=1))


def outlines(places: Floats, extent: Floats, box: bool) -> Floats:
    """Closed polygons (T, P + 1, 2) about the centres `places` (T, 2), anticlockwise; P is 4 for a box."""
    if box:
        unit = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5], [0.5, 0.5]])
    else:
        angle = np.linspace(0.0, 2 * np.pi, CORNERS + 1)
        unit = 0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        unit[-1] = unit[0]
    x, y = unit[:, 0] * extent[:, 0, None], unit[:, 1] * extent[:, 1, None]
    c, s = np.cos(extent[:, 2, None]), np.sin(extent[:, 2, None])
    return np.stack([c * x - s * y, s * x + c * y], axis=2) + places[:, None, :]


def to_hulls(points: Floats, polygons: Floats, covariances: Floats) -> tuple[Floats, Floats]:
    """Of points (B, 2) and convex polygons (B, P + 1, 2): the distance (B,), m, to the nearest point of each hull, 0
    inside; and the least d2 (B,), by `covariances` (B, 2, 2), of all its points to the point."""
    parts = [slice(start, start + BLOCK) for start in range(0, len(points), BLOCK)] or [slice(0)]
    identity = np.broadcast_to(np.eye(2), covariances.shape)
    plain = [_least(points[part], polygons[part], identity[part]) for part in parts]
    scaled = [_least(points[part], polygons[part], covariances[part]) for part in parts]
    return np.sqrt(np.concatenate(plain)), np.concatenate(scaled)


def _least(points: Floats, polygons: Floats, covariances: Floats) -> Floats:
    """Least d2 (B,) to the edges, 0 inside: on an edge p + t e, t = clip(e' P^-1 (x - p) / e' P^-1 e)."""
    begin, edge = polygons[:, :-1], np.diff(polygons, axis=1)
    gap = points[:, None, :] - begin
    inside = (edge[..., 0] * gap[..., 1] - edge[..., 1] * gap[..., 0] >= 0).all(axis=1)
    a, b, d = (covariances[:, i, j, None] for i, j in ((0, 0), (1, 0), (1, 1)))
    det = a * d - b * b

    def product(u: Floats, v: Floats) -> Floats:
        """u' P^-1 v."""
        whole = d * u[..., 0] * v[..., 0] - b * (u[..., 0] * v[..., 1] + u[..., 1] * v[..., 0])
        return np.asarray((whole + a * u[..., 1] * v[..., 1]) / det)

    with np.errstate(invalid="ignore", divide="ignore"):
        t = np.clip(product(edge, gap) / product(edge, edge), 0.0, 1.0)
        rest = gap - t[..., None] * edge
        least = np.maximum(product(rest, rest), 0.0).min(axis=1)
    return np.where(inside, 0.0, least)
