"""Scores and accounts as plain text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fusion_service.review.evaluation.source_record import sources_table
from fusion_service.ways import reason_words

if TYPE_CHECKING:
    from fusion_service.review.evaluation.account import Account
    from fusion_service.review.evaluation.assess import Assessment, Evaluation
    from fusion_service.review.evaluation.consistency import SourcePair
    from fusion_service.review.evaluation.scoring import Scores

__all__ = [
    "DELAYS",
    "NUMBERS",
    "ScoredCentre",
    "aligned",
    "best_rows",
    "comparison",
    "confirm_line",
    "digits",
    "fixed",
    "format_table",
    "links",
    "pair_words",
    "percent",
    "power_of_ten",
    "row_name",
    "rules_table",
    "sentence",
    "tracking_table",
    "truthless_lines",
    "way_shares",
]

RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


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
    return "\n".join([*lines, "", title, *aligned(table)] if evaluation.seen.max(initial=0) > 1 else lines)


def digits(value: float) -> str:
    """Four significant digits, no exponent."""
    if not np.isfinite(value):
        return "-"
    return f"{value:.{max(0, 3 - int(np.floor(np.log10(abs(value)))))}f}" if value else "0"


def fixed(*values: float) -> str:
    """Two decimals of each, - where one is not finite."""
    return " - ".join(f"{value:.2f}" for value in values) if np.isfinite(values).all() else "-"


def aligned(table: list[list[str]], left: int = 1, last_left: bool = False) -> list[str]:
    """Lines of columns, the first `left` of them, and the last if asked, to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = []
    for row in table:
        cells = [
            cell.ljust(width) if k < left or (last_left and k == len(row) - 1) else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        lines.append("  ".join(cells).rstrip() if last_left else "  ".join(cells))
    return lines


class ScoredCentre(NamedTuple):
    """One line of a comparison: which centre of which recording, its rule, its scores."""

    recording: str
    centre: str
    rule: str
    evaluation: Evaluation


def sentence(row: ScoredCentre) -> str:
    """How it went, in words."""
    evaluation, fused = row.evaluation, row.evaluation.fused
    if evaluation.centre is None:
        best = max(evaluation.sources.items(), key=lambda item: item[1].followed, default=None)
        if best is None:
            return "No fused tracks, and no source that could be scored."
        name, one = best
        text = [f"No fused tracks; {name} followed most targets, {one.followed} of {len(evaluation.targets)}"]
        if np.isfinite(one.rmse_position):
            text += [f"RMSE {metres(one.rmse_position)}", consistent(one.anees, one.bounds)]
        return "; ".join(text) + "."
    if not evaluation.targets:
        return f"Truth tells of no target; fused tracks ({row.rule}) were shown {int(fused.series.shown.sum())} times."
    shared = evaluation.shared["seen_by_2_or_more"]
    text = [f"Fused tracks ({row.rule}) followed {fused.followed} of {len(evaluation.targets)} targets"]
    if np.isfinite(fused.rmse_position):
        text.append(f"RMSE {metres(fused.rmse_position)}")
        least = min((one.rmse_position for one in evaluation.sources.values()), default=np.nan)
        if shared["pairs"] and np.isfinite(shared["best_rmse"]):
            text.append(
                f"where several sources see a target {metres(shared['fused_rmse'])}, "
                f"{_against(shared['fused_rmse'], shared['best_rmse'])} the best of them"
            )
        elif np.isfinite(least):
            text.append(f"{_against(fused.rmse_position, least)} the best source on its own targets")
        text.append(consistent(fused.anees, fused.bounds))
    return "; ".join(text) + "."


def row_name(row: ScoredCentre, rows: Sequence[ScoredCentre]) -> str:
    """As short as tells it from the others."""
    if len({one.rule for one in rows}) == len(rows):
        return row.rule
    name = row.centre if row.centre == row.rule else f"{row.centre} ({row.rule})"
    if len({one.centre for one in rows}) == len(rows):
        return name
    alone = len({one.recording for one in rows}) == len(rows)
    return f"{row.recording} ({row.rule})" if alone else f"{row.recording}, {name}"


def comparison(rows: Sequence[ScoredCentre]) -> str:
    """Which of several rows are best at what, in words."""
    fused = [row.evaluation.fused for row in rows]
    parts = []
    for what, values, say in (
        ("smallest GOSPA", [one.gospa for one in fused], metres),
        ("smallest error", [one.rmse_position for one in fused], lambda value: f"RMSE {metres(value)}"),
        ("best consistency", [abs(one.anees - 1) for one in fused], lambda _: ""),
    ):
        if np.isfinite(values).any():
            best = int(np.nanargmin(values))
            said = say(values[best]) or f"ANEES {fused[best].anees:.2f}"
            parts.append(f"{what}: {row_name(rows[best], rows)} ({said})")
    text = "; ".join(parts)
    followed = sorted({(one.followed, len(row.evaluation.targets)) for one, row in zip(fused, rows, strict=True)})
    counts = " to ".join(f"{n} of {of}" for n, of in ([followed[0], followed[-1]] if len(followed) > 1 else followed))
    return f"{len(rows)} fusions, which followed {counts} targets; {text}."


def consistent(anees: float, bounds: tuple[float, float]) -> str:
    """What an ANEES says of the covariances."""
    low, high = bounds
    if low <= anees <= high:
        return f"consistent: ANEES {anees:.2f} within {low:.2f} to {high:.2f}"
    if anees < low:
        return f"cautious: ANEES {anees:.2f}, below {low:.2f}: covariances are larger than the errors"
    return f"overconfident: ANEES {anees:.2f}, above {high:.2f}: covariances are smaller than the errors"


def _against(value: float, other: float) -> str:
    share = round(100 * (value / other - 1)) if other > 0 else 0
    return f"{abs(share)} % {'below' if share < 0 else 'above'}" if share else "the same as"


def metres(value: float) -> str:
    """As a person says it: three digits, km from 10 km."""
    if not np.isfinite(value):
        return "-"
    number, unit = (value / 1000, "km") if abs(value) >= 1e4 else (value, "m")
    return f"{number:.{max(0, 2 - int(np.floor(np.log10(abs(number)))))}f} {unit}" if number else f"0 {unit}"


RULES = (
    "recording",
    "centre",
    "rule",
    "followed",
    "GOSPA",
    "OSPA",
    "OSPA(2)",
    "RMSE",
    "RMSE, 2+",
    "ANEES",
    "switches",
    "complete",
)
"""Columns of the table of rules ("RMSE, 2+": of targets that two sources or more track). Of the numbers the lower is
the better, ANEES by its distance from 1, but of followed and complete the higher."""
NUMBERS = len(RULES) - 3
"""Of its columns the last ones."""


def rules_table(rows: Sequence[ScoredCentre]) -> list[list[str]]:
    """A line for each centre of each recording, without the columns that say the same in all."""
    table = [list(RULES), *([*cells] for cells in map(_cells, rows))]
    dull = [k for k in range(2) if len({line[k] for line in table[1:]}) == 1]
    return [[cell for k, cell in enumerate(line) if k not in dull] for line in table]


def _cells(row: ScoredCentre) -> list[str]:
    fused = row.evaluation.fused
    numbers = (
        fused.gospa,
        fused.ospa,
        fused.ospa2,
        fused.rmse_position,
        row.evaluation.shared["seen_by_2_or_more"]["fused_rmse"],
    )
    return [
        row.recording,
        row.centre,
        row.rule,
        f"{fused.followed}/{len(row.evaluation.targets)}",
        *map(digits, numbers),
        fixed(fused.anees),
        str(fused.identity_switches),
        percent(fused.siap.completeness),
    ]


def best_rows(rows: Sequence[ScoredCentre]) -> dict[str, set[int]]:
    """Column of `RULES` -> the rows that are best in it; nothing where all are."""
    fused = [row.evaluation.fused for row in rows]
    ranked: dict[str, list[float]] = {
        "followed": [-one.followed for one in fused],
        "GOSPA": [one.gospa for one in fused],
        "OSPA": [one.ospa for one in fused],
        "OSPA(2)": [one.ospa2 for one in fused],
        "RMSE": [one.rmse_position for one in fused],
        "RMSE, 2+": [row.evaluation.shared["seen_by_2_or_more"]["fused_rmse"] for row in rows],
        "ANEES": [abs(one.anees - 1) for one in fused],
        "switches": [one.identity_switches for one in fused],
        "complete": [-one.siap.completeness for one in fused],
    }
    found: dict[str, set[int]] = {}
    for name, values in ranked.items():
        shown = [f"{value:.4g}" for value in values]
        least = f"{np.nanmin(values):.4g}" if np.isfinite(values).any() else ""
        best = {index for index, value in enumerate(shown) if value == least}
        found[name] = best if len(best) < len(rows) else set()
    return found


def tracking_table(scored: Mapping[str, Scores], targets: int) -> list[list[str]]:
    """Sources and fused tracks by name: OSPA, and how they hold on to targets."""
    head = "OSPA,OSPA(2),followed,complete,ambiguity,spurious,PA m,VA m/s,changes/h,longest"
    table = [["", *head.split(",")]]
    for name, one in scored.items():
        siap = one.siap
        table.append(
            [
                name,
                digits(one.ospa),
                digits(one.ospa2),
                f"{one.followed}/{targets}",
                percent(siap.completeness),
                fixed(siap.ambiguity),
                percent(siap.spuriousness),
                digits(siap.position_accuracy),
                digits(siap.velocity_accuracy),
                fixed(3600 * siap.track_number_changes),
                percent(siap.longest_segment),
            ]
        )
    return table


def confirm_line(evaluation: Evaluation) -> str:
    """Time to confirm, in words."""
    known, after = evaluation.begins >= 0, evaluation.confirm[np.isfinite(evaluation.confirm)]
    never = int(known.sum()) - len(after)
    if not known.any():
        return "Time to confirm: no source covers or tracks any target."
    if not len(after):
        return f"Time to confirm: none of {int(known.sum())} targets that could be known ever was."
    text = f"Time to confirm: median {np.median(after):.3g} s, longest {after.max():.3g} s"
    return f"{text}, of {len(after)} targets" + (f"; {never} that could be known never were." if never else ".")


def truthless_lines(assessment: Assessment, centre: str) -> list[str]:
    """What needs no truth, of one centre: agreement of sources, links, coverage, gaps, refusals, delays."""
    book, account = assessment.book, assessment.book.accounts.get(centre)
    lines: list[str] = []
    agreement = assessment.agreements.get(centre)
    if agreement and any(pair.n for pair in agreement.pairs.values()):
        lines.append(
            "Sources against each other (d2 of linked tracks over its dimension; 1: as their covariances say):"
        )
        table = [["", "pairs", "mean", "95 % bounds", ""]]
        for (a, b), pair in agreement.pairs.items():
            if pair.n:
                table.append([f"{a}, {b}", str(pair.n), fixed(pair.mean), fixed(*pair.bounds), pair_words(pair)])
        lines += [*aligned(table, last_left=True), ""]
    if account:
        lines += _source_lines(account)
        lines += _account_lines(account)
    quiet = [(name, one) for (kind, name), one in sorted(book.traffic.items()) if one.missing or one.silent]
    lines += [
        f"{name}: {one.missing} messages missing, {one.silent} silent spans"
        + (f", the longest {(one.silences[0].end - one.silences[0].begin) / 1e9:.3g} s" if one.silences else "")
        for name, one in quiet
    ]
    table = [["delays, s", "", "median", "95 %", "largest"]]
    for (kind, name), delay in sorted(book.latency.items()):
        if kind in DELAYS:
            table.append([name, DELAYS[kind], *(f"{value:.3g}" for value in (delay.median, delay.p95, delay.largest))])
    if len(table) > 1:
        lines += ["", *aligned(table, left=2)]
    return lines


DELAYS = {
    "bus": "sent to received",
    "source": "time of the tracks to sent",
    "centre": "time of the step to published",
    "reaction": "last message of a step to its picture, as received",
}


def pair_words(pair: SourcePair) -> str:
    """What the agreement of two sources says."""
    if pair.mean > pair.bounds[1]:
        return "covariances too small, or biased"
    if pair.mean < pair.bounds[0]:
        return "covariances too large, or errors correlated"
    return "as said"


def links(account: Account) -> list[list[str]]:
    """By source with links: kept, failed a gate, cut, and the mean of d2 / n against the fusion of the others."""
    lines = []
    for name, (n, total) in sorted(account.innovation.items()):
        counts = (account.kept[name], account.failed[name], account.broken[name])
        mean = total / n / account.dimension if n and account.dimension else float("nan")
        if any(counts):
            lines.append([name, *map(str, counts), fixed(mean)])
    return lines


def _source_lines(account: Account) -> list[str]:
    table, said = sources_table(account.sources)
    if not table:
        return []
    title = "The sources, as the centre saw them at the end (normalised square beside the others, 1 is right):"
    return [title, *aligned(table, left=2), *said, ""]


def _account_lines(account: Account) -> list[str]:
    lines = []
    shown = sum(account.shown.values())
    if shown:
        parts = [f"{percent(count / shown)} by {_sources(n)}" for n, count in sorted(account.shown.items())]
        lines.append(f"Confirmed tracks are fed: {', '.join(parts)}.")
    if ways := way_shares(account):
        lines.append(f"Confirmed tracks were fused by {', '.join(f'{way} {share}' for way, share in ways)}.")
    lines += [f"{name}: no tracklets: {reason_words(why)}" for name, why in sorted(account.ungiven.items()) if why]
    table = [["links of", "kept", "failed a gate", "cut", "mean d2 / n"], *links(account)]
    if len(table) > 1:
        lines += ["", "Each source against the fusion of the others (equal weights, cautious: below 1 is usual):"]
        lines += [*aligned(table), ""]
    for verb, counter in (("Refused", account.refused), ("Dropped", account.dropped)):
        for (source, reason, what), count in sorted(counter.items()):
            lines.append(f"{verb}: {count} {what} of {source or 'several'}: {reason}")
    return lines


def way_shares(account: Account) -> list[tuple[str, str]]:
    """Share of the steps of confirmed tracks that each way of fusion has, the most frequent first; none where all went
    by the rule."""
    ways = +account.ways
    if set(ways) <= set(account.rules):
        return []
    return [(way, percent(count / ways.total())) for way, count in ways.most_common()]


def _sources(n: int) -> str:
    return {0: "none (coasting)", 1: "1 source"}.get(n, f"{n} sources")


def percent(share: float) -> str:
    """0.05 as 5 %."""
    return f"{100 * share:.3g} %" if np.isfinite(share) else "-"


def power_of_ten(power: int) -> str:
    """10 with its power raised: 10⁶."""
    return f"10{str(power).translate(RAISED)}"
