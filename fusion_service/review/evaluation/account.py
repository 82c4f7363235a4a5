"""What a centre's pictures and step logs say of its work."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from fusion_service.review.evaluation.source_record import SourceRecords
from fusion_service.review.evaluation.turned_away import TurnedAway
from fusion_service.ways import fused_by
from schemas import GlobalTracks, Status, StepLog
from schemas.messages import BROKEN, CONFIRMED, GATE_FAILED, KEPT

__all__ = ["Account"]


@dataclass(slots=True, eq=False)
class Account:
    """What a centre's pictures and step logs say of its work.

    rules: those it named. ways: steps of confirmed tracks with a source, by what they were fused by. ungiven: source ->
    why its tracks are no tracklets, by the newest step log that says so, "" where they are. shown: pictures' confirmed
    tracks by number of their sources. ended: reason -> tracks. refused, dropped: (source, reason, "messages" or
    "tracks") -> how many. kept, failed, broken: source -> links that agreed, did not, were cut; innovation: source ->
    (n, sum of d2) of a link against the fusion of the other sources. dimension: of that d2, 0 without pictures.
    status: the newest, None without. sources: what it said of them. turned_away: what it did not take, and when.
    """

    rules: Counter[str] = field(default_factory=Counter)
    ways: Counter[str] = field(default_factory=Counter)
    ungiven: dict[str, str] = field(default_factory=dict)
    shown: Counter[int] = field(default_factory=Counter)
    pictures: int = 0
    steps: int = 0
    runs: set[int] = field(default_factory=set)
    dimension: int = 0
    ended: Counter[str] = field(default_factory=Counter)
    refused: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    dropped: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    kept: Counter[str] = field(default_factory=Counter)
    failed: Counter[str] = field(default_factory=Counter)
    broken: Counter[str] = field(default_factory=Counter)
    innovation: dict[str, tuple[int, float]] = field(default_factory=dict)
    status: Status | None = None
    sources: SourceRecords = field(default_factory=SourceRecords)
    turned_away: TurnedAway = field(default_factory=TurnedAway)

    def picture(self, message: GlobalTracks) -> None:
        """Enter a picture; of one that is a delta, not what it shows of the tracks that changed."""
        self.rules[message.rule] += 1
        self.pictures += 1
        self.dimension = len(message.space)
        self.runs.add(message.epoch)
        self.ended.update(reason for _, reason, _ in message.ended)
        if message.delta:
            return
        self.shown.update(message.contributor_counts[message.status == CONFIRMED].tolist())
        names, which = fused_by(message)
        fed = (message.status == CONFIRMED) & (message.contributor_counts > 0)
        self.ways.update(dict(zip(names, np.bincount(which[fed], minlength=len(names)).tolist(), strict=True)))

    def log(self, message: StepLog) -> None:
        """Enter a step log."""
        self.steps += 1
        self.sources.log(message)
        self.turned_away.log(message)
        self.runs.add(message.epoch)
        for event in message.events:
            if event.get("kind") == "tracklets":
                self.ungiven[str(event.get("source", ""))] = str(event.get("why", ""))
        for counter, entries in ((self.refused, message.refused), (self.dropped, message.dropped)):
            for entry in entries:
                what = "tracks" if entry.count else "messages"
                counter[entry.source, entry.reason, what] += entry.count or 1
        made = message.decisions
        for index, source in enumerate(message.sources):
            mine = made.source == index
            kinds = np.bincount(made.kind[mine], minlength=GATE_FAILED + 1)
            self.kept[source] += int(kinds[KEPT])
            self.failed[source] += int(kinds[GATE_FAILED])
            self.broken[source] += int(kinds[BROKEN])
            value = made.value[mine & ((made.kind == KEPT) | (made.kind == GATE_FAILED))]
            value = value[np.isfinite(value)]
            n, total = self.innovation.get(source, (0, 0.0))
            self.innovation[source] = n + len(value), total + float(value.sum())
