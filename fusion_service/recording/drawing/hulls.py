"""What is drawn of the extents of objects: rectangles and ellipses about tracks and truth.

    .../hull     of the tracks or the truth above it; of a track that is not told how large it is, nothing

A hull is of the true or the estimated size: it says nothing of what is uncertain, as the ellipses do.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Floats
from fusion_service.geodesy import axis_turn
from fusion_service.hulls import centres, drawable, outlines
from fusion_service.recording.columns import Stamp
from fusion_service.recording.drawing.canvas import Canvas
from fusion_service.recording.drawing.styles import Styles
from fusion_service.recording.drawing.tables import Table
from schemas import GlobalTracks, LocalTracks, Truth

__all__ = ["Hulls"]


class Hulls:
    """Draws the hulls of one recording."""

    def __init__(self, canvas: Canvas, styles: Styles) -> None:
        self._canvas, self._styles = canvas, styles
        self._known: dict[str, tuple[NDArray[np.uint64], Floats]] = {}

    def draw(self, path: str, message: LocalTracks | GlobalTracks | Truth, table: Table, stamp: Stamp) -> None:
        """A row for what `table` shows of the message at `path`, where there are extents, or were before."""
        if message.extent is None and path not in self._known:
            return
        self._styles.hulls(path)
        ids, extent = self._sizes(path, message, table)
        some = drawable(extent)
        at = np.searchsorted(ids, table.ids[np.isin(table.ids, ids[some])])
        rows = np.flatnonzero(np.isin(table.ids, ids[some]))
        xy, z, extent = table.place.xy[rows], table.place.z[rows], extent[at].copy()
        extent[:, 2] += axis_turn(xy.T, ("x", "y"), message.frame, self._canvas.placing.frame)
        if isinstance(message, Truth) and message.extent_offset is not None:
            order = np.argsort(message.ids)
            place = order[np.searchsorted(message.ids[order], table.ids[rows])]
            xy = centres(xy, extent, message.extent_offset[place])
        rings = outlines(xy, extent, message.shape == "box")
        corners = rings.shape[1]
        lengths = np.full(len(rings), corners, dtype=np.int64)
        self._canvas.lines(f"{path}/hull", rings.reshape(-1, 2), np.repeat(z, corners), lengths, stamp)

    def _sizes(
        self, path: str, message: LocalTracks | GlobalTracks | Truth, table: Table
    ) -> tuple[NDArray[np.uint64], Floats]:
        """Ids, sorted, and extents of all that the table shows: of the message, or said before of what stays drawn."""
        ids, extent = message.ids, message.extent
        if extent is None:
            extent = np.full((len(ids), 3), np.nan)
        if path in self._known:
            before, sizes = self._known[path]
            stays: Bools = np.isin(before, table.ids) & ~np.isin(before, ids)
            ids, extent = np.concatenate([before[stays], ids]), np.concatenate([sizes[stays], extent])
        order = np.argsort(ids, kind="stable")
        self._known[path] = ids[order], extent[order]
        return self._known[path]

    def clear(self, path: str, stamp: Stamp) -> None:
        """Draw none at `path` until there are again."""
        if self._known.pop(path, None) is not None:
            none = np.zeros(0, dtype=np.int64)
            self._canvas.lines(f"{path}/hull", np.zeros((0, 2)), np.zeros(0), none, stamp)
