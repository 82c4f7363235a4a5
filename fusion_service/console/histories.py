"""What was decided of every track since the console listens, in words, and the log of a centre's steps.

Links that are kept are not told, and a gate that fails again and again is one line with a number. Bounded: lines of a
track and of the log, tracks that are remembered, lines that one step adds to the log.
"""

from __future__ import annotations

import math
from collections import Counter, OrderedDict, deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from fusion_service.console.events import event_words, local_words, short
from fusion_service.decision_words import MINE, SAID, THEIRS
from fusion_service.labels import Labels
from fusion_service.order import giver_of
from fusion_service.source_words import source_event
from schemas import GlobalTracks, StepLog
from schemas.messages import BROKEN, CONFIRMED_NOW, DELETED, EXCHANGED, GATE_FAILED, KEPT, LINKED, MERGED, SPLIT

__all__ = ["Histories"]

LINES = 40
"""Of a track."""
TRACKS = 25_000
LOGGED = 400
A_STEP = 25
"""Lines of the log that one step adds of its decisions."""
ROWS = 20_000
"""Decisions of a step that are read."""
LONGEST = 240
IN_THE_LOG = (CONFIRMED_NOW, BROKEN, MERGED, SPLIT, DELETED, EXCHANGED)
BESIDE = ("found", "lost", "restarted")


