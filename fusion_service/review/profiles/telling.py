"""What came of a profile: in words, as plain values, and as a part of the page."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from types import MappingProxyType
from typing import Any, NamedTuple

from fusion_service.review.evaluation.tables import aligned
from fusion_service.review.profiles.judging import FAILED, NOT_SHOWN, PASSED, Judged, Verdict, worst
from fusion_service.review.profiles.profile import KINDS, Profile, Requirement

__all__ = ["Told", "against", "as_json", "page", "summary", "text"]

MOST_TARGETS = 5
MOST_COLUMNS = 40
SECONDS = {"longer_than_s": "in gaps over", "interval_s": "of", "horizon_s": "ahead by", "after_s": "after"}
"""What keys are called beside a share."""
MARKS = {PASSED: "good", FAILED: "high", NOT_SHOWN: "low"}


class Told(NamedTuple):
    """One recording's centre under a profile. reference: what it was judged by, in words; names: of targets, by id."""

    profile: Profile
    recording: str
    centre: str
    cutoff: float
    reference: str
    judged: list[Judged]
    names: Mapping[int, str] = MappingProxyType({})


def asked(one: Requirement) -> str:
    """The number asked, with what it is of: `>= 97 %`."""
    numbers = one.numbers
    for key, sign, scale in (("share_min", ">=", 100.0), ("share_max", "<=", 100.0)):
        if numbers.get(key) is not None:
            share = scale * numbers[key]
            within = next((f" within {_value(numbers, key)}" for key in _withins(one)), "")
            key = next((key for key in SECONDS if numbers.get(key)), "")
            return f"{sign} {share:.6g} %{within}" + (f" {SECONDS[key]} {numbers[key]:g} s" if key else "")
    for key, unit in (("rms_max_m", "m"), ("rms_max_m_per_s", "m/s"), ("per_target_hour_max", "per target hour")):
        if numbers.get(key) is not None:
            return f"<= {numbers[key]:g} {unit}"
    return ""


def _withins(one: Requirement) -> list[str]:
    return [key for key in ("within_m", "within_m_per_s", "within_s") if one.numbers.get(key) is not None]


def _value(numbers: Any, key: str) -> str:
    unit = {"within_m": "m", "within_m_per_s": "m/s", "within_s": "s"}[key]
    return f"{numbers[key]:g} {unit}"


def found(one: Requirement, verdict: Verdict) -> str:
    """The number found, in the same unit."""
    if math.isnan(verdict.found):
        return "-"
    if any(one.numbers.get(key) is not None for key in ("share_min", "share_max")):
        return f"{100 * verdict.found:.4g} %"
    unit = "m" if one.numbers.get("rms_max_m") else "m/s" if one.numbers.get("rms_max_m_per_s") else "/h"
    return f"{verdict.found:.4g} {unit}"


def _samples(verdict: Verdict, one: Requirement) -> str:
    return f"{verdict.samples:.3g} h" if one.kind == "continuity" else f"{verdict.samples:,.0f}"


def summary(told: Sequence[Told]) -> str:
    """The verdict of all, in a line."""
    count = Counter(one.verdict for each in told for one in each.judged)
    parts = [f"{count[verdict]} {verdict}" for verdict in (PASSED, FAILED, NOT_SHOWN) if count[verdict]]
    return f"{told[0].profile.name}: {', '.join(parts)}"


def text(told: Sequence[Told]) -> str:
    """For a terminal."""
    lines: list[str] = []
    for each in told:
        lines += [
            "",
            f"Profile {each.profile.name}: {each.recording}, centre {each.centre}, cut-off {each.cutoff:g} m"
            + (f", against {each.reference}" if each.reference else ""),
        ]
        head = ["requirement", "area", "asked", "found", "samples", "verdict"]
        table = [
            [one.requirement.name, one.requirement.area, asked(one.requirement), found(one.requirement, one.whole),
             _samples(one.whole, one.requirement), one.verdict]
            for one in each.judged
        ]  # fmt: skip
        lines += aligned([head, *table], left=3)
        for one in each.judged:
            lines += _remarks(one, each.names)
        if each.profile.note:
            lines.append(f"note: {each.profile.note}")
    return "\n".join([*lines, "", summary(told)])


