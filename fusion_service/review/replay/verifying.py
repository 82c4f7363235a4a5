"""A recorded step beside the same step made again: equal to the bit, or where they differ first."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre import StepResult
from fusion_service.recording.steps import Step
from fusion_service.ways import fused_by
from schemas import DECISIONS, STATUSES, GlobalTracks, StepLog, digest

__all__ = ["Difference", "Verdict", "published_as"]


class Difference(NamedTuple):
    """What differs: field, in words; track, the global id where it is about one; recorded and made, as texts;
    relative: by how much, of the larger of the two numbers, NaN where they are none."""

    field: str
    recorded: str
    made: str
    track: int | None = None
    relative: float = math.nan


def published_as(message: GlobalTracks, name: str) -> GlobalTracks:
    """A picture of a replay as the centre `name` publishes it: all of origin replay, `name` in its lineage."""
    lineage = (*(one for one in message.lineage or () if one != message.source), name)
    return replace(message, source=name, origin="replay", lineage=lineage, track_origin=None)


def differences(
    recorded: GlobalTracks | None, made: GlobalTracks, log: StepLog, made_log: StepLog
) -> Iterator[Difference]:
    """What differs between a recorded step and the one made again, but for `sent` and what was refused; nothing if
    they are equal. recorded: None where the recording has no picture of it."""
    if recorded is not None:
        codes = digest(replace(recorded, sent=0)), digest(replace(made, sent=0))
        found = False
        for one in _pictures(recorded, made) if codes[0] != codes[1] else ():
            found = True
            yield one
        if codes[0] != codes[1] and not found:
            yield Difference("digest of the picture", f"{codes[0]:016x}", f"{codes[1]:016x}")
    yield from _logs(log, made_log)


@dataclass
class Verdict:
    """What came of comparing. compared: steps; equal: those without a difference; unseen: those of which only the log
    is recorded; first: step, its time (ns) and the first difference; largest: relative difference of numbers."""

    compared: int = 0
    equal: int = 0
    unseen: int = 0
    first: tuple[int, int, Difference] | None = None
    largest: float = 0.0

    def look(self, step: Step, result: StepResult) -> None:
        """Compare a step that was made with the recorded one."""
        assert step.log is not None
        made, recorded = result.tracks, step.picture
        if recorded is not None and recorded.origin == "replay" and recorded.source != made.source:
            made = published_as(made, recorded.source)
        self.compared += 1
        self.unseen += recorded is None
        equal = True
        for one in differences(recorded, made, step.log, result.log):
            equal = False
            self.first = self.first or (step.number, step.time, one)
            self.largest = max(self.largest, 0.0 if math.isnan(one.relative) else one.relative)
        self.equal += equal

    @property
    def told(self) -> str:
        """In a line."""
        if self.first is None:
            seen = f", {self.unseen} of them by their log alone" if self.unseen else ""
            return f"{self.compared} steps made again{seen}: equal to the bit"
        number, at, one = self.first
        when = datetime.fromtimestamp(at / 1e9, UTC).strftime("%Y-%m-%dT%H:%M:%S.%f")[:-4] + "Z"
        whose = f"track {one.track} ({one.track % 2**32}), " if one.track is not None else ""
        text = f"differs first at step {number} ({when}): {whose}{one.field}: recorded {one.recorded}, made {one.made}"
        differing = self.compared - self.equal
        far = f", numbers by {self.largest:.2g} of themselves at most" if self.largest else ""
        return f"{text}; {differing} of {self.compared} compared steps differ{far}"


_LABELS = ("identity", "identity_p", "kind", "kind_p", "track_origin", "marks", "number", "callsign")
_HEADER = ("time", "rule", "space", "frame", "source", "epoch", "seq", "step", "origin", "lineage", "sources", "delta")


def _pictures(old: GlobalTracks, new: GlobalTracks) -> Iterator[Difference]:
    for name in _HEADER:
        if getattr(old, name) != getattr(new, name):
            yield Difference(name, _text(getattr(old, name)), _text(getattr(new, name)))
    for track in np.setxor1d(old.ids, new.ids).tolist():
        there = track in old.ids
        yield Difference("tracks", "there" if there else "not there", "not there" if there else "there", track)
    if np.array_equal(np.sort(old.ids), np.sort(new.ids)) and not np.array_equal(old.ids, new.ids):
        yield Difference("order of the tracks", _text(old.ids.tolist()), _text(new.ids.tolist()))
    if old.space == new.space and len(np.unique(old.ids)) == len(old.ids):
        rows = {track: row for row, track in enumerate(new.ids.tolist())}
        both = [(track, row, rows[track]) for row, track in enumerate(old.ids.tolist()) if track in rows]
        parts, made = _Parts(old), _Parts(new)
        for track, row, other in both:
            yield from _track(track, parts, row, made, other)
    for name in ("ended", "split_from"):
        if getattr(old, name) != getattr(new, name):
            yield Difference(name, _text(getattr(old, name)), _text(getattr(new, name)))


class _Parts:
    """A picture with the places of each track's components and contributions."""

    def __init__(self, picture: GlobalTracks) -> None:
        self.picture = picture
        self.ways, self.way = fused_by(picture)
        counts = np.ones(len(picture.ids), dtype=np.intp) if picture.counts is None else picture.counts
        self.components = np.concatenate([[0], np.cumsum(counts, dtype=np.intp)])
        self.contributions = np.concatenate([[0], np.cumsum(picture.contributor_counts, dtype=np.intp)])

    def numbers(self, row: int) -> Iterator[tuple[str, Any]]:
        """Names and values of what is said of one track."""
        picture = self.picture
        yield "status", STATUSES[picture.status[row]] if picture.status[row] < len(STATUSES) else "?"
        yield "existence", float(picture.existence[row])
        some = slice(self.components[row], self.components[row + 1])
        yield "components", some.stop - some.start
        space = picture.space
        for place in range(some.start, some.stop):
            part = f" of component {place - some.start + 1}" if some.stop - some.start > 1 else ""
            if picture.weights is not None:
                yield f"weight{part}", float(picture.weights[place])
            for i, name in enumerate(space):
                yield f"mean {name}{part}", float(picture.means[place, i])
            for i, one in enumerate(space):
                for j in range(i + 1):
                    yield f"covariance {one}, {space[j]}{part}", float(picture.covariances[place, i, j])
        yield "updated", int(picture.updated[row])
        for name in _LABELS:
            if (column := getattr(picture, name)) is not None:
                yield name.replace("_", " "), column[row] if isinstance(column, tuple) else column[row].item()
        yield "fused by", self.ways[self.way[row]]
        if picture.track_lineage is not None:
            yield "lineage", picture.track_lineage[row].tobytes().hex()
        some = slice(self.contributions[row], self.contributions[row + 1])
        who = [
            (picture.sources[source], epoch, track)
            for source, epoch, track in zip(
                picture.contributor_source[some].tolist(),
                picture.contributor_epoch[some].tolist(),
                picture.contributor_id[some].tolist(),
                strict=True,
            )
        ]
        yield "contributions", ", ".join(f"{name} {track}" for name, _, track in who) or "none"
        yield "epochs of the contributions", tuple(epoch for _, epoch, _ in who)
        for (name, _, track), value in zip(who, picture.contributor_influence[some].tolist(), strict=True):
            yield f"influence of {name} {track}", value


