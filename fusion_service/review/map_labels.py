"""Labels of a map that do not cover each other: each at the first of several places about its point that is free."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from fusion_service.arrays import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["MapLabel", "place_labels"]

AROUND = (
    (5, 5, "left", "bottom"),
    (5, -5, "left", "top"),
    (-5, 5, "right", "bottom"),
    (-5, -5, "right", "top"),
    (0, 9, "center", "bottom"),
    (0, -9, "center", "top"),
    (11, 0, "left", "center"),
    (-11, 0, "right", "center"),
    (16, 14, "left", "bottom"),
    (-16, 14, "right", "bottom"),
    (16, -14, "left", "top"),
    (-16, -14, "right", "top"),
)
"""Offsets in points, and which part of the text is there."""
UNDER = 5
"""Of these the first that is tried where a label stands under its point by choice."""
GAP = 1.0
"""Pixels between labels."""


class MapLabel(NamedTuple):
    """at (2,): in units of the axes."""

    at: Floats
    text: str
    size: float = 8.0
    colour: str = "#333333"
    under: bool = False


def place_labels(figure: Figure, axes: Axes, labels: Sequence[MapLabel]) -> int:
    """Write them in their order, when the axes are as they will be. Returns how many have no room, and are left out."""
    from matplotlib.patheffects import withStroke

    figure.draw_without_rendering()
    renderer: Any = figure._get_renderer()  # type: ignore[attr-defined]
    taken: list[Any] = []
    out = 0
    for label in labels:
        order = (AROUND[UNDER], *AROUND[:UNDER], *AROUND[UNDER + 1 :]) if label.under else AROUND
        for x, y, across, up in order:
            text = axes.annotate(
                label.text,
                (float(label.at[0]), float(label.at[1])),
                (x, y),
                textcoords="offset points",
                ha=across,
                va=up,
                size=label.size,
                color=label.colour,
                zorder=7,
                path_effects=[withStroke(linewidth=2.0, foreground="white")],
            )
            text.set_in_layout(False)
            box = text.get_window_extent(renderer).padded(GAP)
            if not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            text.remove()
        else:
            out += 1
    return out