class Histories:
    """Of one centre. number: of the newest line of the log."""

    def __init__(self, label: Labels) -> None:
        self.number = 0
        self._label = label
        self._of: OrderedDict[int, deque[list[Any]]] = OrderedDict()
        self._log: deque[dict[str, Any]] = deque(maxlen=LOGGED)
        self._newest: StepLog | None = None
        self._ended: OrderedDict[int, tuple[str, int | None]] = OrderedDict()

    def of(self, track: int) -> list[list[Any]]:
        """[time in ms, words, how often] of a track, the oldest first."""
        return [list(one) for one in self._of.get(track, ())]

    def end_of(self, track: int) -> str:
        """How a track ended, in words; "" where that was not heard."""
        if track not in self._ended:
            return ""
        reason, heir = self._ended[track]
        return reason if heir is None else f"{reason}, goes on as {self._label(heir)}"

    def since(self, number: int) -> list[dict[str, Any]]:
        """The lines of the log after this number."""
        return [line for line in self._log if line["n"] > number]

    def distances(self, track: int) -> dict[tuple[str, int, int], float]:
        """d2 of the members of a track in the newest step."""
        log = self._newest
        if log is None:
            return {}
        one, found = log.decisions, {}
        wanted = (one.track == np.uint64(track)) & np.isin(one.kind, (LINKED, KEPT, GATE_FAILED))
        for row in np.flatnonzero(wanted).tolist():
            if (member := _member(log, row)) is not None and math.isfinite(value := float(one.value[row])):
                found[member] = value
        return found

    def say(self, time: int, kind: str, words: str, bad: bool = False, track: int | None = None) -> None:
        """A line of the log; time: ms; kind: decision, event, order, refusal or console."""
        self.number += 1
        line = {"n": self.number, "time": time, "kind": kind, "bad": bad, "text": words[:LONGEST]}
        self._log.append(line if track is None else {**line, "track": str(track)})

    def picture(self, message: GlobalTracks) -> None:
        """Note which tracks end, and how."""
        for track, reason, heir in message.ended[:ROWS]:
            self._ended[track] = reason[:LONGEST], heir
            words = f"ended: {self.end_of(track)}"
            self._note(track, message.time // 10**6, words)
            if len(self._ended) > TRACKS:
                self._ended.popitem(last=False)

    def step(self, log: StepLog) -> None:
        """Take the log of a step."""
        self._newest, at = log, log.time // 10**6
        for verb, entries in (("refused", log.refused), ("dropped", log.dropped)):
            counts = Counter[tuple[str, str, str]]()
            for entry in entries[:ROWS]:
                counts[entry.source, entry.reason, "tracks" if entry.count else "messages"] += entry.count or 1
            for (source, reason, what), count in sorted(counts.items())[:A_STEP]:
                self.say(
                    at, "refusal", f"{source}: {count} {what if count != 1 else what[:-1]} {verb} ({reason})", True
                )
        for event in log.events[:A_STEP]:
            self._event(event, at)
        self._decisions(log, at)

    def _event(self, event: Mapping[str, Any], at: int) -> None:
        kind, source = str(event.get("kind", "event"))[:40], str(event.get("source") or "")[:80]
        if kind == "order":
            self._order(event, at)
        elif kind in BESIDE and source:
            words = {"found": "is on the bus", "lost": "has left the bus", "restarted": "was started again"}[kind]
            self.say(at, "event", f"{source} {words}", kind == "lost")
        elif (said := source_event(event)) is not None:
            self.say(at, "event", f"{source}: {said[1]}", said[0])
        else:
            self.say(at, "event", event_words(kind, event, at))

    def _order(self, event: Mapping[str, Any], at: int) -> None:
        """An order that a step obeyed, or refused, with who gave it."""
        about = [event.get(name) for name in ("track", "other")]
        tracks = [one for one in about if type(one) is int]
        whom = [f"track {self._label(one)}" for one in tracks]
        whom += [local_words(event[name]) for name in ("local", "against") if event.get(name)]
        whom += [short(event[name]) for name in ("source", "name", "shown", "identity", "state") if event.get(name)]
        who = giver_of(short(event.get("who") or ""), event.get("proven") is True)
        why = f" ({short(event['why'])})" if event.get("why") else ""
        done = event.get("done") is not False
        outcome = f": {short(event['outcome'])}" if event.get("outcome") else ""
        words = (
            f"order {short(event.get('what'))} {', '.join(whom)} by {who}{why}{'' if done else ', refused'}{outcome}"
        )
        self.say(at, "order", words, not done, tracks[0] if tracks else None)
        for track in tracks:
            self._note(track, at, words)

    def _decisions(self, log: StepLog, at: int) -> None:
        one, added, more = log.decisions, 0, 0
        for row in np.flatnonzero(one.kind != KEPT)[:ROWS].tolist():
            kind, track, other = int(one.kind[row]), int(one.track[row]), int(one.other[row])
            words, back = self._words(log, row, kind, other)
            self._note(track, at, words, kind == GATE_FAILED)
            if back:
                self._note(other, at, back.format(self._label(track)))
            if kind in IN_THE_LOG:
                if added < A_STEP:
                    self.say(at, "decision", f"track {self._label(track)} {words}", False, track)
                    added += 1
                else:
                    more += 1
        if more:
            self.say(at, "decision", f"{more} decisions more in this step")

    def _words(self, log: StepLog, row: int, kind: int, other: int) -> tuple[str, str]:
        """What a decision says of its track, and of the other one, with {} for the first."""
        member, value = _member(log, row), float(log.decisions.value[row])
        d2 = f", d2 {value:.1f}" if math.isfinite(value) else ""
        whom = f"{member[0]} {member[2]} " if member is not None else ""
        if kind in MINE:
            back = f"{_plain(whom)}{THEIRS[kind]} {{}}{d2}" if other else ""
            return f"{whom}{MINE[kind]} {self._label(other)}{d2}", back
        said = f"ended: {SAID[kind]}" if kind == DELETED else SAID.get(kind, f"decision {kind}")
        return f"{whom}{said}{d2 if member is not None else ''}", ""

    def _note(self, track: int, at: int, words: str, again: bool = False) -> None:
        """A line of a track; again: it may go on from step to step; the numbers are those of the last."""
        lines = self._of.get(track)
        if lines is None:
            lines = self._of[track] = deque(maxlen=LINES)
            if len(self._of) > TRACKS:
                self._of.popitem(last=False)
        if again and lines and lines[-1][1].partition(", d2")[0] == words.partition(", d2")[0]:
            lines[-1] = [at, words, lines[-1][2] + 1]
        else:
            lines.append([at, words, 1])


def _member(log: StepLog, row: int) -> tuple[str, int, int] | None:
    """The local track that a decision is about: source, epoch, id."""
    one = log.decisions
    source = int(one.source[row])
    return (log.sources[source], int(one.epoch[row]), int(one.id[row])) if source < len(log.sources) else None


def _plain(text: str) -> str:
    """A text in which no brace means anything."""
    return text.replace("{", "{{").replace("}", "}}")
