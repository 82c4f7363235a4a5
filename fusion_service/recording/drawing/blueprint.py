"""How a recording opens: the picture on the left; charts, health and log on the right.

`blueprint` shows a mission, `track_blueprint` one global track. With several centres each has its own pictures, and
its own charts beneath those of the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from fusion_service.recording.columns import entity, import_rerun
from fusion_service.recording.drawing.extent import Corners
from schemas import Enu, Frame

__all__ = ["blueprint", "track_blueprint"]


PIXELS = 700
"""What a map of usual size shows of the picture's height."""
METRES_PER_PIXEL = 156543.034
"""On the equator at zoom 0 (Web Mercator, tiles of 256 pixels)."""
TIMES = ("time", "received")
STACKED = 4
"""Centres whose charts are stacked; those of more stand in one view."""


def blueprint(
    frame: Frame | None,
    bounds: Corners | None,
    *,
    trails: Sequence[str],
    trail: float,
    centres: Sequence[str] = (),
    crowded: bool = False,
    supervised: bool = False,
    assessed: bool = True,
) -> Any:
    """The blueprint for a picture in `frame` within `bounds` (south-west, north-east; m), of whose `trails`
    (entities) the last `trail` seconds are seen. centres: whose global tracks it shows. crowded: there are too many
    targets or tracks for a legend; a series under the pointer says its name. supervised: there are series of how far
    sources are trusted, and shifted. assessed: there are errors against a truth; without, what needs none comes
    first."""
    rr = import_rerun()
    import rerun.blueprint as rrb

    pictures = _pictures(rr, rrb, frame, bounds, trails, trail, centres)
    several = list(centres) if 1 < len(centres) <= STACKED else []

    def charts(kind: str, name: str, top: float | None = None) -> Any:
        if not several:
            return _chart(rr, rrb, f"/{kind}", name, top, legend=kind == "influence" or not crowded)
        views = [
            _chart(rr, rrb, entity(kind, one), f"{name}: {one}", top, legend=kind == "influence" or not crowded)
            for one in several
        ]
        return rrb.Vertical(*views, name=name)

    counts, existence = _chart(rr, rrb, "/counts", "Tracks"), charts("existence", "Existence", 1.05)
    influence = charts("influence", "Influence (weights per source)", 1.05)
    traffic = [
        _chart(rr, rrb, "/rate", "Messages per s"),
        _chart(rr, rrb, "/apart", "Sources apart (m)"),
        _chart(rr, rrb, "/offset", "Delays (s)"),
    ]
    if assessed:
        upper = [charts("error", "Error per target (m)"), existence, counts]
        lower = [charts("nees", "NEES per target", 8.0), _chart(rr, rrb, "/anees", "Mean NEES", 4.0), influence]
    else:
        upper, lower, traffic = [counts, traffic[0], existence], [traffic[1], traffic[2], influence], []
    watched = [
        _chart(rr, rrb, "/consistency", "Sources (1 is right)", 3.0),
        _chart(rr, rrb, "/clock", "Clocks (s)"),
        rrb.Spatial2DView(origin="/registration", name="Registration (m)"),
    ]
    pages = [rrb.TextDocumentView(origin=entity("health", one), name=f"Health: {one}") for one in centres]
    told = [_log(rrb, "/log", "Status log"), *(pages or [rrb.TextDocumentView(origin="/health", name="Health")])]
    return _whole(
        rrb,
        rrb.Tabs(*pictures, active_tab=0),
        [
            rrb.Tabs(*upper, active_tab=0),
            rrb.Tabs(*lower, active_tab=0),
            rrb.Tabs(*told, *(watched if supervised else []), *traffic, active_tab=0),
        ],
    )


