"""Rows of points, lines and ellipses, each placed on the plane and on the map; and what every entity shows now.

The opacity of a point says its existence, or the weight of its component, as class 0..15, whose colours are static
(`styles`). On the map lines have no classes, only widths.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.recording.columns import ColumnWriter, Lines, Points, Stamp
from fusion_service.recording.drawing.geometry import CORNERS, Chart, Outline, Place, ellipses
from fusion_service.recording.drawing.tables import COASTING, LEVELS, Table, hold, levels
from schemas import Frame

__all__ = ["WIDTH", "Canvas"]

FEW = 100
"""Components of one message whose ellipses are drawn finely."""
WIDTH = 1.5
"""Of the ellipse of a global track, and of a component of weight 1, in points of the screen."""


class Canvas:
    """Writes rows of `columns`. `chart` must be set before anything is placed. tables: what an entity shows now."""

    def __init__(self, columns: ColumnWriter, frame: Frame | None = None) -> None:
        self.columns = columns
        self.chart: Chart | None = None if frame is None else Chart(frame)
        self.tables: dict[str, Table] = {}

    @property
    def placing(self) -> Chart:
        """The chart, which is there by now."""
        assert self.chart is not None, "a chart comes first"
        return self.chart

    def points(self, path: str, place: Place, labels: list[str], stamp: Stamp) -> None:
        """Points without classes."""
        self.columns.points(path, stamp, self._points(place, labels))

    def tracks(self, path: str, table: Table, labels: list[str], stamp: Stamp) -> None:
        """The rows of `table` as points, as opaque as their mass."""
        self.columns.points(path, stamp, self._points(table.place, labels, levels(table)))

    def lines(
        self, path: str, xy: Floats, z: Floats, lengths: NDArray[np.int64], stamp: Stamp, *, stands: bool = True
    ) -> None:
        """S strips of `lengths` (S,) one after another: xy (P, 2) m, z (P,) m."""
        self.columns.lines(path, stamp, self._lines(xy, z, lengths), stands=stands)

    def ellipses(self, path: str, table: Table, stamp: Stamp, *, weighed: bool = False, dashed: bool = False) -> None:
        """`weighed`: opacity and width by mass. `dashed`: while a track coasts."""
        corners = CORNERS if dashed or not weighed or len(table.ids) <= FEW else CORNERS // 2
        drawn: Outline = ellipses(table.place, (table.codes == COASTING) & dashed, corners)
        z = np.repeat(table.place.z[drawn.owner], drawn.lengths)
        looks: dict[str, Any] = {}
        if weighed:
            classes = levels(table)[drawn.owner]
            looks = {"classes": classes, "widths": WIDTH * (0.2 + 0.8 * classes / (LEVELS - 1))}
        self.columns.lines(f"{path}/ellipses", stamp, self._lines(drawn.xy, z, drawn.lengths, **looks))

    def trail(self, path: str, new: Table, time: int, keep: int, stamp: Stamp) -> Table:
        """Draw a line from each track's place before to its place in `new`, and see `hold`."""
        old = self.tables.get(path)
        if old is not None and old.epoch == new.epoch and len(old.ids) and time >= old.times.max():
            _, before, after = np.intersect1d(old.ids, new.ids, assume_unique=True, return_indices=True)
            ends = np.stack([old.place.xy[before], new.place.xy[after]], axis=1).reshape(-1, 2)
            z = np.stack([old.place.z[before], new.place.z[after]], axis=1).reshape(-1)
            self.lines(f"{path}/trail", ends, z, np.full(len(before), 2), stamp, stands=False)
        return self.hold(path, new, new.ids, time, keep)

    def hold(self, path: str, new: Table, listed: NDArray[np.uint64], time: int, keep: int) -> Table:
        """What is drawn now: `new`, and what was known at most `keep` ns ago of tracks that are not `listed`. A
        message older than the last is drawn alone, at its own time."""
        old = self.tables.get(path)
        if old is not None and old.epoch == new.epoch and len(old.ids) and time < old.times.max():
            return new
        if keep:
            new = hold(old, new, listed, time - keep)
        self.tables[path] = new
        return new

    def _points(self, place: Place, labels: list[str], classes: NDArray[np.uint16] | None = None) -> Points:
        return Points(self.placing.plane(place.xy), self.placing.geo(place.xy, place.z), labels, classes)

    def _lines(self, xy: Floats, z: Floats, lengths: NDArray[np.int64], **looks: Any) -> Lines:
        return Lines(self.placing.plane(xy), self.placing.geo(xy, z), lengths, **looks)
