"""A recorded mission fused again by its step logs, which are obeyed.

`LogEngine` makes every step that has a log with exactly what the log names: the messages it took, sources found and
lost, orders, and starts with their checkpoint and id generation. The centre of the mission's own settings then makes
the recorded tracks again, bit for bit. A centre of other settings goes on from its own checkpoint where the recorded
one did, since the recorded one holds what was fused by another rule.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fusion_service.centre import Event
from fusion_service.centre.inputs import Input, InputBuffer, LocalMessage
from fusion_service.centre.retracing import events_of
from fusion_service.config import config_hash
from fusion_service.recording.steps import PATIENCE, Step, Steps
from fusion_service.review.replay.engine import OnStep
from fusion_service.review.replay.mission_settings import RunSettings
from fusion_service.review.replay.player import Player
from fusion_service.review.replay.verifying import Difference
from schemas import GlobalTracks, StepLog, digest

__all__ = ["LogEngine"]

MOST_WAITING = 100
"""Steps that wait for the messages they took."""
MOST_REMARKS = 1000


@dataclass
class Apart:
    """Steps (first to last) that cannot be compared with the recorded ones, and why."""

    first: int
    last: int
    why: str

    def __str__(self) -> str:
        return f"step{'s' * (self.last > self.first)} {self.first}{self._to}: {self.why}"

    @property
    def _to(self) -> str:
        return f" to {self.last}" if self.last > self.first else ""


class LogEngine:
    """The `Engine` that follows the step logs of one centre. settings: those of a run, by its log's hash."""

    def __init__(self, players: list[Player], settings: Callable[[str], RunSettings], on_step: OnStep) -> None:
        self._players = players
        self._settings = settings
        self._on_step = on_step
        self._buffer = InputBuffer()
        self._steps = Steps()
        self._queue: deque[Step] = deque()
        self._epoch = -1
        self._number = 0
        self._lateness = 0.0
        self._remarks: Counter[str] = Counter()
        self.apart = ""
        self.uncompared: list[Apart] = []
        self.changed: tuple[int, int, Difference] | None = None

    @property
    def buffered(self) -> int:
        """Messages that wait for a step."""
        return len(self._buffer)

    def input(self, message: LocalMessage, received: int, size: int) -> None:
        """A message of a source, `size` bytes long, received at `received` ns."""
        self._buffer.add(digest(message), Input(message, received, size))

    def output(self, message: StepLog | GlobalTracks, received: int) -> None:
        """A log or picture of the centre that is followed."""
        self._steps.add(message, received)

    def advance(self, now: int) -> None:
        """Make the steps that can be made at `now`, ns of the recorder's clock."""
        self._advance(now)

    def finish(self, now: int) -> None:
        """Make the steps that are left, with what there is of them."""
        self._advance(None)

    def remarks(self) -> list[str]:
        """What is to be told at the end, each once, with how often it was."""
        return [text if count == 1 else f"{text} ({count} times)" for text, count in self._remarks.items()]

    def _advance(self, now: int | None) -> None:
        self._queue.extend(self._steps.due(now))
        while self._queue:
            step = self._queue[0]
            patient = now is not None and now - step.received < PATIENCE * 1e9 and len(self._queue) < MOST_WAITING
            if patient and step.log is not None and not self._buffer.has_all(step.log):
                return
            self._queue.popleft()
            self._make(step)

    def _remark(self, text: str) -> None:
        if text in self._remarks or len(self._remarks) < MOST_REMARKS:
            self._remarks[text] += 1

    def _make(self, step: Step) -> None:
        log = step.log
        start = None
        if log is not None:
            start = next((event for event in log.events if event.get("kind") == "start"), None)
        if start is not None or step.epoch != self._epoch:
            self._begin(step, start)
        elif step.number > self._number + 1:
            self._set_apart("steps before it are not in the recording")
        whole = start is not None or (step.epoch == self._epoch and step.number == self._number + 1)
        self._epoch, self._number = step.epoch, step.number
        inputs: list[Input] = []
        if log is None:
            self._set_apart("a step has no log")
        if log is None or not whole:
            inputs += self._buffer.unclaimed(step.received, step.time, log)
        events: list[Event] = []
        if log is not None:
            inputs += self._named(step, log)
            events = events_of(log)
        if self.apart:
            self._note_apart(step.number)
        for player in self._players:
            result = player.step(events, inputs, step.time)
            if isinstance(result, str):
                self._remark(f"{player.variant.name}: step {step.number} cannot be made ({result})")
                self._set_apart("a step could not be made")
            else:
                self._on_step(player, result, step)
        if log is not None:
            self._buffer.settle(log, self._lateness)

    def _begin(self, step: Step, start: dict[str, Any] | None) -> None:
        """A run of the recorded centre begins, or is met under way."""
        log, self.apart = step.log, ""
        base = self._settings(log.config_hash if log is not None else "")
        if start is None:
            self._set_apart("the start of the run is not in the recording")
        elif base.doubt:
            self._set_apart(base.doubt)
        checkpoint = start.get("checkpoint") if start is not None else None
        checkpoint = checkpoint if isinstance(checkpoint, bytes) else None
        generation = start.get("generation") if start is not None else None
        generation = generation if isinstance(generation, int) and 0 <= generation < 2**32 else None
        for player in self._players:
            config = player.variant.config(base.tables)
            self._lateness = max(self._lateness, config.lateness)
            same = (player.variant.unchanged and base.own) or (
                log is not None and config_hash(config) == log.config_hash
            )
            own = player.centre.checkpoint() if player.centre is not None else None
            if start is None:
                blob = own
            elif checkpoint is not None:
                blob = checkpoint if same or own is None else own
            elif "left_out" in start:
                blob = own
                if same and player.number + 1 != step.number:
                    self._set_apart("the checkpoint that the run began from was too large for its log")
            else:
                blob = None
            fault = player.begin(config, blob, generation, step.epoch)
            if fault:
                self._remark(f"{player.variant.name}: begins without a checkpoint at step {step.number} ({fault})")
                if same:
                    self._set_apart("the checkpoint that the run began from cannot be used")

    def _named(self, step: Step, log: StepLog) -> list[Input]:
        """The messages that `log` took."""
        inputs = []
        for entry in log.taken:
            one = self._buffer.get(entry.hash)
            if one is not None:
                inputs.append(one)
                continue
            others = self._buffer.other(entry.source, entry.epoch, entry.seq)
            what = f"message {entry.seq} of {entry.source}"
            if others and self.changed is None:
                found = ", ".join(f"{code:016x}" for code in others)
                self.changed = step.number, step.time, Difference(f"{what} (digest)", f"{entry.hash:016x}", found)
            self._set_apart(f"{what} has changed since" if others else f"{what} is not in the recording")
        return inputs

    def _set_apart(self, why: str) -> None:
        self.apart = self.apart or why

    def _note_apart(self, number: int) -> None:
        if self.uncompared and self.uncompared[-1].why == self.apart and self.uncompared[-1].last < number:
            self.uncompared[-1].last = number
        elif len(self.uncompared) < MOST_REMARKS:
            self.uncompared.append(Apart(number, number, self.apart))
