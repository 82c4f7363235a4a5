"""A recorded mission fused again by the clock of its messages: each as it came, stepped by `MessageClock`, or on
arrival by `ArrivalClock`."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from fusion_service.centre import ArrivalClock, MessageClock, Refused, source_of
from fusion_service.centre.inputs import LocalMessage
from fusion_service.config import CentreConfig
from fusion_service.recording.steps import Step
from fusion_service.review.replay.engine import OnStep
from fusion_service.review.replay.player import Player
from schemas import GlobalTracks, SensorInfo, StepLog

__all__ = ["ClockEngine"]


class ClockEngine:
    """The `Engine` that knows no log: it steps by the messages' own time."""

    apart = "no log is followed"
    changed = None
    uncompared: tuple[str, ...] = ()
    buffered = 0

    def __init__(self, players: list[Player], configs: list[CentreConfig], on_step: OnStep) -> None:
        self._players = players
        self._configs = configs
        self._clocks = [_clock(config) for config in configs]
        self._on_step = on_step
        self._names: set[str] = set()
        self._remarks: Counter[str] = Counter()

    def input(self, message: LocalMessage, received: int, size: int) -> None:
        """A message of a source, received at `received` ns: every step that it makes due is made."""
        for player, config, clock in zip(self._players, self._configs, self._clocks, strict=True):
            if player.centre is None:
                player.begin(config, None, 1, received)
            fault = "" if isinstance(message, SensorInfo) else clock.fault(message, received)
            if fault:
                player.handle(Refused(source_of(message), fault), received)
            else:
                player.handle(message, received)
            self._step_all(player, clock, received)
        self._names.add(source_of(message))

    def output(self, message: StepLog | GlobalTracks, received: int) -> None:
        """What a recorded centre made is not looked at."""

    def advance(self, now: int) -> None:
        """Nothing: it is messages that make a step due."""

    def finish(self, now: int) -> None:
        """Make the steps that are left: nobody is waited for any more."""
        for player, clock in zip(self._players, self._clocks, strict=True):
            for name in sorted(self._names):
                clock.presence(name, False)
            self._step_all(player, clock, now)

    def remarks(self) -> list[str]:
        """What is to be told at the end: steps that could not be made, and what each centre refused."""
        told = [f"{text} ({count} times)" for text, count in self._remarks.items()]
        return [*told, *filter(None, map(_refusals, self._players))]

    def _step_all(self, player: Player, clock: MessageClock | ArrivalClock, received: int) -> None:
        while player.centre is not None and (due := _due(clock, received, player.centre.time)) is not None:
            result = player.step((), (), due)
            if isinstance(result, str):
                self._remarks[f"{player.variant.name}: a step cannot be made ({result})"] += 1
            else:
                self._on_step(player, result, Step(result.tracks.epoch, result.tracks.step, received))


def _clock(config: CentreConfig) -> MessageClock | ArrivalClock:
    """No wall clock goes on here: what arrives is stepped by its own time."""
    if config.trigger == "arrival":
        return ArrivalClock(replace(config, clock="message"))
    return MessageClock(config)


def _due(clock: MessageClock | ArrivalClock, now: int, last: int) -> int | None:
    due = clock.due() if isinstance(clock, MessageClock) else clock.due(now, last)
    return None if due is not None and due <= last and isinstance(clock, ArrivalClock) else due


def _refusals(player: Player) -> str:
    refused = player.centre.refusals() if player.centre is not None else {}
    told = ", ".join(f"{reason} {count}" for reason, count in refused.items())
    return f"{player.variant.name}: refused {told}" if told else ""
