"""Colours that can be told apart on a dark view and on a light map."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable

__all__ = ["FUSED", "GRID", "NEUTRAL", "TRUTH", "WARNING", "Colour", "packed", "series_colour", "source_colours"]

Colour = tuple[int, int, int]

FUSED: Colour = (255, 62, 62)
TRUTH: Colour = (150, 150, 150)
NEUTRAL: Colour = (205, 205, 205)
GRID: Colour = (58, 58, 58)
WARNING: Colour = (240, 190, 60)


def source_colours(names: Iterable[str]) -> dict[str, Colour]:
    """The colour of each source, as on the mission's map on paper."""
    from fusion_service import picture  # which imports this package

    return {name: _rgb(text) for name, text in picture.source_colours(names).items()}


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
