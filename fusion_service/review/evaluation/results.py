"""What `evaluate` says of one or more recordings: on a terminal, and as plain values for JSON."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fusion_service.labels import utc
from fusion_service.review.evaluation.assess import Assessment
from fusion_service.review.evaluation.comparable import Comparison, compared
from fusion_service.review.evaluation.hull_table import hull_lines
from fusion_service.review.evaluation.scoring import plain
from fusion_service.review.evaluation.tables import (
    NUMBERS,
    ScoredCentre,
    aligned,
    comparison,
    confirm_line,
    format_table,
    pair_words,
    percent,
    row_name,
    rules_table,
    sentence,
    tracking_table,
    truthless_lines,
)
from fusion_service.review.evaluation.target_words import target_lines
from fusion_service.rules import RULES
from fusion_service.source_words import biases, consistency, state_of
from fusion_service.ways import AUTO_PROMISE

__all__ = [
    "comparison_of",
    "facts",
    "label",
    "lead",
    "promises",
    "results",
    "rows_of",
    "rule_of",
    "text",
    "truthless_lead",
]

MOST_NAMED = 6
"""Sources and pairs of them that a sentence names."""


def rule_of(assessment: Assessment, centre: str) -> str:
    """The rule that a centre's pictures name most often."""
    account = assessment.book.accounts.get(centre)
    named = account.rules.most_common(1) if account else []
    return named[0][0] if named else "no centre"


def rows_of(assessments: Sequence[Assessment]) -> list[ScoredCentre]:
    """A row for each centre that could be scored."""
    return [
        ScoredCentre(label(one), centre, rule_of(one, centre), evaluation)
        for one in assessments
        for centre, evaluation in one.evaluations.items()
    ]


def comparison_of(assessments: Sequence[Assessment]) -> Comparison:
    """Whether several recordings may be ranked."""
    scored = [one for one in assessments if one.evaluations]
    evaluations = [next(iter(one.evaluations.values())) for one in scored]
    return compared([label(one) for one in scored], evaluations, [one.book.inputs for one in scored])


def lead(assessments: Sequence[Assessment]) -> list[str]:
    """How it went, in sentences: of one row, or which of several are best at what, where these may be compared."""
    rows, said = rows_of(assessments), comparison_of(assessments)
    if not rows:
        return []
    if len(rows) == 1:
        return [sentence(rows[0])]
    if said.ranked:
        return [f"{comparison(rows)} {said.but}".strip()]
    return [said.against, *(f"{row_name(row, rows)}: {sentence(row)}" for row in rows)]


def truthless_lead(one: Assessment) -> str:
    """What is there of a mission without truth, in a sentence."""
    book = one.book
    sources = [
        f"{name} {1 / traffic.interval if traffic.interval > 0 else 0:.3g} messages a second of "
        f"{traffic.tracks / max(traffic.messages, 1):.3g} {'tracks' if kind == 'local' else 'components'}"
        for (kind, name), traffic in sorted(book.traffic.items())
        if kind != "global"
    ]
    more = f" and {len(sources) - MOST_NAMED} more" if len(sources) > MOST_NAMED else ""
    said = [f"{len(sources)} sources ({'; '.join(sources[:MOST_NAMED])}{more})" if sources else "no sources"]
    for name in book.centres[:1]:
        account = book.accounts[name]
        shown, pictures = sum(account.shown.values()), max(account.pictures, 1)
        several = sum(count for n, count in account.shown.items() if n > 1)
        fed = f", {percent(several / shown)} of them by several sources" if shown else ""
        said.append(f"centre {name}: {shown / pictures:.3g} confirmed tracks on average{fed}")
    agreement = next(iter(one.agreements.values()), None)
    pairs = [pair for pair in (agreement.pairs.items() if agreement else ()) if pair[1].n]
    odd = [f"{' and '.join(names)}: {pair_words(found)}" for names, found in pairs if pair_words(found) != "as said"]
    if pairs:
        said.append("; ".join(odd[:MOST_NAMED]) if odd else "sources agree with each other as their covariances say")
    return f"There are {'; '.join(said)}."


