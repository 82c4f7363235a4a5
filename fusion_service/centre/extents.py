"""What is known of the extent of objects: columns of local tracks and of global ones, and what they add to densities.

A local track's column has the rows

    0-2  length, width (full, m) and heading of the long axis (rad, in the picture's frame: x to y; in ECEF from east)
    3-5  their standard deviations          6  1 for a box          7  index into `REFERENCES` of the reported point
    8-10 xx, xy, yy: covariance, m2, of where that point lies from the object's centre, in the horizontal plane

and a global track's (see `extent_fusion`)

    0-2  log length, log width, heading     3-5  their standard deviations     6  1 for a box

NaN is what is not known. A point somewhere on an ellipse has variance (length / 4)^2 along and (width / 4)^2 across,
on a box length^2 / 12 and width^2 / 12. Where only the length is known the object is as wide as it is long.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Floats
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.rows import Rows
from fusion_service.centre.tracks import EXTENT_ROWS, Tracks
from fusion_service.geodesy import axis_turn, level_axes
from fusion_service.records import altered
from schemas import REFERENCES, SHAPES, Ecef, Frame, LocalTracks

__all__ = ["BLOB", "message_extents", "off_centre", "shaped", "tells_extent", "turned", "widened", "with_reference"]

BOX = SHAPES.index("box")
CENTRE, ANTENNA, NEAREST, BLOB = range(len(REFERENCES))
IN_ELLIPSE, IN_BOX, ON_EDGE = 1 / 16, 1 / 12, 1 / 8
"""Variance of a coordinate of a point of the object, in squares of its full size: anywhere in it, or on its edge."""
NEGLIGIBLE = 0.01
"""Of the variance of a place: what a reference point may add and still be no error of its own."""

Densities = TypeVar("Densities", Tracks, Picture)


def message_extents(
    messages: Sequence[LocalTracks], sound: Sequence[NDArray[np.bool_]], means: Floats, frame: Frame
) -> Floats:
    """The column (E, T) of the sound tracks of messages of one space and frame, whose means (n, T) are in `frame`."""
    if not any(tells_extent(message) for message in messages):
        return np.zeros((0, means.shape[1]))
    column = np.concatenate([_as_said(m, rows) for m, rows in zip(messages, sound, strict=True)], axis=1)
    first = messages[0]
    return _turned(column, axis_turn(means, first.space, first.frame, frame))


def tells_extent(message: LocalTracks) -> bool:
    """Whether anything is said of the extents of its tracks, or of a reference point that is not their centre."""
    return not (message.extent is message.reference_covariances is None and message.reference in (None, "centre"))


def _as_said(message: LocalTracks, sound: Bools) -> Floats:
    """The column of one message, in its own frame, with what its reference point makes of its extents."""
    column = np.full((EXTENT_ROWS, int(sound.sum())), np.nan)
    if message.extent is not None:
        column[0:3] = message.extent[sound].T
    if message.extent_sigma is not None:
        column[3:6] = message.extent_sigma[sound].T
    column[6] = float(message.shape == SHAPES[BOX])
    column[7] = code = REFERENCES.index(message.reference) if message.reference in REFERENCES else CENTRE
    if code != CENTRE:
        share = ON_EDGE if code == NEAREST else _share(column[6])
        column[8:11] = _spread(column[0], column[1], column[2], share)
    if message.reference_covariances is not None:
        given = message.reference_covariances[sound]
        xx, xy, yy = given[:, 0, 0], given[:, 1, 0], given[:, 1, 1]
        column[8:11] = np.where(np.isfinite(xx), np.stack([xx, xy, yy]), column[8:11])
    return column


def turned(tracks: Densities, space: tuple[str, ...], frame: Frame, wanted: Frame) -> Densities:
    """Tracks of which all but the extents has been brought from `frame` into `wanted`, with these too."""
    if not len(tracks.extent):
        return tracks
    return altered(tracks, extent=_turned(tracks.extent, axis_turn(tracks.mean, space, frame, wanted)))


def _turned(column: Floats, angle: Floats) -> Floats:
    """A column with all headings grown by `angle` (T,)."""
    if not angle.any():
        return column
    column = column.copy()
    column[2] += angle
    if len(column) == EXTENT_ROWS:
        xx, xy, yy = column[8:11]
        c, s = np.cos(angle), np.sin(angle)
        column[8] = c * c * xx - 2 * c * s * xy + s * s * yy
        column[9] = c * s * (xx - yy) + (c * c - s * s) * xy
        column[10] = s * s * xx + 2 * c * s * xy + c * c * yy
    return column


def _share(box: Floats) -> Floats:
    return np.where(box == 1.0, IN_BOX, IN_ELLIPSE)


def _spread(length: Floats, width: Floats, heading: Floats, share: Floats | float) -> Floats:
    """xx, xy, yy (3, T) of a point of objects: `share` of the squared sizes. Where only one size is known it stands for
    both, without a heading the length does; NaN where nothing is known."""
    along = np.where(np.isnan(length), width, length)
    across = np.where(np.isnan(width) | np.isnan(heading), along, np.minimum(width, along))
    angle = np.where(np.isnan(heading), 0.0, heading)
    c, s = np.cos(angle), np.sin(angle)
    a, b = share * along * along, share * across * across
    return np.stack([c * c * a + s * s * b, c * s * (a - b), s * s * a + c * c * b])


def with_reference(tracks: Tracks, space: tuple[str, ...], frame: Frame | None) -> Tracks:
    """Tracks as densities of the centres of their objects: what the reported point may be off is an error besides
    their own."""
    return widened(tracks, tracks.extent[8:11], space, frame) if len(tracks.extent) else tracks


def shaped(rows: Rows, now: Picture, space: tuple[str, ...], frame: Frame | None) -> tuple[Rows, Picture]:
    """Rows and global tracks as association sees them: as wide as their objects are, along and across. Of a row that
    says how far its point may lie from the centre that is so already. The columns of links are the same arrays."""
    if len(now.extent):
        length, width = np.exp(now.extent[0:2])
        now = widened(now, _spread(length, width, now.extent[2], _share(now.extent[6])), space, frame)
    column = rows.tracks.extent
    if len(column):
        spread = _spread(column[0], column[1], column[2], _share(column[6]))
        spread = np.where(np.isnan(column[8:11]), spread, 0.0)
        rows = altered(rows, tracks=widened(rows.tracks, spread, space, frame))
    return rows, now


def off_centre(rows: Rows, space: tuple[str, ...]) -> Bools:
    """Rows (M,) whose reported point may lie off the centre by more than is negligible: an error that is the same from
    report to report."""
    column = rows.tracks.extent
    if not len(column):
        return np.zeros(len(rows.source), dtype=np.bool_)
    variance = sum(rows.tracks.covariance[place, place] for place in map(space.index, "xy"))
    return np.asarray(np.nan_to_num(column[8] + column[10]) > NEGLIGIBLE * variance)


def widened(tracks: Densities, spread: Floats, space: tuple[str, ...], frame: Frame | None) -> Densities:
    """Densities with the covariance xx, xy, yy (3, T), m2, of the horizontal plane added; NaN adds nothing."""
    spread = np.nan_to_num(spread)
    if not spread.any():
        return tracks
    more = _in_space(tracks.mean, spread, space, frame)
    covariance, parts = tracks.covariance + more, tracks.part_covariance + more[:, :, None]
    return altered(tracks, covariance=covariance, part_covariance=parts)


def _in_space(means: Floats, spread: Floats, space: tuple[str, ...], frame: Frame | None) -> Floats:
    """Covariances (n, n, T) of xx, xy, yy (3, T): in x and y, or in ECEF in the plane that is level at each mean."""
    more = np.zeros((len(space), len(space), spread.shape[1]))
    if not isinstance(frame, Ecef):
        x, y = space.index("x"), space.index("y")
        more[x, x], more[x, y], more[y, x], more[y, y] = spread[0], spread[1], spread[1], spread[2]
        return more
    east, north = (np.nan_to_num(axis) for axis in level_axes(means, space, frame))
    for i, one in enumerate("xyz"):
        for j, other in enumerate("xyz"):
            mixed = east[i] * north[j] + north[i] * east[j]
            value = spread[0] * (east[i] * east[j]) + spread[1] * mixed + spread[2] * (north[i] * north[j])
            more[space.index(one), space.index(other)] = value
    return more
