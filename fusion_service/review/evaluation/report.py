"""One page about one or more missions, for people: HTML that needs no other file, no script and no network."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from fusion_service.errors import ReviewError
from fusion_service.extras import install_hint
from fusion_service.labels import utc
from fusion_service.review.evaluation.assess import Assessment, Evaluation
from fusion_service.review.evaluation.hull_table import TITLE, hull_table
from fusion_service.review.evaluation.report_tables import html_table, mark
from fusion_service.review.evaluation.report_text import CSS, WORDS
from fusion_service.review.evaluation.report_truthless import without_truth
from fusion_service.review.evaluation.results import (
    comparison_of,
    facts,
    label,
    lead,
    promises,
    rows_of,
    truthless_lead,
)
from fusion_service.review.evaluation.scoring import Scores
from fusion_service.review.evaluation.source_record import MOST_SAID, SourceRecords, sources_table
from fusion_service.review.evaluation.tables import (
    NUMBERS,
    ScoredCentre,
    best_rows,
    confirm_line,
    digits,
    fixed,
    power_of_ten,
    row_name,
    rules_table,
    tracking_table,
)
from fusion_service.review.evaluation.target_words import HEAD, LEFT, missed_summary, target_table

__all__ = ["need_matplotlib", "report"]

MOST_TARGETS = 200
SCORES = (
    "",
    "RMSE, m",
    "GOSPA, m",
    "localisation, m²",
    "missed, m²",
    "false, m²",
    "ANEES",
    "95 % bounds",
    "switches",
)
SHARED = ("", "pairs", "RMSE fused", "best single", "ANEES fused", "best single", "95 % bounds", "no fused track")


def need_matplotlib() -> None:
    """`ReviewError` where it is not there."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ReviewError(f"a page needs matplotlib ({error}): {install_hint('report')}") from None


def report(assessments: Sequence[Assessment], more: Sequence[str] = ()) -> str:
    """The page about missions, of which there must be one; more: what stands before all details."""
    from fusion_service.review.evaluation.report_charts import charts

    rows = rows_of(assessments)
    title = ", ".join(dict.fromkeys(label(one) or "mission" for one in assessments))
    body = [f"<h1>Mission review: {escape(title)}</h1>"]
    body += [f'<p class="lead">{escape(said)}</p>' for said in lead(assessments)]
    for one in assessments:
        if one.unscored:
            text = f"{label(one) or 'The mission'}: {one.unscored}. {truthless_lead(one)} What follows needs no truth."
            body.append(f'<p class="lead">{escape(text)}</p>')
    body += [_facts(one) for one in assessments]
    body += more
    if len(rows) > 1:
        body += ["<h2>Rules beside each other</h2>", _rules(rows, ranked=comparison_of(assessments).ranked)]
    body += _map(assessments[0])
    for one in assessments:
        if group := rows_of([one]):
            which = f": {escape(label(one))}" if len(assessments) > 1 else ""
            body += [f"<h2>Tracks against the truth{which}</h2>", *_against_truth(group), *_targets(group, one)]
    if rows:
        figures = [f"<figure>{svg}<figcaption>{escape(text)}</figcaption></figure>" for svg, text in charts(rows)]
        body += ["<h2>Over time</h2>", f'<div class="charts">{"".join(figures)}</div>']
    for one in assessments:
        for name, account in one.book.accounts.items():
            of = f": {label(one) or name}" if len(assessments) + len(one.book.accounts) > 2 else ""
            body += _sources(one, account.sources, of)
    for one in assessments:
        body += without_truth(one, f": {label(one)}" if len(assessments) > 1 else "")
    words = "".join(f"<dt>{escape(word)}</dt><dd>{escape(text)}</dd>" for word, text in WORDS.items())
    body += ["<h2>How to read the numbers</h2>", f'<dl class="words">{words}</dl>']
    head = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>Mission review: {escape(title)}</title><style>{CSS}</style></head>"
    )
    return f"{head}<body>{''.join(body)}</body></html>\n"


def _short(value: float) -> str:
    """Large numbers with their power of ten."""
    if not value >= 1e5:
        return digits(value)
    mantissa, power = f"{value:.2e}".split("e+")
    return f"{mantissa}·{power_of_ten(int(power))}"


def _facts(one: Assessment) -> str:
    lines = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts(one).items())
    return f'<dl class="facts">{lines}</dl>'


def _rules(rows: Sequence[ScoredCentre], *, ranked: bool) -> str:
    head, *lines = rules_table(rows)
    best = best_rows(rows) if ranked else {}
    marks = {(index, k): "best" for k, name in enumerate(head) for index in best.get(name, ())}
    text = "The best of each column is marked (ANEES: nearest to 1). GOSPA, OSPA, RMSE in m; 2+: targets that several"
    marked = f"{text} sources track." if ranked else "Not ranked: each row is of a mission of its own."
    note = f'<p class="note">{marked} A rank is of this mission; what a rule promises holds in all.</p>'
    said = "".join(f"<dt>{escape(rule)}</dt><dd>{escape(text)}</dd>" for rule, text in promises(rows).items())
    return html_table(head, lines, marks, left=len(head) - NUMBERS) + note + f'<dl class="facts">{said}</dl>'


def _map(one: Assessment) -> list[str]:
    from fusion_service.review.mission_map import mission_map

    with tempfile.TemporaryDirectory(prefix="report-") as folder:
        try:
            path = mission_map(one.sample, Path(folder) / "map.png")
        except ValueError:
            return []
        encoded = base64.b64encode(path.read_bytes()).decode()
    text = "Truth, what each source tracked, and the fused tracks. Details show two targets at their true scale."
    return [
        "<h2>Map</h2>",
        f'<figure class="map"><div class="scroll"><img alt="Map of the mission" src="data:image/png;base64,{encoded}">'
        f"</div><figcaption>{text}</figcaption></figure>",
    ]