def promises(rows: Sequence[ScoredCentre]) -> dict[str, str]:
    """What each rule that occurs promises, whatever its rank in this mission."""
    known = {name: rule.promise for name, rule in RULES.items()} | {"auto": AUTO_PROMISE}
    return {
        rule: known.get(rule, "not known here: a rule of one's own") for rule in dict.fromkeys(r.rule for r in rows)
    }


def label(assessment: Assessment) -> str:
    """The recording by its name, that of its folder if its own says nothing; empty for a mission in memory."""
    path = assessment.book.path
    return (path.parent.name if path.stem == "mission" and path.parent.name else path.stem) if path else ""


def facts(assessment: Assessment) -> dict[str, str]:
    """The mission in a few lines."""
    book = assessment.book
    span = book.span
    sources = [
        f"{name} ({one.tracks} {'tracks' if kind == 'local' else 'components'})"
        for (kind, name), one in sorted(book.traffic.items())
        if kind != "global"
    ]
    centres = [
        f"{name}: {rule_of(assessment, name)}, {book.traffic['global', name].messages} pictures"
        + (f", {len(book.accounts[name].runs)} runs" if len(book.accounts[name].runs) > 1 else "")
        for name in book.centres
    ]
    found = {
        "recording": str(book.path) if book.path else "in memory",
        "mission time": f"{utc(span[0])} to {utc(span[1])}, {(span[1] - span[0]) / 1e9:g} s" if span else "none",
        "origin": ", ".join(sorted(book.origins)),
        "sources": ", ".join(sources) or "none",
        "centres": "; ".join(centres) or "none",
        "messages": ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in sorted(book.counts.items())),
    }
    if book.bad:
        found["not read"] = ", ".join(f"{count} messages: {reason}" for reason, count in sorted(book.bad.items()))
    chosen = " (chosen: about 10 times the typical standard deviation)" if assessment.chosen else ""
    found["cut-off"] = f"{assessment.c:g} m{chosen or (' (kept in the recording)' if assessment.kept else '')}"
    return found


def text(assessments: Sequence[Assessment], against: str = "the truth") -> str:
    """The plain summary: first in words, then tables; of several centres of a recording the tables of the first.
    against: what they are scored by."""
    rows, lines = rows_of(assessments), []
    lines += lead(assessments)
    lines += [
        f"{label(one) or 'The mission'}: {one.unscored}. {truthless_lead(one)}" for one in assessments if one.unscored
    ]
    if len(rows) > 1:
        lines += ["", *aligned(rules_table(rows), left=len(rules_table(rows)[0]) - NUMBERS)]
        lines += ["", "A rank is of this mission; what a rule promises holds in all:"]
        lines += [f"  {rule}: {promise}" for rule, promise in promises(rows).items()]
    for one in assessments:
        centre = next(iter(one.evaluations), next(iter(one.agreements), ""))
        lines += [
            "",
            f"{one.book.path or 'mission'}" + (f", cut-off {facts(one)['cut-off']}" if one.chosen or one.kept else ""),
        ]
        if one.book.bad:
            lines.append(f"not read: {facts(one)['not read']}")
        if one.evaluations:
            evaluation = one.evaluations[centre]
            if len(one.evaluations) > 1:
                lines.append(f"of {centre} (--centre NAME shows another, --html and --json all of them):")
            lines += [f"Tracks against {against}:"]
            scored = {**evaluation.sources, **({"fused": evaluation.fused} if evaluation.centre else {})}
            lines += [format_table(evaluation), ""]
            lines += [*hull, ""] if (hull := hull_lines(scored)) else []
            lines += [*aligned(tracking_table(scored, len(evaluation.targets))), confirm_line(evaluation), ""]
            lines += target_lines(evaluation, int(evaluation.times[0]), one.book.labels)
        if truthless := truthless_lines(one, centre):
            lines += ["", "Tracks against tracks, which needs no truth:", *truthless]
    return "\n".join(line for k, line in enumerate(lines) if line or k == 0 or lines[k - 1])