def _track(track: int, old: _Parts, row: int, new: _Parts, other: int) -> Iterator[Difference]:
    made = dict(new.numbers(other))
    for name, value in old.numbers(row):
        if not _same(value, made.get(name)):
            yield Difference(name, _text(value), _text(made.get(name, "none")), track, _relative(value, made.get(name)))


def _logs(old: StepLog, new: StepLog) -> Iterator[Difference]:
    taken, again = ({(e.source, e.epoch, e.seq, e.hash) for e in log.taken} for log in (old, new))
    for source, _, seq, _ in sorted(taken ^ again):
        yield Difference(f"taken: {source}, message {seq}", _there(taken, source, seq), _there(again, source, seq))
    if old.sources != new.sources:
        yield Difference("sources of the log", _text(old.sources), _text(new.sources))
    first, second = _decided(old), _decided(new)
    if len(first[0]) != len(second[0]):
        yield Difference("decisions", str(len(first[0])), str(len(second[0])))
        return
    unequal = np.zeros(len(first[0]), dtype=np.bool_)
    for one, two in zip(first, second, strict=True):
        unequal |= (one != two) & ~(_nan(one) & _nan(two))
    for row in np.flatnonzero(unequal).tolist():
        track = int(old.decisions.track[row])
        yield Difference("decision", _decision(old, row), _decision(new, row), track)


def _decided(log: StepLog) -> list[NDArray[Any]]:
    decisions = log.decisions
    return [getattr(decisions, name) for name in ("kind", "track", "source", "epoch", "id", "other", "value")]


def _decision(log: StepLog, row: int) -> str:
    one = log.decisions
    kind, source = int(one.kind[row]), int(one.source[row])
    word = DECISIONS[kind] if kind < len(DECISIONS) else str(kind)
    whom = f" {log.sources[source]} {one.id[row]}" if source < len(log.sources) else ""
    return f"{word}{whom} track {one.track[row]} other {one.other[row]} value {float(one.value[row])!r}"


def _there(entries: set[tuple[str, int, int, int]], source: str, seq: int) -> str:
    return "taken" if any((one[0], one[2]) == (source, seq) for one in entries) else "not taken"


def _nan(values: NDArray[Any]) -> NDArray[np.bool_]:
    return np.isnan(values) if values.dtype.kind == "f" else np.zeros(len(values), dtype=np.bool_)


def _same(one: Any, two: Any) -> bool:
    if isinstance(one, float) and isinstance(two, float):
        return np.float64(one).tobytes() == np.float64(two).tobytes()
    return bool(one == two)


def _relative(one: Any, two: Any) -> float:
    if not (isinstance(one, float) and isinstance(two, float)):
        return math.nan
    return abs(one - two) / max(abs(one), abs(two), 1e-300)


def _text(value: Any) -> str:
    text = repr(value) if isinstance(value, float) else str(value)
    return text if len(text) <= 120 else f"{text[:117]}..."