def _against_truth(rows: Sequence[ScoredCentre]) -> list[str]:
    """Of the rows of one recording."""
    evaluation = rows[0].evaluation
    fused = {
        f"fused ({row_name(row, rows) if len(rows) > 1 else row.rule})": row.evaluation
        for row in rows
        if row.evaluation.centre
    }
    scored = {**evaluation.sources, **{name: one.fused for name, one in fused.items()}}
    about = (
        f"Scored at {len(evaluation.times)} times against {len(evaluation.targets)} targets, "
        f"{utc(int(evaluation.times[0]))} to {utc(int(evaluation.times[-1]))}; GOSPA with p = 2, alpha = 2, "
        f"c = {evaluation.c:g} m."
    )
    found = [f'<p class="note">{escape(about)}</p>', _scores(scored)]
    if hull := hull_table(scored):
        found += ["<h3>Against the hulls</h3>", html_table(hull[0], hull[1:]), f'<p class="note">{escape(TITLE)}.</p>']
    found += [f"<p>Not scored: {escape(name)}: {escape(why)}</p>" for name, why in evaluation.left_out.items()]
    if evaluation.seen.max(initial=0) > 1 and fused:
        text = "On the same pairs of target and time. The best single source is found with the truth, for each target."
        found += ["<h3>What fusion gains: targets that several sources track</h3>", _gain(fused)]
        found.append(f'<p class="note">{text}</p>')
    names, *following = tracking_table(scored, len(evaluation.targets))
    found += ["<h3>How well tracks hold on to targets</h3>", html_table(names, following)]
    told: dict[str, list[str]] = {}
    for name, one in fused.items():
        told.setdefault(confirm_line(one), []).append(name)
    found += [f"<p>{escape(line + ('' if len(told) == 1 else ' ' + ', '.join(of)))}</p>" for line, of in told.items()]
    return found


def _targets(rows: Sequence[ScoredCentre], one: Assessment) -> list[str]:
    """Each target of each row."""
    found = []
    for row in rows:
        evaluation = row.evaluation
        if evaluation.centre is None or not evaluation.records:
            continue
        of = f": {row_name(row, rows)}" if len(rows) > 1 else ""
        found.append(f"<h3>Each target{escape(of)}</h3>")
        summary, start = missed_summary(evaluation), int(evaluation.times[0])
        found += [f"<p>{escape(summary)}</p>"] if summary else []
        table = target_table(evaluation, start, one.book.labels, MOST_TARGETS)
        order = [*range(3), len(HEAD) - 1, *range(3, len(HEAD) - 1)]
        head, *lines = ([line[k] for k in order] for line in table)
        found.append(html_table(head, lines, columns=[order.index(k) for k in LEFT], wide=3))
        left = len(evaluation.records) - MOST_TARGETS
        more = f" {left} more are in --json." if left > 0 else ""
        found.append(f'<p class="note">The worst first; times in s from the first scored one.{more}</p>')
    return found


def _scores(scored: Mapping[str, Scores]) -> str:
    """A line for each source, and for the fused tracks of each row."""
    lines = [
        [
            name,
            *map(digits, (one.rmse_position, one.gospa)),
            *map(_short, (one.gospa_localisation, one.gospa_missed, one.gospa_false)),
            fixed(one.anees),
            fixed(*one.bounds),
            str(one.identity_switches),
        ]
        for name, one in scored.items()
    ]
    return html_table(
        SCORES, lines, {(index, 6): mark(one.anees, one.bounds) for index, one in enumerate(scored.values())}
    )


def _gain(fused: Mapping[str, Evaluation]) -> str:
    """Fused tracks beside the best single source: of one row by how many saw a target, of several of two or more."""
    lines = [
        [
            name if len(fused) > 1 else kind.replace("_", " "),
            str(line["pairs"]),
            digits(line["fused_rmse"]),
            digits(line["best_rmse"]),
            fixed(line["fused_anees"]),
            fixed(line["best_anees"]),
            fixed(*line["nees_bounds"]),
            str(line["fused_missed"]),
        ]
        for name, one in fused.items()
        for kind, line in one.shared.items()
        if len(fused) == 1 or kind == "seen_by_2_or_more"
    ]
    return html_table(SHARED, lines)


def _sources(one: Assessment, records: SourceRecords, of: str) -> list[str]:
    """How the centre trusted the sources, and what it found of their clocks and places."""
    from fusion_service.colours import source_colours
    from fusion_service.review.evaluation.report_sources import source_charts

    table, said = sources_table(records)
    if not table:
        return []
    head, *lines = table
    found = [f"<h2>The sources{escape(of)}</h2>", html_table(head, lines, left=2)]
    found.append('<p class="note">At the end; ± one standard deviation. The charts show how it came to be.</p>')
    found += [f"<p>{escape(sentence)}</p>" for sentence in said]
    start = one.book.span[0] if one.book.span else 0
    events = sorted((time, name, text) for name, record in records.by_name.items() for time, _, text in record.said)
    if events:
        rows = [[f"{(time - start) / 1e9:.1f}", name, text] for time, name, text in events[:MOST_SAID]]
        left = len(events) - len(rows) + sum(record.more for record in records.by_name.values())
        found += ["<h3>What was said of them</h3>", html_table(("s", "source", ""), rows, left=3)]
        found += [f'<p class="note">{left} more.</p>'] if left else []
    figures = source_charts(records, start, source_colours([*one.book.sources, *one.book.infos]))
    shown = [f"<figure>{svg}<figcaption>{escape(text)}</figcaption></figure>" for svg, text in figures]
    return [*found, f'<div class="charts">{"".join(shown)}</div>'] if shown else found