def _remarks(one: Judged, names: Mapping[int, str]) -> list[str]:
    lines = []
    if one.whole.words and (one.verdict == NOT_SHOWN or not one.whole.samples):
        lines.append(f"  {one.requirement.name}: {one.whole.words}")
    bad = {target: verdict for target, verdict in one.targets.items() if verdict.verdict == FAILED}
    if bad and (one.verdict == FAILED or one.requirement.each_target):
        worst_first = sorted(bad, key=lambda target: bad[target].found, reverse="share_min" not in _asked(one))
        named = [
            f"{names.get(target, target)} ({found(one.requirement, bad[target])})"
            for target in worst_first[:MOST_TARGETS]
        ]
        more = f" and {len(bad) - MOST_TARGETS} more" if len(bad) > MOST_TARGETS else ""
        lines.append(f"  {one.requirement.name}: not kept by target {', '.join(named)}{more}")
    if one.requirement.unverified:
        lines.append(f"  {one.requirement.name}: figure not verified: {one.requirement.unverified}")
    return lines


def _asked(one: Judged) -> list[str]:
    return [key for key, value in one.requirement.numbers.items() if value is not None]


def as_json(told: Sequence[Told]) -> list[dict[str, Any]]:
    """Everything, a part for each centre."""
    return [
        {
            "profile": each.profile.name,
            "source": each.profile.source,
            "file": each.profile.path,
            "recording": each.recording,
            "centre": each.centre,
            "cutoff": each.cutoff,
            "reference": each.reference,
            "verdict": worst(each.judged),
            "names": {str(target): name for target, name in each.names.items()},
            "requirements": [
                {**one.as_json(), "asked": asked(one.requirement), "counted": KINDS[one.requirement.kind].words}
                for one in each.judged
            ],
        }
        for each in told
    ]


def against(reference: str, odd: Sequence[str] = ()) -> list[str]:
    """The page's word of what all is scored against, where it is not the recording's own truth; odd: of that truth."""
    said = [f"Scored against {reference}.", *odd] if reference else []
    return [f'<p class="lead">{escape(one)}</p>' for one in said]


def page(told: Sequence[Told]) -> list[str]:
    """Parts of the page in HTML."""
    body: list[str] = []
    for each in told:
        body.append(f"<h2>Requirements: {escape(each.profile.name)} ({escape(each.centre)})</h2>")
        about = f"{summary([each])}. By {each.profile.source}; cut-off {each.cutoff:g} m" + (
            f"; against {each.reference}" if each.reference else ""
        )
        body.append(f'<p class="lead">{escape(about)}.</p>')
        head = ("requirement", "verdict", "area", "asked", "found", "samples", "how sure")
        rows, sources = [], []
        for one in each.judged:
            need = one.requirement
            source = need.source + (f" (not verified: {need.unverified})" if need.unverified else "")
            cells = [need.area, asked(need), found(need, one.whole), _samples(one.whole, need)]
            marked = f'<td class="{MARKS[one.verdict]}">{one.verdict}</td>'
            sure = f'<td class="left" style="white-space:normal;min-width:14em">{escape(one.whole.words)}</td>'
            plain = "".join(f'<td class="left">{escape(cell)}</td>' for cell in cells)
            rows.append(f'<td class="left">{escape(need.name)}</td>{marked}{plain}{sure}')
            sources.append(f"<dt>{escape(need.name)}</dt><dd>{escape(source)}</dd>" if source else "")
        body.append(_table([f'<th class="left">{cell}</th>' for cell in head], rows))
        body.append(f'<dl class="facts">{"".join(sources)}</dl>')
        body += _by_target(each)
        if each.profile.note:
            body.append(f'<p class="note">{escape(each.profile.note)}</p>')
        body.append(
            '<p class="note">Passed: the number keeps to what is asked, and so does its one-sided confidence bound, '
            "the samples taken as independent. Not shown: it does, on too few samples to exclude a worse one.</p>"
        )
    return body


def _by_target(each: Told) -> list[str]:
    names, targets = each.names, sorted({target for one in each.judged for target in one.targets})
    if not targets:
        return []
    head = [
        '<th class="left">target</th>',
        *(f"<th>{escape(one.requirement.name)}</th>" for one in each.judged if one.targets),
    ]
    rows = []
    for target in targets[:MOST_COLUMNS]:
        cells = [f'<td class="left">{escape(names.get(target, str(target)))}</td>']
        for one in each.judged:
            if not one.targets:
                continue
            said = one.targets.get(target)
            words = "-" if said is None else found(one.requirement, said)
            cells.append(f'<td class="{"none" if said is None else MARKS[said.verdict]}">{escape(words)}</td>')
        rows.append("".join(cells))
    more = f'<p class="note">{len(targets) - MOST_COLUMNS} more targets are in the JSON.</p>'
    return ["<h3>Target by target</h3>", _table(head, rows), *([more] if len(targets) > MOST_COLUMNS else [])]


def _table(head: Sequence[str], rows: Sequence[str]) -> str:
    lines = "".join(f"<tr>{row}</tr>" for row in rows)
    return f'<div class="scroll"><table><tr>{"".join(head)}</tr>{lines}</table></div>'
