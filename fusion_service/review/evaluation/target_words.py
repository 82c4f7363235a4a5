"""Each target in a line, the worst first, and why it was missed, in words."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fusion_service.review.evaluation.gathering import Evaluation
from fusion_service.review.evaluation.misses import CAUSES, MERGED
from fusion_service.review.evaluation.tables import digits, percent
from fusion_service.review.evaluation.targets import Gap, TargetRecord

__all__ = [
    "HEAD",
    "LEFT",
    "MOST_LINES",
    "gap_words",
    "missed_summary",
    "target_lines",
    "target_name",
    "target_table",
    "why",
]

MOST_LINES = 12
"""Targets of the table on a terminal."""
MOST_GAPS = 3
MOST_TRACKS = 4

HEAD = (
    "target",
    "life, s",
    "followed",
    "gaps",
    "longest, s",
    "seen at, s",
    "by",
    "confirmed, s",
    "RMSE, m",
    "switches",
    "tracks",
    "missed because",
)
LEFT = (0, 6, 10, 11)
"""Columns that stand to the left."""

Label = Callable[[int], str]


def target_name(record: TargetRecord) -> str:
    """Its name, else its id."""
    return record.name or str(record.target)


def why(record: TargetRecord, start: int) -> str:
    """Its longest gaps with their causes; times in seconds from `start`, ns."""
    if not record.gaps:
        return ""
    longest = sorted(record.gaps, key=lambda gap: (-gap.seconds, gap.begin))
    told = [gap_words(gap, start) for gap in sorted(longest[:MOST_GAPS], key=lambda gap: gap.begin)]
    more = len(record.gaps) - MOST_GAPS
    return "; ".join([*told, f"{more} more"] if more > 0 else told)


def gap_words(gap: Gap, start: int) -> str:
    """When, and why: the causes in the order of their seconds."""
    begin, end = ((at - start) / 1e9 for at in (gap.begin, gap.end))
    if gap.begun and gap.ended:
        when = "never followed" if gap.seconds else f"at {begin:.1f}"
    elif gap.begun:
        when = f"until {end:.1f}"
    else:
        when = f"lost from {begin:.1f}" + ("" if gap.ended else f" to {end:.1f}")
    causes = [
        _cause(code, gap) + (f" ({seconds:.3g} s)" if len(gap.causes) > 1 else "")
        for code, seconds in gap.causes
        if code
    ]
    return f"{when}: {', '.join(causes)}"


def _cause(code: int, gap: Gap) -> str:
    if code == MERGED and gap.into:
        return f"merged into the track of target {', '.join(map(str, gap.into))}"
    return CAUSES[code]


def target_table(evaluation: Evaluation, start: int, label: Label = str, most: int | None = None) -> list[list[str]]:
    """`HEAD`, and a line for each of the first `most` targets. start: ns, from which times are told; label: of the ids
    of fused tracks."""
    table = [list(HEAD)]
    for record in evaluation.records[:most]:
        shown = [label(track) for track in record.tracks[:MOST_TRACKS]]
        shown += [f"and {len(record.tracks) - MOST_TRACKS} more"] if len(record.tracks) > MOST_TRACKS else []
        longest = max((gap.seconds for gap in record.gaps), default=0.0)
        table.append(
            [
                target_name(record),
                f"{record.life:.1f}",
                percent(round(record.followed / record.life, 3)) if record.life else "-",
                str(len(record.gaps)),
                f"{longest:.1f}" if record.gaps else "-",
                f"{(record.seen[0] - start) / 1e9:.1f}" if record.seen else "-",
                " ".join(record.seen[1]) if record.seen else "-",
                f"{record.confirm:.1f}" if np.isfinite(record.confirm) else "-",
                digits(record.rmse),
                str(record.switches),
                " ".join(shown) or "-",
                why(record, start),
            ]
        )
    return table


def missed_summary(evaluation: Evaluation) -> str:
    """How much of the targets' time was missed, and why, in a sentence; empty where none was."""
    life = sum(record.life for record in evaluation.records)
    missed: dict[int, float] = {}
    for record in evaluation.records:
        for code, seconds in record.causes:
            missed[code] = missed.get(code, 0.0) + seconds
    total = sum(missed.values())
    if not total:
        return ""
    parts = [f"{CAUSES[code]} {percent(s / total)}" for code, s in sorted(missed.items(), key=lambda item: -item[1])]
    never = sum(not record.tracks for record in evaluation.records)
    alone = f"; {never} of {len(evaluation.records)} targets never had a fused track" if never else ""
    return f"Of all targets' time {percent(total / life)} was missed: {', '.join(parts)}{alone}."


def target_lines(evaluation: Evaluation, start: int, label: Label = str) -> list[str]:
    """The table for a terminal."""
    if not evaluation.records or evaluation.centre is None:
        return []
    table = target_table(evaluation, start, label, MOST_LINES)
    summary = missed_summary(evaluation)
    lines = ["Each target, the worst first; times in s from the first scored one:", *_columns(table)]
    left = len(evaluation.records) - MOST_LINES
    lines += [f"{left} more targets, which were missed no longer (--html and --json have them all)"] if left > 0 else []
    return [summary, *lines] if summary else lines


def _columns(table: Sequence[Sequence[str]]) -> list[str]:
    """As `aligned`, with the columns of texts to the left."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    padded = [
        [
            cell.ljust(width) if k in LEFT else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        for row in table
    ]
    return ["  ".join(row).rstrip() for row in padded]
