"""The scores against the true hulls as plain text, where truth tells the extent of its objects."""

from __future__ import annotations

from collections.abc import Mapping

from fusion_service.review.evaluation.scoring import Scores
from fusion_service.review.evaluation.tables import aligned, digits, fixed, percent

__all__ = ["TITLE", "hull_lines", "hull_table"]


TITLE = "To the nearest point of the true hull, in m, on the plane; ANEES below its bounds is no fault here"


def hull_table(scored: Mapping[str, Scores]) -> list[list[str]]:
    """A heading and a line for each that was scored against a hull; nothing where none was."""
    table = [["", "pairs", "RMSE", "inside", "ANEES", "95 % bounds"]]
    for name, one in scored.items():
        if (hull := one.hull) is not None and hull.pairs:
            numbers = [digits(hull.rmse), percent(hull.inside), fixed(hull.anees), fixed(*hull.bounds)]
            table.append([name, str(hull.pairs), *numbers])
    return table if len(table) > 1 else []


def hull_lines(scored: Mapping[str, Scores]) -> list[str]:
    """A title and a table; nothing where no track was scored against a hull."""
    table = hull_table(scored)
    return [TITLE, *aligned(table)] if table else []
