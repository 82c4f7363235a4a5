"""The section of the report that needs no truth: tracks against tracks, gaps, refusals, delays."""

from __future__ import annotations

from html import escape
from itertools import combinations

from fusion_service.labels import utc
from fusion_service.review.evaluation.assess import Assessment
from fusion_service.review.evaluation.report_tables import html_table, mark
from fusion_service.review.evaluation.results import rule_of
from fusion_service.review.evaluation.tables import DELAYS, fixed, links, pair_words, percent, way_shares
from fusion_service.ways import reason_words

__all__ = ["without_truth"]


def without_truth(one: Assessment, which: str) -> list[str]:
    from fusion_service.colours import source_colours
    from fusion_service.review.evaluation.report_charts import delay_chart

    book = one.book
    colours = source_colours([*book.sources, *book.infos])
    found = [f"<h2>Tracks against tracks, without any truth{escape(which)}</h2>"]
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
            found.append(html_table(["sources", *(n for n, _ in parts)], shares))
        if ways := way_shares(account):
            found.append(f"<h3>What confirmed tracks were fused by{escape(of)}</h3>")
            found.append(html_table(["", *(way for way, _ in ways)], [["share", *(share for _, share in ways)]]))
        if reasons := [[name, reason_words(why)] for name, why in sorted(account.ungiven.items()) if why]:
            found.append(html_table(("no tracklets of", "because"), reasons, left=2))
        if lines := links(account):
            found.append(f"<h3>Links against the fusion of the others{escape(of)}</h3>")
            found.append(html_table(("", "kept", "failed a gate", "cut", "mean d² / n"), lines))
        refusals = [
            [verb, source or "several", reason, f"{count} {what}"]
            for verb, counter in (("refused", account.refused), ("dropped", account.dropped))
            for (source, reason, what), count in sorted(counter.items())
        ]
        found.append(f"<h3>Refused and dropped{escape(of)}</h3>")
        found.append(
            html_table(("", "source", "reason", "how many"), refusals, left=3)
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
            html_table(("", "of", "messages", "median, ms", "95 %, ms", "largest, ms"), lines, left=2),
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
            marks[row, column + 1] = mark(pair.mean, pair.bounds)
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
    detail = "" if len(words) > 15 else html_table(head, words)
    return html_table(["", *names], lines, marks) + key + detail


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
    return html_table(head, lines)
