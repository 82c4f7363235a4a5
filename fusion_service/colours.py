"""One colour for one thing, on paper and on a screen: sources by name, the fused picture, the truth."""

from __future__ import annotations

from collections.abc import Iterable

__all__ = ["FUSED", "SOURCES", "TRUTH", "source_colours"]

FUSED = "#000000"
TRUTH = "#999999"
SOURCES = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442")
"""Okabe and Ito (2008), to be told apart by the colour-blind; its black and a grey are for fused tracks and truth."""


def source_colours(names: Iterable[str]) -> dict[str, str]:
    """A colour "#rrggbb" for each source, by alphabetical order: the same for the same set of names."""
    return {name: SOURCES[index % len(SOURCES)] for index, name in enumerate(sorted(set(names)))}
