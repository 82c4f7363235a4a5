"""A recorded mission fused again: by its step logs, which are obeyed, or by the clock of its messages.

`Follower` makes every step that has a log with exactly what the log names: the messages it took, sources found and
lost, orders, and starts with their checkpoint and id generation. The centre of the mission's own settings then makes
the recorded tracks again, bit for bit. A centre of other settings goes on from its own checkpoint where the recorded
one did, since the recorded one holds what was fused by another rule.

`Clocked` knows no log: it takes every message as it came, and steps by `clock.MessageClock`.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from fusion_service.centre import (
    Centre,
    Event,
    MessageClock,
    Refused,
    SourceFound,
    SourceLost,
    StepResult,
    make_centre,
    order_of,
)
from fusion_service.config import CentreConfig, config_hash
from fusion_service.recording.steps import PATIENCE, Step, Steps
from fusion_service.review.replay.bases import Base
from fusion_service.review.replay.held import Held, Input
from fusion_service.review.replay.variants import Variant
from fusion_service.review.replay.verifying import Difference
from schemas import GlobalTracks, LocalIntensity, LocalTracks, SensorInfo, StepLog, digest
from schemas.messages import TENTATIVE

__all__ = ["Clocked", "Follower", "Player"]

MOST_WAITING = 100
"""Steps that wait for the messages they took."""
MOST_REMARKS = 1000

Message = LocalTracks | LocalIntensity | SensorInfo
OnStep = Callable[["Player", StepResult, Step], None]


class Player:
    """One variant: its centre, and how far it has come. steps: made; number: of the last; tracks: ids that were ever
    confirmed; seconds: of fusion; span: times of the first and the last step, ns."""

    def __init__(self, variant: Variant) -> None:
        self.variant = variant
        self.config: CentreConfig | None = None
        self.centre: Centre | None = None
        self.steps = self.number = 0
        self.tracks: set[int] = set()
        self.seconds = 0.0
        self.span = [0, 0]

    def begin(self, config: CentreConfig, checkpoint: bytes | None, generation: int | None, epoch: int) -> str:
        """Make the centre anew; why it begins without the checkpoint, empty if it does not."""
        self.config = config
        self.centre, fault = make_centre(config, checkpoint, generation=generation, epoch=epoch)
        return fault

    def handle(self, event: Event, received: int) -> None:
        """Give the centre an event for its next step."""
        if self.centre is not None:
            begin = time.perf_counter()
            self.centre.handle(event, received)
            self.seconds += time.perf_counter() - begin

    def step(self, events: Iterable[Event], inputs: Iterable[Input], at: int) -> StepResult | str:
        """The step at `at` ns, or why there is none."""
        centre = self.centre
        if centre is None:
            return "there is no centre to make it"
        begin = time.perf_counter()
        try:
            for event in events:
                centre.handle(event, at)
            for one in inputs:
                centre.handle(one.message, max(one.received, getattr(one.message, "time", 0), one.message.epoch))
            result = centre.step(at)
        except Exception as error:  # a recording may hold anything
            return f"{type(error).__name__}: {error}"
        self.seconds += time.perf_counter() - begin
        self.steps, self.number = self.steps + 1, result.tracks.step
        self.tracks.update(result.tracks.ids[result.tracks.status != TENTATIVE].tolist())
        self.span = [min(self.span[0] or at, at), max(self.span[1], at)]
        return result


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


class Follower:
    """Follows the step logs of one centre. settings: those of a run, by its log's hash. on_step: is given every step
    made; `apart` says at that time why it need not be the recorded one, empty where it must be. left: the steps for
    which it did; changed: step, time and difference where a log took other content than the recording holds."""

    def __init__(self, players: list[Player], settings: Callable[[str], Base], on_step: OnStep) -> None:
        self._players = players
        self._settings = settings
        self._on_step = on_step
        self._held = Held()
        self._steps = Steps()
        self._queue: deque[Step] = deque()
        self._epoch = -1
        self._number = 0
        self._lateness = 0.0
        self.apart = ""
        self.left: list[Apart] = []
        self.changed: tuple[int, int, Difference] | None = None
        self.remarks: dict[str, int] = {}

    @property
    def held(self) -> int:
        """Messages held."""
        return len(self._held)

    def take(self, message: Message, received: int, size: int) -> None:
        """A message of a source, `size` bytes long."""
        self._held.add(digest(message), Input(message, received, size))

    def output(self, message: StepLog | GlobalTracks, received: int) -> None:
        """A log or picture of the centre that is followed."""
        self._steps.add(message, received)

    def advance(self, now: int | None) -> None:
        """Make the steps that can be made `now`, ns; None: all that are left."""
        self._queue.extend(self._steps.due(now))
        while self._queue:
            step = self._queue[0]
            patient = now is not None and now - step.received < PATIENCE * 1e9 and len(self._queue) < MOST_WAITING
            if patient and step.log is not None and not self._held.has_all(step.log):
                return
            self._queue.popleft()
            self._make(step)

    def remark(self, text: str) -> None:
        """Note something to tell at the end, once, with how often it was."""
        if text in self.remarks or len(self.remarks) < MOST_REMARKS:
            self.remarks[text] = self.remarks.get(text, 0) + 1

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
            inputs += self._held.unclaimed(step.received, step.time, log)
        events: list[Event] = []
        if log is not None:
            inputs += self._named(step, log)
            events = _events(log)
        if self.apart:
            self._note_apart(step.number)
        for player in self._players:
            result = player.step(events, inputs, step.time)
            if isinstance(result, str):
                self.remark(f"{player.variant.name}: step {step.number} cannot be made ({result})")
                self._set_apart("a step could not be made")
            else:
                self._on_step(player, result, step)
        if log is not None:
            self._held.settle(log, self._lateness)

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
                self.remark(f"{player.variant.name}: begins without a checkpoint at step {step.number} ({fault})")
                if same:
                    self._set_apart("the checkpoint that the run began from cannot be used")

    def _named(self, step: Step, log: StepLog) -> list[Input]:
        """The messages that `log` took."""
        inputs = []
        for entry in log.taken:
            one = self._held.get(entry.hash)
            if one is not None:
                inputs.append(one)
                continue
            others = self._held.other(entry.source, entry.epoch, entry.seq)
            what = f"message {entry.seq} of {entry.source}"
            if others and self.changed is None:
                found = ", ".join(f"{code:016x}" for code in others)
                self.changed = step.number, step.time, Difference(f"{what} (digest)", f"{entry.hash:016x}", found)
            self._set_apart(f"{what} has changed since" if others else f"{what} is not in the recording")
        return inputs

    def _set_apart(self, why: str) -> None:
        self.apart = self.apart or why

    def _note_apart(self, number: int) -> None:
        if self.left and self.left[-1].why == self.apart and self.left[-1].last < number:
            self.left[-1].last = number
        elif len(self.left) < MOST_REMARKS:
            self.left.append(Apart(number, number, self.apart))


def _events(log: StepLog) -> list[Event]:
    """What the log says came in beside messages."""
    events: list[Event] = []
    for event in log.events:
        kind, source = event.get("kind"), event.get("source")
        if kind in ("found", "lost") and isinstance(source, str):
            events.append((SourceFound if kind == "found" else SourceLost)(source))
        elif (order := order_of(event)) is not None:
            events.append(order)
    return events


class Clocked:
    """Takes every message as it came and steps by the messages' own time."""

    def __init__(self, players: list[Player], configs: list[CentreConfig], on_step: OnStep) -> None:
        self._players = players
        self._configs = configs
        self._clocks = [MessageClock(config) for config in configs]
        self._on_step = on_step
        self._names: set[str] = set()
        self.remarks: dict[str, int] = {}

    def take(self, message: Message, received: int, size: int) -> None:
        """A message of a source."""
        for player, config, clock in zip(self._players, self._configs, self._clocks, strict=True):
            if player.centre is None:
                player.begin(config, None, 1, received)
            if isinstance(message, LocalTracks | LocalIntensity) and not clock.admits(message, received):
                player.handle(Refused(message.source, "future"), received)
            else:
                player.handle(message, received)
            self._step_all(player, clock, received)
        self._names.add(message.source)

    def finish(self, now: int) -> None:
        """Make the steps that are left: nobody is waited for any more."""
        for player, clock in zip(self._players, self._clocks, strict=True):
            for name in sorted(self._names):
                clock.presence(name, False)
            self._step_all(player, clock, now)

    def _step_all(self, player: Player, clock: MessageClock, received: int) -> None:
        while (due := clock.due()) is not None:
            result = player.step((), (), due)
            if isinstance(result, str):
                remark = f"{player.variant.name}: a step cannot be made ({result})"
                self.remarks[remark] = self.remarks.get(remark, 0) + 1
            else:
                self._on_step(player, result, Step(result.tracks.epoch, result.tracks.step, received))
