"""What a centre said of its sources over a mission: how far they were trusted, how shifted, and since when."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from fusion_service.source_words import Bias, biases, consistency, source_event, source_health, state_of
from schemas import Status, StepLog

__all__ = ["MOST_SAID", "Sample", "SourceRecord", "SourceRecords", "sources_table"]

MOST_SAMPLES = 2000
"""Of one source; where there are more, every other one goes."""
MOST_SAID = 200
"""Events of one source that are told."""
MOST_SOURCES = 1000


class Sample(NamedTuple):
    """Of one status: time, ns; consistency with its bounds (NaN where not known); the parts of the bias that are
    observable, by key."""

    time: int
    consistency: float
    low: float
    high: float
    biases: dict[str, Bias]


@dataclass(slots=True)
class SourceRecord:
    """One source. samples: in the order they came, thinned; newest: its entry in the newest status; said: (time, ns,
    whether it is bad news, sentence) of events, the first `MOST_SAID`; more: how many came after these."""

    samples: list[Sample] = field(default_factory=list)
    newest: Mapping[str, Any] = field(default_factory=dict)
    said: list[tuple[int, bool, str]] = field(default_factory=list)
    more: int = 0
    _every: int = 1
    _turn: int = 0

    def status(self, time: int, said: Mapping[str, Any]) -> None:
        """Take the source's entry in a status."""
        self.newest = said
        turn, self._turn = self._turn, self._turn + 1
        found = consistency(said)
        parts = {one.key: one for one in biases(said) if one.observable}
        if turn % self._every or (found is None and not parts):
            return
        self.samples.append(Sample(time, *(found or (math.nan, math.nan, math.nan)), parts))
        if len(self.samples) > MOST_SAMPLES:
            self.samples, self._every = self.samples[::2], 2 * self._every

    def event(self, time: int, bad: bool, text: str) -> None:
        """Take an event about the source."""
        if len(self.said) < MOST_SAID:
            self.said.append((time, bad, text))
        else:
            self.more += 1


class SourceRecords:
    """Of all sources of a centre, by name. told: whether it says how it trusts them at all."""

    def __init__(self) -> None:
        self.by_name: dict[str, SourceRecord] = {}

    @property
    def told(self) -> bool:
        return any(state_of(one.newest) or one.samples for one in self.by_name.values())

    def _of(self, name: str) -> SourceRecord | None:
        if name not in self.by_name and len(self.by_name) >= MOST_SOURCES:
            return None
        return self.by_name.setdefault(name, SourceRecord())

    def status(self, message: Status) -> None:
        """Enter a status."""
        for name, said in message.sources.items():
            if (record := self._of(name)) is not None:
                record.status(message.time, said)

    def log(self, message: StepLog) -> None:
        """Enter a step log."""
        for event in message.events:
            said = source_event(event)
            name = event.get("source")
            if said is not None and isinstance(name, str) and (record := self._of(name)) is not None:
                record.event(message.time, *said)


COLUMNS = ("", "state", "beside the others", "right within", "clock, s", "x, m", "y, m", "heading, °", "range, m")
KEYS = ("clock", "x", "y", "heading", "range")


def sources_table(records: SourceRecords) -> tuple[list[list[str]], list[str]]:
    """A line for each source, under `COLUMNS`, as the newest status has it; and sentences about them. No lines where
    the centre says nothing of the kind."""
    if not records.told:
        return [], []
    table, sentences = [list(COLUMNS)], []
    for name, record in sorted(records.by_name.items()):
        said, parts = record.newest, {one.key: one for one in biases(record.newest)}
        found = consistency(said)
        beside = ["-", "-"] if found is None else [f"{found[0]:.2f}", f"{found[1]:.2f} - {found[2]:.2f}"]
        table.append([name, state_of(said) or "-", *beside, *(_shown(parts.get(key)) for key in KEYS)])
        sentences += [f"{name}: {line}" for line in source_health(said)]
    dull = [k for k in range(4, len(COLUMNS)) if all(line[k] == "-" for line in table[1:])]
    return [[cell for k, cell in enumerate(line) if k not in dull] for line in table], sentences


def _shown(one: Bias | None) -> str:
    if one is None:
        return "-"
    return f"{one.value:+.3g} ± {one.sigma:.2g}" if one.observable else "not observable"
