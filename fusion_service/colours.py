"""One colour for one thing, on paper ("#rrggbb", on white) and on a screen (`Colour`, on dark views and light ones).

Sources have the same colours on both. What is fused is black on paper, and red on a screen, where each centre has a
colour of its own.
"""

from __future__ import annotations

import colorsys
from collections.abc import Iterable

__all__ = [
    "BLUE",
    "GREEN",
    "ORANGE",
    "PAPER_FUSED",
    "PAPER_TRUTH",
    "SCREEN_FUSED",
    "SCREEN_GRID",
    "SCREEN_NEUTRAL",
    "SCREEN_TRUTH",
    "SCREEN_WARNING",
    "SKY",
    "SOURCES",
    "VERMILION",
    "Colour",
    "centre_colours",
    "line_style",
    "marker_of",
    "packed",
    "paper_colour",
    "screen_source_colours",
    "series_colour",
    "shade",
    "source_colours",
]

Colour = tuple[int, int, int]
"""Red, green and blue of a screen, 0 to 255."""

TINTS = ((1.0, 0.0), (0.5, 127.5), (0.6, 0.0))
"""Share of a colour's light, and what is added to it, at each turn of `SOURCES`."""
PAPER_STYLES = ("-", "--", ":")
SCREEN_MARKERS = (None, "square", "diamond")

PAPER_FUSED = "#000000"
PAPER_TRUTH = "#999999"
BLUE, ORANGE, GREEN, SKY, VERMILION = "#0072b2", "#e69f00", "#009e73", "#56b4e9", "#d55e00"
SOURCES = (BLUE, ORANGE, GREEN, "#cc79a7", SKY, VERMILION, "#f0e442")
"""Okabe and Ito (2008), to be told apart by the colour-blind; its black and a grey are for fused tracks and truth."""

SCREEN_FUSED: Colour = (255, 62, 62)
SCREEN_CENTRES: tuple[Colour, ...] = (SCREEN_FUSED, (120, 190, 30), (240, 80, 220), (150, 115, 250))
SCREEN_TRUTH: Colour = (150, 150, 150)
SCREEN_NEUTRAL: Colour = (140, 140, 140)
SCREEN_GRID: Colour = (128, 128, 128)
SCREEN_WARNING: Colour = (225, 165, 40)


def paper_colour(index: int) -> str:
    """The colour "#rrggbb" of the index-th source: `SOURCES`, then these half-way to white, then with less light."""
    red, green, blue = _rgb(SOURCES[index % len(SOURCES)])
    share, white = TINTS[index // len(SOURCES) % len(TINTS)]
    return "#" + "".join(f"{round(share * part + white):02x}" for part in (red, green, blue))


def source_colours(names: Iterable[str]) -> dict[str, str]:
    """A colour "#rrggbb" for each source, by alphabetical order: the same for the same set of names."""
    return {name: paper_colour(index) for index, name in enumerate(sorted(set(names)))}


def line_style(colour: str) -> str:
    """How Matplotlib draws a line of that colour: those beyond the seven of `SOURCES` are dashed, then dotted."""
    return PAPER_STYLES[_turn(_rgb(colour))] if colour.startswith("#") else PAPER_STYLES[0]


def marker_of(colour: Colour) -> str | None:
    """What marks the points of a series of that colour on a screen, by Rerun's names; None for the seven of
    `SOURCES`, and what is no source's."""
    return SCREEN_MARKERS[_turn(colour)]


def _turn(colour: Colour) -> int:
    """How often the colours of sources had been used up before this one."""
    for turn in range(1, len(TINTS)):
        first = turn * len(SOURCES)
        if any(_rgb(paper_colour(index)) == colour for index in range(first, first + len(SOURCES))):
            return turn
    return 0


def screen_source_colours(names: Iterable[str]) -> dict[str, Colour]:
    """The same colours for a screen."""
    return {name: _rgb(text) for name, text in source_colours(names).items()}


def centre_colours(names: Iterable[str]) -> dict[str, Colour]:
    """The colour of each centre on a screen, by alphabetical order: a single one's is `SCREEN_FUSED`."""
    return {name: SCREEN_CENTRES[index % len(SCREEN_CENTRES)] for index, name in enumerate(sorted(set(names)))}


def shade(colour: Colour, share: float) -> Colour:
    """`colour` with so much of its light."""
    red, green, blue = (round(share * part) for part in colour)
    return red, green, blue


def series_colour(index: int) -> Colour:
    """The colour of the index-th of any number of series: hues a golden section apart."""
    red, green, blue = colorsys.hsv_to_rgb((0.08 + index * 0.618034) % 1.0, 0.7, 0.85)
    return round(red * 255), round(green * 255), round(blue * 255)


def packed(colour: Colour, alpha: int = 255) -> int:
    """0xRRGGBBAA."""
    red, green, blue = colour
    return red << 24 | green << 16 | blue << 8 | alpha


def _rgb(text: str) -> Colour:
    red, green, blue = bytes.fromhex(text.removeprefix("#"))
    return red, green, blue
