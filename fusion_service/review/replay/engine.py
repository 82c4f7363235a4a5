"""What makes the steps of a recorded mission again: by its step logs (`log_engine`), or by a clock (`clock_engine`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from fusion_service.centre import StepResult
from fusion_service.centre.inputs import LocalMessage
from fusion_service.recording.steps import Step
from fusion_service.review.replay.player import Player
from fusion_service.review.replay.verifying import Difference
from schemas import GlobalTracks, StepLog

__all__ = ["Engine", "OnStep"]

OnStep = Callable[[Player, StepResult, Step], None]
"""Is given every step made: by whom, what came of it, and the recorded step that it stands for."""


class Engine(Protocol):
    """Takes the messages of a recording in the order in which they came, and gives every step made to its `OnStep`.

    apart: why the step just made need not be the recorded one, empty where it must be. changed: step, time (ns) and
    difference where a log took other content than the recording holds. uncompared: steps that were apart, and why.
    buffered: messages that wait for a step.
    """

    @property
    def apart(self) -> str:
        """In words."""

    @property
    def changed(self) -> tuple[int, int, Difference] | None:
        """The first such step."""

    @property
    def uncompared(self) -> Sequence[object]:
        """Each in words, by `str`."""

    @property
    def buffered(self) -> int:
        """How many."""

    def input(self, message: LocalMessage, received: int, size: int) -> None:
        """A message of a source, `size` bytes long, received at `received` ns."""

    def output(self, message: StepLog | GlobalTracks, received: int) -> None:
        """A log or picture of the centre that is followed."""

    def advance(self, now: int) -> None:
        """Make the steps that can be made at `now`, ns of the recorder's clock."""

    def finish(self, now: int) -> None:
        """Make the steps that are left: nothing comes any more after `now`, ns."""

    def remarks(self) -> list[str]:
        """What is to be told at the end, each once."""
