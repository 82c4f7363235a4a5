"""Colours that can be told apart on a dark view and on a light map."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable

from fusion_service import colours

__all__ = [
    "CENTRES",
    "FUSED",
    "GRID",
    "NEUTRAL",
    "TRUTH",
    "WARNING",
    "Colour",
    "centre_colours",
    "packed",
    "series_colour",
    "shade",
    "source_colours",
]

Colour = tuple[int, int, int]

FUSED: Colour = (255, 62, 62)
CENTRES: tuple[Colour, ...] = (FUSED, (190, 255, 70), (255, 90, 235), (170, 135, 255))
TRUTH: Colour = (150, 150, 150)
NEUTRAL: Colour = (205, 205, 205)
GRID: Colour = (58, 58, 58)
WARNING: Colour = (240, 190, 60)


def source_colours(names: Iterable[str]) -> dict[str, Colour]:
    """The colour of each source, as on the mission's map on paper."""
    return {name: _rgb(text) for name, text in colours.source_colours(names).items()}


def centre_colours(names: Iterable[str]) -> dict[str, Colour]:
    """The colour of each centre, by alphabetical order: a single one's is `FUSED`."""
    return {name: CENTRES[index % len(CENTRES)] for index, name in enumerate(sorted(set(names)))}


def shade(colour: Colour, share: float) -> Colour:
    """`colour` with so much of its light."""
    red, green, blue = (round(share * part) for part in colour)
    return red, green, blue


def _rgb(text: str) -> Colour:
    red, green, blue = bytes.fromhex(text.removeprefix("#"))
    return red, green, blue


def series_colour(index: int) -> Colour:
    """The colour of the index-th of any number of series: hues a golden section apart."""
    red, green, blue = colorsys.hsv_to_rgb((0.08 + index * 0.618034) % 1.0, 0.62, 0.95)
    return round(red * 255), round(green * 255), round(blue * 255)


def packed(colour: Colour, alpha: int = 255) -> int:
    """0xRRGGBBAA."""
    red, green, blue = colour
    return red << 24 | green << 16 | blue << 8 | alpha