def results(assessments: Sequence[Assessment]) -> dict[str, Any]:
    """All numbers. `rows`: one for each centre of each recording, with the keys of `Evaluation.as_json` and, as `more`,
    the rest; `recordings`: what needs no truth."""
    rows = []
    for one in assessments:
        path = str(one.book.path or "")
        for centre, evaluation in one.evaluations.items():
            told = evaluation.as_json(Path(path).stem, rule_of(one, centre), path)
            rows.append({**told, "more": evaluation.more_json()})
    said = comparison_of(assessments)
    return {
        "rows": rows,
        "recordings": [_recording(one) for one in assessments],
        "ranked": said.ranked,
        "not_ranked_because": said.against,
        "compare_with_care": said.but,
        "promises": promises(rows_of(assessments)),
    }


def _recording(one: Assessment) -> dict[str, Any]:
    book = one.book
    return {
        "recording": str(book.path or ""),
        "span_ns": list(book.span) if book.span else None,
        "messages": dict(book.counts),
        "not_read": dict(book.bad),
        "unscored": one.unscored,
        "cutoff": one.c,
        "cutoff_chosen": one.chosen,
        "cutoff_kept": one.kept,
        "traffic": {
            f"{kind}/{name}": {
                "messages": traffic.messages,
                "tracks": traffic.tracks,
                "interval": traffic.interval,
                "epochs": traffic.epochs,
                "missing": traffic.missing,
                "silent": traffic.silent,
                "silences_ns": [list(span) for span in traffic.silences],
            }
            for (kind, name), traffic in sorted(book.traffic.items())
        },
        "latency": {
            f"{kind}/{name}": {key: plain(getattr(delay, key)) for key in delay._fields}
            for (kind, name), delay in sorted(book.latency.items())
        },
        "centres": {name: _centre(one, name) for name in sorted(book.accounts)},
    }


def _centre(one: Assessment, name: str) -> dict[str, Any]:
    account, agreement = one.book.accounts[name], one.agreements.get(name)
    reasons = {"refused": account.refused, "dropped": account.dropped}
    return {
        "rules": dict(account.rules),
        "fused_by": dict(account.ways),
        "no_tracklets": {source: why for source, why in sorted(account.ungiven.items()) if why},
        "sources": {
            source: {
                "state": state_of(record.newest),
                "consistency": plain((consistency(record.newest) or (float("nan"),))[0]),
                "bias": {
                    one.key: {"value": one.value, "sigma": one.sigma, "unit": one.unit, "observable": one.observable}
                    for one in biases(record.newest)
                },
                "said": [{"time_ns": time, "bad": bad, "text": text} for time, bad, text in record.said],
            }
            for source, record in sorted(account.sources.by_name.items())
        },
        "runs": len(account.runs),
        "steps": account.steps,
        "confirmed_by_sources": {str(n): count for n, count in sorted(account.shown.items())},
        "ended": dict(account.ended),
        **{
            verb: [
                {"source": source, "reason": reason, "what": what, "count": count}
                for (source, reason, what), count in sorted(counter.items())
            ]
            for verb, counter in reasons.items()
        },
        "links": {
            source: {
                "kept": account.kept[source],
                "gate_failed": account.failed[source],
                "broken": account.broken[source],
                "compared": n,
                "mean_d2_over_n": plain(total / n / account.dimension if n and account.dimension else float("nan")),
            }
            for source, (n, total) in sorted(account.innovation.items())
        },
        "agreement": [
            {"sources": list(pair), "pairs": found.n, "mean": plain(found.mean), "bounds": plain(found.bounds)}
            for pair, found in (agreement.pairs.items() if agreement else ())
        ],
        "step_time": account.status.step_time if account.status else {},
    }
