"""How a recording opens: the map and the plane on the left, charts and the log on the right."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.recording.columns import import_rerun
from schemas import Enu, Frame

__all__ = ["blueprint"]

Corners = tuple[NDArray[np.float64], NDArray[np.float64]]

PIXELS = 700
"""What a map of usual size shows of the picture's height."""
METRES_PER_PIXEL = 156543.034
"""On the equator at zoom 0 (Web Mercator, tiles of 256 pixels)."""


def blueprint(frame: Frame | None, bounds: Corners | None, trails: Sequence[str], trail: float) -> Any:
    """The blueprint for a picture in `frame` within `bounds` (south-west, north-east; m), of whose `trails`
    (entities) the last `trail` seconds are seen."""
    rr = import_rerun()
    import rerun.blueprint as rrb

    since = rrb.TimeRangeBoundary.cursor_relative(seconds=-trail)
    ranges = [rrb.VisibleTimeRange(name, start=since, end=rrb.TimeRangeBoundary.cursor_relative()) for name in TIMES]
    history: dict[Any, Any] = {path: rrb.VisibleTimeRanges(ranges) for path in trails}
    sight = None
    if bounds is not None:
        (west, south), (east, north) = bounds
        sight = rrb.VisualBounds2D(x_range=(west, east), y_range=(-north, -south))
    plane = rrb.Spatial2DView(
        origin="/",
        contents=["/picture/**", "/grid/**"],
        name="Local picture (east right, north up)",
        overrides=history,
        visual_bounds=sight,
        background=(16, 16, 18),
    )
    pictures: list[Any] = [plane]
    if frame is None or isinstance(frame, Enu):
        zoom = _zoom(frame, bounds)
        pictures.append(rrb.MapView(origin="/picture", name="Map", overrides=history, zoom=zoom))
    columns = rrb.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn("time", visible=False)], text_log_columns=["loglevel", "body"]
    )
    whole = rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())

    def chart(origin: str, name: str, top: float | None = None) -> Any:
        """The whole mission; `top`: where the axis ends at first."""
        scale = None if top is None else rrb.ScalarAxis(range=(0.0, top))
        return rrb.TimeSeriesView(
            origin=origin,
            name=name,
            axis_x=rrb.TimeAxis(view_range=whole),
            axis_y=scale,
            plot_legend=rrb.Corner2D.LeftTop,
        )

    charts = [
        chart("/error", "Error per target (m)"),
        chart("/nees", "NEES per target", 8.0),
        chart("/anees", "Mean NEES", 4.0),
        chart("/existence", "Existence", 1.05),
        chart("/counts", "Tracks"),
        chart("/influence", "Influence"),
        rrb.TextDocumentView(origin="/health", name="Health"),
    ]
    log = rrb.TextLogView(origin="/log", name="Status log", columns=columns)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(*pictures, active_tab=0),
            rrb.Vertical(rrb.Tabs(*charts, active_tab=0), log, row_shares=[3, 2]),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


TIMES = ("time", "received")


def _zoom(frame: Frame | None, bounds: Corners | None) -> float | None:
    if not isinstance(frame, Enu) or bounds is None:
        return None
    size = float((bounds[1] - bounds[0]).max())
    scale = METRES_PER_PIXEL * math.cos(math.radians(frame.lat))
    return max(1.0, min(19.0, math.log2(scale * PIXELS / size)))
