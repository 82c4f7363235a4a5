"""Tables of the report, as HTML."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

__all__ = ["html_table", "mark"]


def html_table(
    head: Sequence[str],
    lines: Iterable[Sequence[str]],
    marks: dict[tuple[int, int], str] | None = None,
    left: int = 1,
    columns: Sequence[int] = (),
    wide: int | None = None,
) -> str:
    """marks: (row, column) -> class of the cell; a row that begins with "fused" stands out. The first `left` columns,
    one without a name, and `columns`, stand to the left; the text of the column `wide` is broken into lines."""
    marks = marks or {}
    to_left = {*range(1, left), *columns} - {0}
    parts = ["<tr>", *(f"<th{_left(k in to_left)}>{escape(cell)}</th>" for k, cell in enumerate(head)), "</tr>"]
    for index, line in enumerate(lines):
        parts.append('<tr class="fused">' if line and line[0].startswith("fused") else "<tr>")
        for k, cell in enumerate(line):
            shade = marks.get((index, k), "")
            side = "left" if k in to_left or (k and not head[k]) else ""
            classes = " ".join(filter(None, (shade, side, "wrap" if k == wide else "")))
            parts.append(f'<td class="{classes}">' if classes else "<td>")
            parts.append(f"{escape(cell)}</td>")
        parts.append("</tr>")
    return f'<div class="scroll"><table>{"".join(parts)}</table></div>'


def _left(wanted: bool) -> str:
    return ' class="left"' if wanted else ""


def mark(value: float, bounds: tuple[float, float]) -> str:
    """The class of a cell with a mean that lies within `bounds`, below or above; none without one."""
    low, high = bounds
    return "" if not np.isfinite(value) else "low" if value < low else "high" if value > high else "good"
