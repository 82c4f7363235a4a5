"""A study's result as a table on a terminal, as JSON, and as a section of docs/studies.md."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from studies.study import Result, Row, Run, Study

__all__ = ["as_json", "page", "text", "write_json"]

PAGE = Path("docs") / "studies.md"
LONG, SOME = 40, 12
"""Rows of a table beyond which what has no published number is folded, and how many are shown where none has one."""
FOLDER = Path("docs") / "studies"
"""Where full results are kept, and the page made of them."""


def as_json(study: Study, run: Run, result: Result) -> dict[str, Any]:
    """The result as plain values."""
    rows = [
        {
            "name": row.name,
            "quantity": row.quantity,
            "published": row.published,
            "ours": _plain(row.ours),
            "stderr": _plain(row.stderr),
        }
        | ({} if row.decimals is None else {"decimals": row.decimals})
        for row in result.rows
    ]
    return {"study": study.name, "runs": run.runs, "seed": run.seed, "rows": rows, "notes": list(result.notes)}


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """One row a line, so that a change can be read as a difference."""
    head = {key: value for key, value in values.items() if key not in ("rows", "notes")}
    lines = [f"{json.dumps(key)}: {json.dumps(value)}" for key, value in head.items()]
    lines += [
        f"{json.dumps(key)}: [\n  " + ",\n  ".join(json.dumps(one, ensure_ascii=False) for one in values[key]) + "\n]"
        if values[key]
        else f"{json.dumps(key)}: []"
        for key in ("rows", "notes")
    ]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def _plain(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(f"{value:.6g}")


def _rows(values: Mapping[str, Any]) -> list[Row]:
    return [
        Row(
            row["name"],
            row["quantity"],
            row["published"],
            math.nan if row["ours"] is None else row["ours"],
            row["stderr"],
            row.get("decimals"),
        )
        for row in values["rows"]
    ]


def digits(value: float, error: float | None = None) -> str:
    """`value` to two digits of its error, or to four of its own."""
    if not math.isfinite(value):
        return "-"
    scale = error / 10 if error else abs(value) / 1e3
    places = min(max(0, -math.floor(math.log10(scale))), 8) if scale > 0 else 0
    text = f"{value:.{places}f}"
    return f"{value:.2e}" if value and abs(value) < 1e-4 else text


def printed(row: Row) -> str:
    """The published number as it was printed."""
    if row.published is None:
        return ""
    return repr(row.published).removesuffix(".0") if row.decimals is None else f"{row.published:.{row.decimals}f}"


def compared(row: Row, runs: int, published_runs: int | None) -> str:
    """Whether a published number lies within two standard errors of ours, its own and its rounding included; else by
    how much ours is off."""
    if row.published is None or not math.isfinite(row.ours):
        return ""
    places = row.decimals if row.decimals is not None else len(printed(row).partition(".")[2])
    half = 0.5 * 10.0**-places
    difference = row.ours - row.published
    if not row.stderr:
        if abs(difference) <= half * 1.000001:
            return "as printed"
        return f"{100 * difference / abs(row.published):+.2g} %" if row.published else f"{difference:+.2g}"
    theirs = row.stderr * math.sqrt(runs / published_runs) if published_runs else 0.0
    sigma = math.sqrt(row.stderr**2 + theirs**2 + half**2 / 3)
    if abs(difference) <= 2 * sigma:
        return "agrees"
    share = f"{100 * difference / abs(row.published):+.2g} %, " if row.published else ""
    return f"{share}{difference / sigma:+.1f} sigma"


def text(study: Study, values: Mapping[str, Any]) -> str:
    """The table for a terminal, then the notes."""
    rows = _rows(values)
    table = [("", "quantity", "published", "ours", "std. err.", "")]
    for row in rows:
        error = "" if row.stderr is None else f"{row.stderr:.2g}"
        verdict = compared(row, values["runs"], study.published_runs)
        table.append((row.name, row.quantity, printed(row), digits(row.ours, row.stderr), error, verdict))
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = [f"{study.name}: {study.title} ({study.source}), {values['runs']} runs, seed {values['seed']}", ""]
    for number, line in enumerate(table):
        cells = [
            cell.ljust(width) if index in (0, 1, 5) else cell.rjust(width)
            for index, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        if number > 1 and line[1] != table[number - 1][1] and line[0] != table[number - 1][0]:
            lines.append("")
        lines.append("  ".join(cells).rstrip())
    if values["notes"]:
        lines.append("")
    for note in values["notes"]:
        lines += textwrap.wrap(note, 110, initial_indent="* ", subsequent_indent="  ")
    return "\n".join(lines)


def page(studies: Iterable[Study], folder: Path = FOLDER) -> str:
    """docs/studies.md of the results in `folder`. FileNotFoundError for a study that has none."""
    known = list(studies)
    results = {study.name: json.loads((folder / f"{study.name}.json").read_text(encoding="utf-8")) for study in known}
    lines = [HEAD.strip(), "", "| study | what it is | from |", "|---|---|---|"]
    lines += [f"| [`{study.name}`](#{study.name}) | {study.title} | {study.source} |" for study in known]
    for study in known:
        values = results[study.name]
        lines += ["", f"## {study.name}", "", f"**{study.title}** ({study.source}).", "", study.about.strip(), ""]
        lines += [f"`python -m studies run {study.name}`: {values['runs']:,} runs, seed {values['seed']}.", ""]
        lines += _tables(study, values)
        if (folder / f"{study.name}.png").is_file():
            lines += ["", f"![{study.title}](studies/{study.name}.png)"]
        if values["notes"]:
            lines += ["", *(f"* {note}" for note in values["notes"])]
    return "\n".join(lines) + "\n"


def _tables(study: Study, values: Mapping[str, Any]) -> list[str]:
    """One table with a column a quantity, published numbers in brackets. Where that would be too wide: a table for each
    group, if all quantities are called "group: column"; a long one else."""
    rows = _rows(values)
    quantities = list(dict.fromkeys(row.quantity for row in rows))
    names = list(dict.fromkeys(row.name for row in rows))
    cells = {(row.name, row.quantity): row for row in rows}
    groups: dict[str, list[str]] = {}
    for quantity in quantities:
        groups.setdefault(quantity.partition(": ")[0], []).append(quantity)
    sparse = len(cells) < 0.6 * len(quantities) * len(names) or len(cells) < len(rows)
    if not sparse and len(quantities) <= study.widest:
        return _grid(study, values, names, {quantity: quantity for quantity in quantities}, cells)
    if sparse or max(map(len, groups.values())) > study.widest or not all(": " in quantity for quantity in quantities):
        theirs = [row for row in rows if row.published is not None] or rows[:SOME]
        if len(rows) <= LONG:
            return _list(study, values, rows)
        own = [row for row in rows if row not in theirs]
        return [*_list(study, values, theirs), *_folded(f"{len(own)} more rows", _list(study, values, own))]
    shown: list[str] = []
    more: list[str] = []
    for number, (head, group) in enumerate(groups.items()):
        columns = {quantity: quantity.partition(": ")[2] for quantity in group}
        there = [name for name in names if any((name, quantity) in cells for quantity in group)]
        published = any(row.published is not None for row in rows if row.quantity in group)
        lines = shown if not number or published or len(rows) <= LONG else more
        lines += [*([""] if lines else []), f"{head[0].upper()}{head[1:]}:", ""]
        lines += _grid(study, values, there, columns, cells)
    return [*shown, *(_folded("more tables, of which nothing is published", more) if more else [])]


def _folded(summary: str, lines: list[str]) -> list[str]:
    return ["", f"<details><summary>{summary}</summary>", "", *lines, "", "</details>"]


def _grid(
    study: Study,
    values: Mapping[str, Any],
    names: Iterable[str],
    columns: Mapping[str, str],
    cells: Mapping[tuple[str, str], Row],
) -> list[str]:
    """columns: the heading of every quantity."""
    lines = ["| | " + " | ".join(map(_cell, columns.values())) + " |", "|---" * (len(columns) + 1) + "|"]
    for name in names:
        line = []
        for quantity in columns:
            one = cells.get((name, quantity))
            if one is None:
                line.append("")
                continue
            verdict = compared(one, values["runs"], study.published_runs)
            line.append(_ours(one) + (f" ({printed(one)}: {verdict})" if one.published is not None else ""))
        lines.append(f"| {_cell(name)} | " + " | ".join(line) + " |")
    return lines


def _list(study: Study, values: Mapping[str, Any], rows: list[Row]) -> list[str]:
    lines = ["| | quantity | published | ours | |", "|---|---|---|---|---|"]
    for row in rows:
        verdict = compared(row, values["runs"], study.published_runs)
        lines.append(f"| {_cell(row.name)} | {_cell(row.quantity)} | {printed(row)} | {_ours(row)} | {verdict} |")
    return lines


def _cell(text: str) -> str:
    """In a table of Markdown a bar would end the cell."""
    return text.replace("|", r"\|")


def _ours(row: Row) -> str:
    error = f" ± {digits(row.stderr, row.stderr)}" if row.stderr else ""
    return digits(row.ours, row.stderr) + error


HEAD = """
# Studies

The experiments of the five papers, and our own, as they come out here. Every number below is printed by the command
above its table (`python -m studies run NAME`; `python -m studies all` makes all of them and this page). Ours stands
first with its standard error over the runs; a published number follows in brackets. "agrees": within two standard
errors, the published number's own error (of the paper's number of runs) and its rounding included; otherwise by how
much ours is off. Readings that had to be chosen are said, and what does not come out stays as it came out.

To try a rule of your own in the same experiments, write a function `fuse(means, covariances)` with the batch first
((B, N, n), (B, N, n, n) -> (B, n), (B, n, n)) into a file, and add `--rule my_rule.py:fuse` to the command; `--rule
bci:max_correlation=0.3` adds one of ours with other options.
"""
