"""How a source's messages come, and whom of the others' targets it has: told, and used for nothing.

Latency is from the time that the tracks are of, by the source's clock, to when they came, by the receiver's: the way of
a message and the offset of the clocks cannot be told apart in it. Where the offset is known by the motion of targets
(`registration`), it is there. Jitter is that of RFC 3550, 6.4.1: the mean change of the latency from one message to the
next, of which no constant offset is part. Loss is the part of the numbers in the sequence that never came.

Of a source's targets, those count as confirmed that another source has too, among those that another one covers, by
what it declares; as missed, those that others have in its own declared coverage, and it has not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from fusion_service.arrays import Bools
from fusion_service.centre.intake import Intake
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.sources import Source
from fusion_service.coverage import covers

__all__ = ["Traffic"]

JITTER = 16.0
AVERAGED = 30.0
"""Messages that period and latency are averaged over."""
REMEMBERED = 1000.0
"""Targets, times scans, that the shares hold about."""
FEW = 20.0
"""Without which no share is told."""


@dataclass(slots=True)
class Record:
    """Of one source: messages; period, latency, jitter, s; transit of the last message, s, and its time, ns; of its own
    targets that others should have: seen, confirmed; of others' that it should have: due, missed."""

    messages: float = 0.0
    period: float = 0.0
    latency: float = 0.0
    jitter: float = 0.0
    transit: float = 0.0
    last: int = -1
    seen: float = 0.0
    confirmed: float = 0.0
    due: float = 0.0
    missed: float = 0.0

    def came(self, time: int, received: int) -> None:
        """A message with tracks of `time` came, both ns."""
        transit = (received - time) / 1e9
        part = 1.0 / min(self.messages + 1.0, AVERAGED)
        if self.messages:
            self.jitter += (abs(transit - self.transit) - self.jitter) / min(self.messages, JITTER)
        if 0 <= self.last < time:
            gap = (time - self.last) / 1e9
            self.period += (gap - self.period) * (part if self.period else 1.0)
        self.latency += (transit - self.latency) * part
        self.messages, self.transit, self.last = self.messages + 1.0, transit, max(self.last, time)

    def compared(self, seen: int, confirmed: int, due: int, missed: int) -> None:
        """Count the targets of a scan."""
        kept = min(1.0, REMEMBERED / (self.seen + seen)) if seen else 1.0
        self.seen, self.confirmed = kept * (self.seen + seen), kept * (self.confirmed + confirmed)
        kept = min(1.0, REMEMBERED / (self.due + due)) if due else 1.0
        self.due, self.missed = kept * (self.due + due), kept * (self.missed + missed)

    def told(self, source: Source) -> dict[str, Any]:
        """What the status says."""
        if not self.messages:
            return {}
        said: dict[str, Any] = {"latency": self.latency, "jitter": self.jitter}
        if self.period:
            said["period"] = self.period
        sent = source.messages + source.gaps
        said["loss"] = source.gaps / sent if sent else 0.0
        if self.seen >= FEW:
            said["confirmed_share"] = self.confirmed / self.seen
        if self.due >= FEW:
            said["missed_share"] = self.missed / self.due
        return said


@dataclass(slots=True)
class Traffic:
    """The records of all sources, by name."""

    by_name: dict[str, Record] = field(default_factory=dict)

    def heard(self, names: tuple[str, ...], intake: Intake) -> None:
        """Learn of the messages of a step."""
        self.by_name = {name: self.by_name.get(name, Record()) for name in names}
        for name, record in self.by_name.items():
            for stamp, received in intake.sources[name].came:
                record.came(stamp, received)

    def compare(self, rows: Rows, names: tuple[str, ...], now: Picture, intake: Intake, time: int) -> None:
        """Learn of the targets of the sources that have something new, at `time`, ns, links decided. now: the picture
        predicted to it."""
        if intake.frame is None or not len(now.id):
            return
        covered, knows = self._covered(names, now, intake, time)
        if not knows.any():
            return
        linked = rows.tracks.link != NO_TRACK
        at = now.find(rows.tracks.link[linked])
        has = np.zeros((len(names), len(now.id)), dtype=np.bool_)
        has[rows.source[linked], at] = True
        should = covered.sum(axis=0)
        count = has.sum(axis=0)
        scanned = np.bincount(rows.source[rows.fresh], minlength=len(names)) > 0
        for i, name in enumerate(names):
            if not scanned[i]:
                continue
            mine = has[i] & (should - covered[i] > 0)
            others = (count - has[i] > 0) & covered[i] if knows[i] else np.zeros(len(now.id), dtype=np.bool_)
            self.by_name[name].compared(
                int(mine.sum()), int((mine & (count > 1)).sum()), int(others.sum()), int((others & ~has[i]).sum())
            )

    @staticmethod
    def _covered(names: tuple[str, ...], now: Picture, intake: Intake, time: int) -> tuple[Bools, Bools]:
        """Which sources cover which targets, (S, G), long enough to have a track of it; and who declares (S,) it."""
        places = [intake.config.space.index(axis) for axis in ("x", "y", "z") if axis in intake.config.space]
        covered, knows = np.zeros((len(names), len(now.id)), dtype=np.bool_), np.zeros(len(names), dtype=np.bool_)
        old = np.where(now.time >= 0, time - now.born, -1)
        for i, name in enumerate(names):
            said = None if intake.sources[name].muted else intake.sensor(intake.sources[name])
            if said is None or said.coverage is None or intake.frame is None:
                continue
            knows[i] = True
            covered[i] = covers(said, now.mean[places], intake.frame) & (old >= said.initiation_delay * 1e9)
        return covered, knows

    def health(self, name: str, source: Source) -> dict[str, Any]:
        """What the status says of a source."""
        record = self.by_name.get(name)
        return {} if record is None else record.told(source)

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns."""
        for record in self.by_name.values():
            record.last = min(record.last, time)

    def packed(self) -> dict[str, list[Any]]:
        """As plain values."""
        return {name: [getattr(one, f.name) for f in fields(Record)] for name, one in sorted(self.by_name.items())}

    def restore(self, packed: Mapping[str, list[Any]]) -> None:
        """From what `packed` gave."""
        self.by_name = {str(name): Record(*values) for name, values in packed.items()}
