"""How the pictures of the report look: SVG for the middle of a page, drawn with Matplotlib (the extra `report`)."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from fusion_service.arrays import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["chart", "legend", "thin"]


POINTS = 500
"""Points of a line, at most: means over equal parts of the mission where there are more times."""
SIZE = (5.0, 3.0)
STYLE: Any = {
    "svg.fonttype": "none",
    "text.parse_math": False,
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 8,
    "lines.linewidth": 1.4,
}


def thin(seconds: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Means over parts of the mission, so that a line has `POINTS` at most."""
    if len(seconds) <= POINTS:
        return seconds, values
    part = np.arange(len(seconds)) * POINTS // len(seconds)
    known = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(part, np.where(known, values, 0.0), POINTS) / np.bincount(part, known, POINTS)
    return np.bincount(part, seconds, POINTS) / np.bincount(part, minlength=POINTS), mean


def legend(axes: Axes) -> None:
    """Above the picture, so that it hides nothing."""
    handles, labels = axes.get_legend_handles_labels()
    room = 58 - 7 * len(handles) - sum(map(len, labels))
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(-0.02, 1.0),
        ncols=len(handles) if room > 0 else max(1, min(3, 50 // (7 + max(map(len, labels))))),
        columnspacing=1.2,
        handlelength=1.4,
        borderaxespad=0.1,
    )


def chart(draw: Callable[[Axes], None], title: str) -> str:
    with _figure() as figure:
        axes = figure.subplots()
        draw(axes)
        figure.suptitle(title, x=0.01, ha="left", fontsize=10, fontweight="bold")
        out = io.StringIO()
        figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return _inline(out.getvalue(), title)


@contextmanager
def _figure() -> Iterator[Any]:
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({**STYLE, "svg.hashsalt": "report"}):
        yield Figure(figsize=SIZE, layout="constrained")


def _inline(svg: str, title: str) -> str:
    """For the middle of an HTML page: no header, no addresses, no ids but those that are referred to."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", svg)
    svg = re.sub(r'\sid="[A-Za-z_.0-9]+_\d+"', "", svg)
    svg = re.sub(r"(\d\.\d\d)\d+", r"\1", svg)
    svg = re.sub(r'<svg ([^>]*?)width="[^"]*"', r"<svg \1", svg, count=1)
    svg = re.sub(r'(<svg [^>]*?)height="[^"]*"', r"\1", svg, count=1)
    return svg.replace("<svg ", f'<svg role="img" aria-label="{escape(title)}" ', 1)