def track_blueprint(
    frame: Frame | None,
    bounds: Corners | None,
    track: str,
    *,
    reach: float,
    trails: Sequence[str],
    trail: float,
    centres: Sequence[str] = (),
) -> Any:
    """The blueprint for one global track, labelled `track`: the picture within `bounds`, about its path; one that goes
    along with it, `reach` m to each side; the series and decisions that a `Recorder` with this `focus` writes."""
    rr = import_rerun()
    import rerun.blueprint as rrb

    pictures = _pictures(rr, rrb, frame, bounds, trails, trail, centres)

    def chart(parts: Sequence[str], name: str, top: float | None = None) -> Any:
        wanted = [f"{entity('track', centre, part)}/**" for centre in centres or ("*",) for part in parts]
        return _chart(rr, rrb, "/track", name, top, contents=wanted)

    series = [
        chart(("error", "sigma"), f"Track {track}: error and sigma (m)"),
        chart(("nees",), f"Track {track}: NEES", 8.0),
        chart(("influence",), f"Track {track}: influence (weights per source)", 1.05),
        chart(("existence",), f"Track {track}: existence", 1.05),
    ]
    told = [_log(rrb, "/log/track", f"Track {track}: log"), _log(rrb, "/log", "Status log")]
    along = rrb.Spatial2DView(
        origin="/near",
        name=f"Seen from track {track}: its sources in their colours, the truth grey",
        visual_bounds=rrb.VisualBounds2D(x_range=(-reach, reach), y_range=(-reach, reach)),
    )
    left = rrb.Vertical(rrb.Tabs(*pictures, active_tab=0), along)
    return _whole(rrb, left, [*series, rrb.Tabs(*told, active_tab=0)])


def _whole(rrb: Any, left: Any, right: Sequence[Any]) -> Any:
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Vertical(*right), column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _pictures(
    rr: Any,
    rrb: Any,
    frame: Frame | None,
    bounds: Corners | None,
    trails: Sequence[str],
    trail: float,
    centres: Sequence[str],
) -> list[Any]:
    """The plane, that of each centre alone if there are several, and the map."""
    since = rrb.TimeRangeBoundary.cursor_relative(seconds=-trail)
    ranges = [rrb.VisibleTimeRange(name, start=since, end=rrb.TimeRangeBoundary.cursor_relative()) for name in TIMES]
    history: dict[Any, Any] = {path: rrb.VisibleTimeRanges(ranges) for path in trails}
    sight = None
    if bounds is not None:
        (west, south), (east, north) = bounds
        sight = rrb.VisualBounds2D(x_range=(west, east), y_range=(-north, -south))

    def plane(name: str, contents: Sequence[str]) -> Any:
        return rrb.Spatial2DView(
            origin="/",
            contents=contents,
            name=name,
            overrides=history,
            visual_bounds=sight,
        )

    views = [plane("Local picture (east right, north up)", ["/picture/**", "/grid/**"])]
    if len(centres) > 1:
        for one in centres[:STACKED]:
            own = f"{entity('picture', 'global', one)}/**"
            views.append(plane(f"{one} alone", ["+ /picture/**", "- /picture/global/**", f"+ {own}", "+ /grid/**"]))
    if frame is None or isinstance(frame, Enu):
        views.append(rrb.MapView(origin="/picture", name="Map", overrides=history, zoom=_zoom(frame, bounds)))
    return views


def _chart(
    rr: Any,
    rrb: Any,
    origin: str,
    name: str,
    top: float | None = None,
    contents: Sequence[str] | None = None,
    *,
    legend: bool = True,
) -> Any:
    """Over the whole mission; `top`: where the axis ends at first."""
    whole = rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())
    more: dict[str, Any] = {} if contents is None else {"contents": contents}
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_x=rrb.TimeAxis(view_range=whole),
        axis_y=None if top is None else rrb.ScalarAxis(range=(0.0, top)),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
        **more,
    )


def _log(rrb: Any, origin: str, name: str) -> Any:
    columns = rrb.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn("time", visible=False)], text_log_columns=["loglevel", "body"]
    )
    return rrb.TextLogView(origin=origin, name=name, columns=columns)


def _zoom(frame: Frame | None, bounds: Corners | None) -> float | None:
    if not isinstance(frame, Enu) or bounds is None:
        return None
    size = float((bounds[1] - bounds[0]).max())
    scale = METRES_PER_PIXEL * math.cos(math.radians(frame.lat))
    return max(1.0, min(19.0, math.log2(scale * PIXELS / size)))
