"""Scores as plain text."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from fusion_service.evaluation import Evaluation

__all__ = ["aligned", "digits", "fixed", "format_table"]


def format_table(evaluation: Evaluation) -> str:
    """A plain text table: each source and the fused tracks, then the targets that several sources see."""
    fused = f"fused ({evaluation.centre})" if evaluation.centre else "fused (no centre)"
    table = [["", "RMSE", "GOSPA", "localis.", "missed", "false", "ANEES", "95 % bounds", "id switches"]]
    for name, one in [*evaluation.sources.items(), (fused, evaluation.fused)]:
        parts = (one.rmse_position, one.gospa, one.gospa_localisation, one.gospa_missed, one.gospa_false)
        numbers = [*map(digits, parts), fixed(one.anees), fixed(*one.bounds), str(one.identity_switches)]
        table.append([name, *numbers])
    lines = [
        f"Scored at {len(evaluation.times)} times against {len(evaluation.targets)} targets; GOSPA p = 2, alpha = 2, "
        f"c = {evaluation.c:g} m",
        "RMSE and GOSPA in m, its parts in m2; ANEES over its dimension, 1 is ideal",
        *aligned(table),
        *(f"not scored: {name}: {reason}" for name, reason in evaluation.left_out.items()),
    ]
    table = [["", "pairs", "RMSE fused", "best single", "ANEES fused", "best single", "95 % bounds", "no fused track"]]
    for name, row in evaluation.shared.items():
        rmse = [digits(row["fused_rmse"]), digits(row["best_rmse"])]
        anees = [fixed(row["fused_anees"]), fixed(row["best_anees"]), fixed(*row["nees_bounds"])]
        table.append([name.replace("_", " "), str(row["pairs"]), *rmse, *anees, str(row["fused_missed"])])
    title = "Targets that several sources track: fused beside the best single source, on the same pairs (target, time)"
    return "\n".join([*lines, "", title, *aligned(table)] if evaluation.seen.max() > 1 else lines)


def digits(value: float) -> str:
    """Four significant digits, no exponent."""
    if not np.isfinite(value):
        return "-"
    return f"{value:.{max(0, 3 - int(np.floor(np.log10(abs(value)))))}f}" if value else "0"


def fixed(*values: float) -> str:
    return " - ".join(f"{value:.2f}" for value in values) if np.isfinite(values).all() else "-"


def aligned(table: list[list[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    rows = ([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])] for row in table)
    return ["  ".join(row) for row in rows]
