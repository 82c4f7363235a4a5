"""One page about one or more missions, for people: HTML that needs no other file, no script and no network."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from itertools import combinations
from pathlib import Path

import numpy as np

from fusion_service.errors import ReviewError
from fusion_service.extras import install_hint
from fusion_service.labels import utc
from fusion_service.review.evaluation.assess import Assessment, Evaluation
from fusion_service.review.evaluation.hull_table import TITLE, hull_table
from fusion_service.review.evaluation.report_text import CSS, WORDS
from fusion_service.review.evaluation.results import facts, label, rows_of, rule_of
from fusion_service.review.evaluation.scoring import Scores
from fusion_service.review.evaluation.source_record import MOST_SAID, SourceRecords, sources_table
from fusion_service.review.evaluation.tables import (
    DELAYS,
    NUMBERS,
    ScoredCentre,
    best_rows,
    comparison,
    confirm_line,
    digits,
    fixed,
    links,
    pair_words,
    percent,
    power_of_ten,
    row_name,
    rules_table,
    sentence,
    tracking_table,
    way_shares,
)
from fusion_service.ways import reason_words

__all__ = ["need_matplotlib", "report"]

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


def report(assessments: Sequence[Assessment]) -> str:
    """The page about missions, of which there must be one."""
    from fusion_service.review.evaluation.report_charts import charts

    rows = rows_of(assessments)
    title = ", ".join(dict.fromkeys(label(one) or "mission" for one in assessments))
    body = [f"<h1>Mission review: {escape(title)}</h1>"]
    if rows:
        body.append(f'<p class="lead">{escape(sentence(rows[0]) if len(rows) == 1 else comparison(rows))}</p>')
    for one in assessments:
        if one.unscored:
            text = f"{label(one) or 'The mission'}: {one.unscored}. What follows needs no truth."
            body.append(f'<p class="lead">{escape(text)}</p>')
    body += [_facts(one) for one in assessments]
    if len(rows) > 1:
        body += ["<h2>Rules beside each other</h2>", _rules(rows)]
    body += _map(assessments[0])
    for one in assessments:
        if group := rows_of([one]):
            which = f": {escape(label(one))}" if len(assessments) > 1 else ""
            body += [f"<h2>Against the truth{which}</h2>", *_against_truth(group)]
    if rows:
        figures = [f"<figure>{svg}<figcaption>{escape(text)}</figcaption></figure>" for svg, text in charts(rows)]
        body += ["<h2>Over time</h2>", f'<div class="charts">{"".join(figures)}</div>']
    for one in assessments:
        for name, account in one.book.accounts.items():
            of = f": {label(one) or name}" if len(assessments) + len(one.book.accounts) > 2 else ""
            body += _sources(one, account.sources, of)
    for one in assessments:
        body += _without_truth(one, f": {label(one)}" if len(assessments) > 1 else "")
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


def _table(
    head: Sequence[str], lines: Iterable[Sequence[str]], marks: dict[tuple[int, int], str] | None = None, left: int = 1
) -> str:
    """marks: (row, column) -> class of the cell; a row that begins with "fused" stands out. The first `left` columns,
    and one without a name, stand to the left."""
    marks = marks or {}
    parts = ["<tr>", *(f"<th{_left(k, left)}>{escape(cell)}</th>" for k, cell in enumerate(head)), "</tr>"]
    for index, line in enumerate(lines):
        parts.append('<tr class="fused">' if line and line[0].startswith("fused") else "<tr>")
        for k, cell in enumerate(line):
            mark = marks.get((index, k), "")
            classes = " ".join(filter(None, (mark, "left" if 0 < k < left or (k and not head[k]) else "")))
            parts.append(f'<td class="{classes}">' if classes else "<td>")
            parts.append(f"{escape(cell)}</td>")
        parts.append("</tr>")
    return f'<div class="scroll"><table>{"".join(parts)}</table></div>'


def _left(k: int, left: int) -> str:
    return ' class="left"' if 0 < k < left else ""


def _rules(rows: Sequence[ScoredCentre]) -> str:
    head, *lines = rules_table(rows)
    best = best_rows(rows)
    marks = {(index, k): "best" for k, name in enumerate(head) for index in best.get(name, ())}
    text = "The best of each column is marked (ANEES: nearest to 1). GOSPA, OSPA, RMSE in m; 2+: targets that several"
    note = f'<p class="note">{text} sources track.</p>'
    return _table(head, lines, marks, left=len(head) - NUMBERS) + note


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
        found += ["<h3>Against the hulls</h3>", _table(hull[0], hull[1:]), f'<p class="note">{escape(TITLE)}.</p>']
    found += [f"<p>Not scored: {escape(name)}: {escape(why)}</p>" for name, why in evaluation.left_out.items()]
    if evaluation.seen.max(initial=0) > 1 and fused:
        text = "On the same pairs of target and time. The best single source is found with the truth, for each target."
        found += ["<h3>What fusion gains: targets that several sources track</h3>", _gain(fused)]
        found.append(f'<p class="note">{text}</p>')
    names, *following = tracking_table(scored, len(evaluation.targets))
    found += ["<h3>How well tracks hold on to targets</h3>", _table(names, following)]
    told: dict[str, list[str]] = {}
    for name, one in fused.items():
        told.setdefault(confirm_line(one), []).append(name)
    found += [f"<p>{escape(line + ('' if len(told) == 1 else ' ' + ', '.join(of)))}</p>" for line, of in told.items()]
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
    return _table(
        SCORES, lines, {(index, 6): _mark(one.anees, one.bounds) for index, one in enumerate(scored.values())}
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
    return _table(SHARED, lines)


def _mark(value: float, bounds: tuple[float, float]) -> str:
    """The class of a cell with a mean that lies within `bounds`, below or above; none without one."""
    low, high = bounds
    return "" if not np.isfinite(value) else "low" if value < low else "high" if value > high else "good"


def _sources(one: Assessment, records: SourceRecords, of: str) -> list[str]:
    """How the centre trusted the sources, and what it found of their clocks and places."""
    from fusion_service.colours import source_colours
    from fusion_service.review.evaluation.report_sources import source_charts

    table, said = sources_table(records)
    if not table:
        return []
    head, *lines = table
    found = [f"<h2>The sources{escape(of)}</h2>", _table(head, lines, left=2)]
    found.append('<p class="note">At the end; ± one standard deviation. The charts show how it came to be.</p>')
    found += [f"<p>{escape(sentence)}</p>" for sentence in said]
    start = one.book.span[0] if one.book.span else 0
    events = sorted((time, name, text) for name, record in records.by_name.items() for time, _, text in record.said)
    if events:
        rows = [[f"{(time - start) / 1e9:.1f}", name, text] for time, name, text in events[:MOST_SAID]]
        left = len(events) - len(rows) + sum(record.more for record in records.by_name.values())
        found += ["<h3>What was said of them</h3>", _table(("s", "source", ""), rows, left=3)]
        found += [f'<p class="note">{left} more.</p>'] if left else []
    figures = source_charts(records, start, source_colours([*one.book.sources, *one.book.infos]))
    shown = [f"<figure>{svg}<figcaption>{escape(text)}</figcaption></figure>" for svg, text in figures]
    return [*found, f'<div class="charts">{"".join(shown)}</div>'] if shown else found


def _without_truth(one: Assessment, which: str) -> list[str]:
    from fusion_service.colours import source_colours
    from fusion_service.review.evaluation.report_charts import delay_chart

    book = one.book
    colours = source_colours([*book.sources, *book.infos])
    found = [f"<h2>Without any truth{escape(which)}</h2>"]
    for name, agreement in list(one.agreements.items())[:1]:
        if any(pair.n for pair in agreement.pairs.values()):
            found += ["<h3>Sources against each other</h3>", _matrix(one, name)]
    for name, account in book.accounts.items():
        of = f" ({name}: {rule_of(one, name)})" if len(book.accounts) > 1 else ""
        shown = sum(account.shown.values())
        if shown:
            parts = [(str(n) if n else "none, coasting", count) for n, count in sorted(account.shown.items())]
            found.append(f"<h3>How many sources feed a confirmed track{escape(of)}</h3>")
            shares = [["share", *(percent(count / shown) for _, count in parts)]]
            found.append(_table(["sources", *(n for n, _ in parts)], shares))
        if ways := way_shares(account):
            found.append(f"<h3>What confirmed tracks were fused by{escape(of)}</h3>")
            found.append(_table(["", *(way for way, _ in ways)], [["share", *(share for _, share in ways)]]))
        if reasons := [[name, reason_words(why)] for name, why in sorted(account.ungiven.items()) if why]:
            found.append(_table(("no tracklets of", "because"), reasons, left=2))
        if lines := links(account):
            found.append(f"<h3>Links against the fusion of the others{escape(of)}</h3>")
            found.append(_table(("", "kept", "failed a gate", "cut", "mean d² / n"), lines))
        refusals = [
            [verb, source or "several", reason, f"{count} {what}"]
            for verb, counter in (("refused", account.refused), ("dropped", account.dropped))
            for (source, reason, what), count in sorted(counter.items())
        ]
        found.append(f"<h3>Refused and dropped{escape(of)}</h3>")
        found.append(
            _table(("", "source", "reason", "how many"), refusals, left=3)
            if refusals
            else "<p>Nothing, by the step logs.</p>"
            if account.steps
            else "<p>No step logs were recorded.</p>"
        )
    found += ["<h3>Gaps</h3>", _gaps(one)]
    delays = [(kind, {n: d for (k, n), d in book.latency.items() if k == kind}) for kind in DELAYS]
    lines = [
        [DELAYS[kind], name, str(delay.n), *(f"{1000 * value:.3g}" for value in delay[1:4])]
        for kind, some in delays
        for name, delay in sorted(some.items())
    ]
    if lines:
        found += [
            "<h3>Delays</h3>",
            _table(("", "of", "messages", "median, ms", "95 %, ms", "largest, ms"), lines, left=2),
        ]
        figures = [
            f"<figure>{delay_chart(some, colours, DELAYS[kind].capitalize())}</figure>" for kind, some in delays if some
        ]
        found.append(f'<div class="charts">{"".join(figures)}</div>')
    return found


def _matrix(one: Assessment, centre: str) -> str:
    pairs = one.agreements[centre].pairs
    names = sorted({name for pair in pairs for name in pair})
    lines, marks, words = [], {}, []
    for row, name in enumerate(names):
        line = [name]
        for column, other in enumerate(names):
            pair = pairs.get((min(name, other), max(name, other)))
            if name == other or pair is None or not pair.n:
                line.append("·")
                marks[row, column + 1] = "none"
                continue
            line.append(fixed(pair.mean))
            marks[row, column + 1] = _mark(pair.mean, pair.bounds)
        lines.append(line)
    for a, b in combinations(names, 2):
        pair = pairs[a, b]
        if pair.n:
            words.append([f"{a}, {b}", str(pair.n), fixed(pair.mean), fixed(*pair.bounds), pair_words(pair)])
    key = (
        '<p class="note">Mean of the squared distance of linked tracks over its dimension.'
        '<span class="swatch" style="background:#dff2e8"></span>as the covariances say'
        '<span class="swatch" style="background:#fbdcd0"></span>above: too small, biased, or wrong links'
        '<span class="swatch" style="background:#dceaf6"></span>below: too large, or correlated errors</p>'
    )
    head = ("sources", "pairs", "mean", "95 % bounds", "")
    detail = "" if len(words) > 15 else _table(head, words)
    return _table(["", *names], lines, marks) + key + detail


def _gaps(one: Assessment) -> str:
    lines = []
    for (kind, name), traffic in sorted(one.book.traffic.items(), reverse=True):
        longest = traffic.silences[0] if traffic.silences else None
        lines.append(
            [
                f"{name} (centre)" if kind == "global" else name,
                str(traffic.messages),
                f"{traffic.interval:.3g}",
                str(traffic.epochs),
                str(traffic.missing),
                str(traffic.silent),
                f"{(longest.end - longest.begin) / 1e9:.3g} s from {utc(longest.begin)}" if longest else "-",
            ]
        )
    head = ("", "messages", "interval, s", "runs", "numbers missing", "silent spans", "longest silence")
    return _table(head, lines)
