"""One colour for one thing, on paper ("#rrggbb", on white) and on a screen (`Colour`, on a dark view and a light map).

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
    "packed",
    "screen_source_colours",
    "series_colour",
    "shade",
    "source_colours",
]

Colour = tuple[int, int, int]
"""Red, green and blue of a screen, 0 to 255."""

PAPER_FUSED = "#000000"
PAPER_TRUTH = "#999999"
BLUE, ORANGE, GREEN, SKY, VERMILION = "#0072b2", "#e69f00", "#009e73", "#56b4e9", "#d55e00"
SOURCES = (BLUE, ORANGE, GREEN, "#cc79a7", SKY, VERMILION, "#f0e442")
"""Okabe and Ito (2008), to be told apart by the colour-blind; its black and a grey are for fused tracks and truth."""

SCREEN_FUSED: Colour = (255, 62, 62)
SCREEN_CENTRES: tuple[Colour, ...] = (SCREEN_FUSED, (190, 255, 70), (255, 90, 235), (170, 135, 255))
SCREEN_TRUTH: Colour = (150, 150, 150)
SCREEN_NEUTRAL: Colour = (205, 205, 205)
SCREEN_GRID: Colour = (58, 58, 58)
SCREEN_WARNING: Colour = (240, 190, 60)


def source_colours(names: Iterable[str]) -> dict[str, str]:
    """A colour "#rrggbb" for each source, by alphabetical order: the same for the same set of names."""
    return {name: SOURCES[index % len(SOURCES)] for index, name in enumerate(sorted(set(names)))}


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
    red, green, blue = colorsys.hsv_to_rgb((0.08 + index * 0.618034) % 1.0, 0.62, 0.95)
    return round(red * 255), round(green * 255), round(blue * 255)


def packed(colour: Colour, alpha: int = 255) -> int:
    """0xRRGGBBAA."""
    red, green, blue = colour
    return red << 24 | green << 16 | blue << 8 | alpha


def _rgb(text: str) -> Colour:
    red, green, blue = bytes.fromhex(text.removeprefix("#"))
    return red, green, blue
