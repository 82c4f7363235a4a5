"""What one step took, refused and decided, gathered while it is made, and the counts since the start."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import filled
from fusion_service.compiled import PLAIN, road
from fusion_service.config.settings import recordable
from schemas import Decisions, Entry, StepLog, messages

if TYPE_CHECKING:
    from fusion_service.centre.rows import Rows
    from fusion_service.config import CentreConfig

__all__ = ["Journal", "start_event"]

MOST_ENTRIES = 1000
"""Refusals and drops named one by one in a log; what is beyond is one entry with their number ("more")."""
NO_SOURCE = 65535
MOST_LOGGED = 8 * 2**20
"""A checkpoint above this size is not part of the log of the first step."""
_DTYPES = (np.uint8, np.uint64, np.uint16, np.uint64, np.uint64, np.uint64, np.float64)


def start_event(config: CentreConfig, epoch: int, generation: int | None, checkpoint: bytes | None) -> dict[str, Any]:
    """What a run begins with, all of it: enough for another centre to begin as this one."""
    start: dict[str, Any] = {"kind": "start", "epoch": epoch}
    if (settings := recordable(config)) is not None:
        start["config"] = settings
    if checkpoint is not None:
        start |= {"checkpoint": checkpoint} if len(checkpoint) <= MOST_LOGGED else {"left_out": len(checkpoint)}
    if generation is not None:
        start["generation"] = generation
    if road() != PLAIN:
        start["road"] = road()
    return start


class Journal:
    """Gathers one step log after the other."""

    def __init__(self, name: str, config_hash: str, version: str) -> None:
        self._name, self._config_hash, self._version = name, config_hash, version
        self.refused: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.refused_of: dict[str, Counter[str]] = {}
        self.broken: dict[int, int] = {}
        self._events: list[dict[str, Any]] = []
        self._begin()

    def _begin(self) -> None:
        self._sources: tuple[str, ...] = ()
        self._taken: list[Entry] = []
        self._refused: list[Entry] = []
        self._dropped: list[Entry] = []
        self._events = []
        self._columns: list[tuple[Any, ...]] = []
        self._ended: list[tuple[int, str, int | None]] = []
        self._splits: list[tuple[int, int]] = []
        self.broken = {}

    def name_sources(self, names: tuple[str, ...]) -> None:
        """The names that decisions index."""
        self._sources = names

    @property
    def sources(self) -> tuple[str, ...]:
        """The names that decisions index."""
        return self._sources

    def event(self, event: dict[str, Any]) -> None:
        """Something other than a message that changes results or explains them."""
        if len(self._events) < MOST_ENTRIES:
            self._events.append(event)

    def accept(self, entry: Entry) -> None:
        """A message used in this step."""
        self._taken.append(entry)

    def refuse(self, entry: Entry) -> None:
        """A message, or `count` of its tracks, not used."""
        self.refused[entry.reason] += max(entry.count, 1)
        if entry.source in self.refused_of or len(self.refused_of) < MOST_ENTRIES:
            self.refused_of.setdefault(entry.source, Counter())[entry.reason] += max(entry.count, 1)
        self._refused.append(entry)

    def drop(self, entry: Entry) -> None:
        """`count` messages of a source lost to a full queue."""
        known = entry.source in self.dropped or len(self.dropped) < MOST_ENTRIES
        self.dropped[entry.source if known else "*"] += max(entry.count, 1)
        self._dropped.append(entry)

    def decide(
        self,
        kind: int,
        rows: Rows,
        at: NDArray[np.intp],
        tracks: NDArray[np.uint64],
        value: NDArray[np.float64],
        other: NDArray[np.uint64] | None = None,
    ) -> None:
        """One decision for each of the local tracks `at`, about the global ids `tracks` (and `other`)."""
        if len(at):
            ids = rows.tracks.id[at]
            others = np.zeros_like(ids) if other is None else other
            self._column(kind, tracks, rows.source[at], rows.epoch[at], ids, others, value)

    def broke(self, rows: Rows, at: NDArray[np.intp], tracks: NDArray[np.uint64], value: NDArray[np.float64]) -> None:
        """The links of the local tracks `at` to the global ids `tracks` are broken."""
        self.decide(messages.BROKEN, rows, at, tracks, value)
        self.broken |= dict(zip(at.tolist(), tracks.tolist(), strict=True))

    def tracks(self, kind: int, tracks: NDArray[np.uint64], other: NDArray[np.uint64] | None = None) -> None:
        """One decision for each of the global ids `tracks`."""
        if len(tracks):
            none = np.zeros(len(tracks), dtype=np.uint64)
            value = np.full(len(tracks), np.nan)
            self._column(kind, tracks, none + NO_SOURCE, none, none, none if other is None else other, value)

    def _column(self, kind: int, *columns: NDArray[Any]) -> None:
        # each in its own type from the start: u64 and i64 together would become floats, and ids lose their last bits
        whole = filled(len(columns[0]), kind, np.uint8), *columns
        self._columns.append(tuple(column.astype(dtype) for column, dtype in zip(whole, _DTYPES, strict=True)))

    def birth(self, ids: NDArray[np.uint64]) -> None:
        """New global tracks."""
        self.tracks(messages.BORN, ids)

    def merge(self, old: int, new: int, distance: float) -> None:
        """`new` goes on as `old`."""
        self._column(
            messages.MERGED,
            *(np.array([value]) for value in (np.uint64(new), NO_SOURCE, 0, 0, np.uint64(old), distance)),
        )
        self._ended.append((new, "merged", old))

    def split(self, new: int, old: int) -> None:
        """`new` was part of `old`."""
        self.tracks(messages.SPLIT, np.array([new], dtype=np.uint64), np.array([old], dtype=np.uint64))
        self._splits.append((new, old))

    def end(self, track: int, reason: str, replaced_by: int | None) -> None:
        """A global track is no more."""
        self.tracks(messages.DELETED, np.array([track], dtype=np.uint64))
        self._ended.append((track, reason, replaced_by))

    def taken(self) -> tuple[Entry, ...]:
        """The messages used in this step so far."""
        return tuple(self._taken)

    def not_taken(self) -> tuple[Entry, ...]:
        """What was refused in it."""
        return tuple(self._refused)

    def ended(self) -> tuple[tuple[int, str, int | None], ...]:
        return tuple(self._ended)

    def splits(self) -> tuple[tuple[int, int], ...]:
        return tuple(self._splits)

    def write(self, epoch: int, seq: int, step: int, time: int) -> StepLog:
        """The log of this step; the next one begins empty."""
        parts: list[Any] = list(zip(*self._columns, strict=True)) or [[np.zeros(0)]] * len(_DTYPES)
        columns = [
            part[0].astype(dtype, copy=False) if len(part) == 1 else np.concatenate(part).astype(dtype)
            for part, dtype in zip(parts, _DTYPES, strict=True)
        ]
        log = StepLog(
            source=self._name,
            epoch=epoch,
            seq=seq,
            sent=time,
            step=step,
            time=time,
            taken=tuple(self._taken),
            refused=_bounded(self._refused),
            dropped=_bounded(self._dropped),
            events=tuple(self._events),
            sources=self._sources,
            decisions=Decisions(*columns),
            config_hash=self._config_hash,
            version=self._version,
        )
        self._begin()
        return log


def _bounded(entries: list[Entry]) -> tuple[Entry, ...]:
    if len(entries) <= MOST_ENTRIES:
        return tuple(entries)
    return (*entries[:MOST_ENTRIES], Entry("", 0, 0, 0, "more", len(entries) - MOST_ENTRIES))
