"""The story of a true object: who covered and saw it when, which tracks followed it, and why none did when none did."""

from __future__ import annotations

import shlex
from typing import NamedTuple

import numpy as np

from fusion_service.errors import ReviewError
from fusion_service.labels import utc
from fusion_service.review.evaluation.assess import Assessment
from fusion_service.review.evaluation.gathering import Evaluation
from fusion_service.review.evaluation.misses import CAUSES, Coverages
from fusion_service.review.evaluation.scoring import Scores
from fusion_service.review.evaluation.tables import digits, percent
from fusion_service.review.evaluation.target_words import gap_words, target_name
from fusion_service.review.evaluation.targets import Spell, TargetRecord, spells
from fusion_service.review.snapshots import Times

__all__ = ["target_story"]

MOST_LINES = 200
MOST_NAMED = 20


class _Told(NamedTuple):
    at: int
    end: int
    rank: int
    text: str


def target_story(assessment: Assessment, centre: str, target: str) -> str:
    """In words; target: its name or id. Raises `ReviewError` for one that there is not, and where nothing is scored."""
    evaluation, start = _scored(assessment, centre)
    record = _record(evaluation, target, str(assessment.book.path or "the mission"))
    t = evaluation.targets.index(record.target)
    rows = sorted(_lines(assessment, evaluation, record, t, start), key=lambda one: (one.at, one.rank, one.end))
    shown = [(_span(one.at, one.end, start), one.text) for one in rows]
    if len(shown) > MOST_LINES:
        half = MOST_LINES // 2
        shown = [*shown[:half], ("...", f"{len(shown) - 2 * half} lines left out"), *shown[-half:]]
    table = [("s", "what"), *shown]
    width = max(len(when) for when, _ in table)
    timeline = [f"{when:<{width}}  {what}" for when, what in table]
    head = _head(assessment, evaluation, record, centre, start)
    return "\n".join([*head, "", *timeline, "", _summary(assessment, record, start)])


def _scored(assessment: Assessment, centre: str) -> tuple[Evaluation, int]:
    if centre not in assessment.evaluations:
        raise ReviewError(f"{assessment.book.path}: {assessment.unscored or f'centre {centre} has no scores'}")
    return assessment.evaluations[centre], int(assessment.book.times([centre])[0])


def _named(evaluation: Evaluation) -> str:
    names = sorted((target_name(one) for one in evaluation.records), key=lambda name: (len(name), name))
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return f"{', '.join(names[:MOST_NAMED])}{more}"


def _record(evaluation: Evaluation, target: str, path: str) -> TargetRecord:
    found = [one for one in evaluation.records if target.strip() in (one.name, str(one.target))]
    named = [one for one in found if one.name == target.strip()] or found
    if not named:
        raise ReviewError(f"{path}: no target {target!r} at a scored time; there are: {_named(evaluation)}")
    return named[0]


def _span(begin: int, end: int, start: int) -> str:
    first, last = f"{(begin - start) / 1e9:.1f}", f"{(end - start) / 1e9:.1f}"
    return first if first == last else f"{first}-{last}"


def _head(assessment: Assessment, evaluation: Evaluation, record: TargetRecord, centre: str, start: int) -> list[str]:
    name = f"target {record.target}" + (f" ({record.name})" if record.name else "")
    share = f" ({percent(round(record.followed / record.life, 3))})" if record.life else ""
    error = f"; RMSE {digits(record.rmse)} m" if np.isfinite(record.rmse) else ""
    tracks = ", ".join(map(assessment.book.labels, record.tracks)) or "none"
    return [
        f"{name} against the tracks of centre {centre} in {assessment.book.path}",
        f"mission from {utc(start, 'T')}, {len(evaluation.times)} scored times; cut-off {evaluation.c:g} m",
        f"there from {_span(record.begin, record.end, start)} s; followed {record.followed:.1f} of {record.life:.1f} s"
        f"{share}{error}; tracks it had: {tracks}; switches: {record.switches}",
    ]


def _lines(assessment: Assessment, evaluation: Evaluation, record: TargetRecord, t: int, start: int) -> list[_Told]:
    book, times = assessment.book, evaluation.times
    found = [_Told(begin, end, 0, f"covered by {name}") for name, begin, end in _covered(assessment, evaluation, t)]
    for name, sighting in sorted(evaluation.sightings.items()):
        for one in spells(sighting.held[:, t], times):
            local = sighting.numbers.keys[one.what][1]
            text = f"seen by {name} {local}{_error(evaluation.sources[name], times, one, t)}"
            found.append(_Told(one.begin, one.end, 1, text))
    fused = evaluation.fused_sighting
    if fused is not None:
        for one in spells(fused.held[:, t], times):
            label = book.labels(fused.numbers.keys[one.what][1])
            text = f"followed by track {label}{_error(evaluation.fused, times, one, t)}"
            found.append(_Told(one.begin, one.end, 2, text))
    for gap in record.gaps:
        by = f" (seen by {' '.join(gap.sources)})" if gap.sources else ""
        found.append(_Told(gap.begin, gap.end, 3, f"no fused track: {gap_words(gap, start)}{by}"))
    return found


def _error(scores: Scores, times: Times, one: Spell, t: int) -> str:
    """RMSE over a spell."""
    inside = (times >= one.begin) & (times <= one.end)
    errors = scores.errors[inside, t]
    errors = errors[np.isfinite(errors)]
    return f", RMSE {digits(float(np.sqrt(np.mean(errors**2))))} m" if len(errors) else ""


def _covered(assessment: Assessment, evaluation: Evaluation, t: int) -> list[tuple[str, int, int]]:
    """By which source that says what it covers, from when to when, ns."""
    found = []
    book, times = assessment.book, evaluation.times
    there = np.flatnonzero(evaluation.exists[:, t])
    for name in evaluation.sightings:
        coverages = Coverages([name], book.infos, book.platforms)
        if not coverages.told:
            continue
        inside = np.full(len(times), -1, dtype=np.int32)
        places = evaluation.places[:, t].T
        for k in there.tolist():
            if coverages.hold(int(times[k]), places[:, k : k + 1], evaluation.frame)[0]:
                inside[k] = 0
        found += [(name, one.begin, one.end) for one in spells(inside, times)]
    return found


def _summary(assessment: Assessment, record: TargetRecord, start: int) -> str:
    name = target_name(record)
    said = []
    if record.seen is None:
        said.append(f"No source ever had a track on target {name}.")
    else:
        first = f"{(record.seen[0] - start) / 1e9:.1f} s"
        said.append(f"Target {name} was first seen at {first}, by {' and '.join(record.seen[1])}.")
    if not record.tracks:
        said.append("No fused track ever followed it.")
    elif np.isfinite(record.confirm):
        said.append(f"A fused track followed it {record.confirm:.1f} s after it could first be known.")
    lost = [gap for gap in record.gaps if not gap.begun]
    again = sum(not gap.ended for gap in lost)
    if lost:
        said.append(f"It was lost {len(lost)} times" if len(lost) > 1 else "It was lost once")
        said[-1] += f", and found again {again} times." if again != 1 else ", and found again once."
    if record.causes:
        parts = [f"{CAUSES[code]} {seconds:.1f} s" for code, seconds in record.causes]
        said.append(f"Without a track for {record.missed:.1f} s: {', '.join(parts)}.")
    if record.tracks:
        asked = assessment.book.labels(record.tracks[-1])
        said.append(
            f"Of its last track: fusion-service explain {shlex.quote(str(assessment.book.path))} --track {asked}"
        )
    return " ".join(said)
