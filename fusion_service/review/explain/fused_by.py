"""By which way the tracks of a mission were fused, step by step, and whose tracks were no tracklets and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from fusion_service.recording.steps import Step
from fusion_service.source_words import source_event
from fusion_service.ways import fused_by
from schemas import GlobalTracks
from schemas.messages import CONFIRMED

__all__ = ["FusedBy", "SourceSaid", "Spell", "shares"]

MOST = 10_000
"""Spells of a track, and words on sources, that are kept."""
SPELLS = 12
"""Spells that are told one by one."""


@dataclass(slots=True)
class Spell:
    """Steps in which the track was fused by one way, from the first to the last, ns; spells: how many these are."""

    first: int
    last: int
    way: str
    steps: int = 1
    spells: int = 1

    def __str__(self) -> str:
        often = f" in {self.spells} spells" if self.spells > 1 else ""
        return f"fused by {self.way}, {self.steps} step{'s' * (self.steps != 1)}{often}"


@dataclass(frozen=True, slots=True)
class SourceSaid:
    """What the centre said of a source at a time, ns, in words; kind: of the event; good: whether all is well since."""

    time: int
    source: str
    text: str
    kind: str
    good: bool


class FusedBy:
    """Gathered step by step. several: whether any track was fused in another way than by the rule for all; all: steps
    of confirmed tracks by way; steps: those of the one track; said: of sources, in the order of time."""

    def __init__(self) -> None:
        self.several = False
        self.all: Counter[str] = Counter()
        self.steps: Counter[str] = Counter()
        self.said: list[SourceSaid] = []
        self._spells: list[Spell] = []

    def step(self, step: Step, track: int | None) -> None:
        """Take a step of the centre; track: the one that is asked for, if any."""
        if step.log is not None and len(self.said) < MOST:
            self.said += [
                SourceSaid(step.time, str(event.get("source", "")), said[1], str(event.get("kind")), not said[0])
                for event in step.log.events
                if (said := source_event(event)) is not None
            ]
        if step.picture is not None:
            self._picture(step.picture, track)

    def _picture(self, picture: GlobalTracks, track: int | None) -> None:
        names, which = fused_by(picture)
        self.several |= picture.rules is not None
        fed = picture.contributor_counts > 0
        counts = np.bincount(which[fed & (picture.status == CONFIRMED)], minlength=len(names))
        self.all.update({name: count for name, count in zip(names, counts.tolist(), strict=True) if count})
        if track is None:
            return
        for row in np.flatnonzero((picture.ids == np.uint64(track)) & fed).tolist():
            self._one(picture.time, names[which[row]])

    def _one(self, at: int, way: str) -> None:
        self.steps[way] += 1
        if self._spells and self._spells[-1].way == way:
            self._spells[-1].last = at
            self._spells[-1].steps += 1
        elif len(self._spells) < MOST:
            self._spells.append(Spell(at, at, way))

    def spells(self) -> list[Spell]:
        """Of the track, in the order of time; of each way one, where there are many."""
        if len(self._spells) <= SPELLS:
            return self._spells
        joined: dict[str, Spell] = {}
        for one in self._spells:
            known = joined.setdefault(one.way, Spell(one.first, one.last, one.way, 0, 0))
            known.last, known.steps, known.spells = one.last, known.steps + one.steps, known.spells + 1
        return list(joined.values())

    def of(self, sources: Iterable[str], first: int, last: int) -> list[SourceSaid]:
        """What was said of these sources between two times, ns, and what held of them before."""
        wanted = set(sources)
        before = {(one.source, one.kind): one for one in self.said if one.source in wanted and one.time < first}
        return [
            one
            for one in self.said
            if one.source in wanted and one.time <= last and (one.time >= first or before[one.source, one.kind] is one)
        ]

    def unwell(self) -> list[SourceSaid]:
        """The newest word of each kind on each source, where it is bad news at the end."""
        newest = {(one.source, one.kind): one for one in self.said}
        return [newest[key] for key in sorted(newest) if not newest[key].good]


def shares(steps: Counter[str]) -> str:
    """`tracklet 92 %, ci 8 %`, the most frequent first."""
    total = max(steps.total(), 1)
    return ", ".join(f"{way} {100 * count / total:.3g} %" for way, count in steps.most_common())
