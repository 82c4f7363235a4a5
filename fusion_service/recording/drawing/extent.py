"""How far what is drawn reaches, and the grid under it.

/grid                                on the plane only;  .../labels
"""

from __future__ import annotations

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.colours import SCREEN_GRID, SCREEN_TRUTH, packed
from fusion_service.recording.columns import ColumnWriter, import_rerun
from fusion_service.recording.drawing.geometry import grid

__all__ = ["FAINT", "Corners", "Extent"]

FAINT = 70
"""Opacity of its lines, of 255: seen on a dark view and on a light one."""

Corners = tuple[Floats, Floats]
"""South-west and north-east (2,), m."""


class Extent:
    """Grows with what is drawn: sensors, global tracks and truth (`main`), or else the local tracks. `square`: what the
    grid covers, which grows in steps; None while nothing is drawn."""

    def __init__(self, columns: ColumnWriter) -> None:
        self._rr = import_rerun()
        self._columns = columns
        self._reached: dict[bool, Corners] = {}
        self.square: Corners | None = None

    def grow(self, xy: Floats, *, main: bool) -> bool:
        """Let it hold `xy` (T, 2), m; whether the grid is another now."""
        if not len(xy):
            return False
        low, high = xy.min(axis=0), xy.max(axis=0)
        if main in self._reached:
            low, high = np.minimum(low, self._reached[main][0]), np.maximum(high, self._reached[main][1])
        self._reached[main] = low, high
        if not main and True in self._reached:
            return False
        if self.square is not None and (self.square[0] <= low).all() and (high <= self.square[1]).all():
            return False
        centre, half = (low + high) / 2, max(float((high - low).max()) / 2, 10.0) * 1.1
        self.square = centre - half, centre + half
        self._draw(centre - 0.94 * half)
        return True

    def _draw(self, corner: Floats) -> None:
        """The grid, with its labels along the edges through `corner` (2,)."""
        assert self.square is not None
        lines, labels = grid(*self.square)
        rr, tone = self._rr, packed(SCREEN_GRID, FAINT)
        plane = [line * (1, -1) for line in lines]
        self._columns.static("/grid", rr.LineStrips2D(plane, colors=[tone], radii=[-0.5], draw_order=1.0))
        places = [np.where(line[0] == line[1], line[0], corner) * (1, -1) for line in lines]
        text = packed(SCREEN_TRUTH)
        self._columns.static("/grid/labels", rr.Points2D(places, labels=labels, colors=[text], radii=[-0.5]))
