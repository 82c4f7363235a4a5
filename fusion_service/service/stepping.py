"""A centre that goes on whatever happens: it is made from its checkpoint, and made again from it should a step fail."""

from __future__ import annotations

import dataclasses
import logging
import time
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from fusion_service.centre import Centre, ClockSet, Event, Order, StepResult, make_centre
from fusion_service.config import CentreConfig
from fusion_service.service.bounded import BoundedLog
from fusion_service.service.ordering import OrderDesk
from fusion_service.service.state import State, StateError
from schemas import encode

__all__ = ["LastingCentre", "Made"]

log = logging.getLogger(__name__)


class Made(NamedTuple):
    """A step's result, and its messages as they are published: tracks, log."""

    result: StepResult
    messages: dict[str, bytes]


class LastingCentre:
    """The centre of `config`, its ids and its checkpoint in `state`.

    desk: is told what the centre knows of orders, and tells a centre made anew those it has not obeyed. counts: where
    failed_steps and unsaved are counted. restarted: called when the centre begins anew within this
    process, and so knows nothing of what came since its checkpoint. Raises `StateError` where no generation of ids
    can be taken at the start.
    """

    def __init__(
        self,
        config: CentreConfig,
        state: State,
        desk: OrderDesk,
        told: BoundedLog,
        counts: Counter[str],
        restarted: Callable[[], None],
    ) -> None:
        self._config = config
        self._state = state
        self._told = told
        self._counts = counts
        self._restarted = restarted
        self._desk = desk
        self._checkpoint = state.load()
        self._generation = state.new_generation()
        self.centre = self._make_centre()
        desk.follow(self.centre)

    def _make_centre(self) -> Centre:
        epoch = time.time_ns()
        centre, fault = make_centre(self._config, self._checkpoint, generation=self._generation, epoch=epoch)
        if fault:
            log.warning("starting without the checkpoint: %s", fault)
            self._state.set_aside()
            self._checkpoint = None
        return centre

    def handle(self, event: Event, received: int) -> None:
        """Queue it for the next step. An order is given again should the centre begin anew before that."""
        if isinstance(event, Order):
            self._desk.given(event)
        self.centre.handle(event, received)

    def step(self, at: int) -> Made | None:
        """Make the step at `at`, ns, and save it; None where it fails even without what came in for it."""
        try:
            made = self._make(at)
        except Exception:
            again = self._recover(at)
            if again is None:
                return None
            made = again
        self._desk.follow(self.centre)
        try:
            self._state.save(self._checkpoint or b"")
        except OSError as error:
            self._counts["unsaved"] += 1
            self._told.error("cannot save the checkpoint: %s", error)
        return made

    def _make(self, at: int) -> Made:
        """Make a step, and all that it leaves behind, or raise with nothing left behind."""
        result = self.centre.step(at)
        checkpoint = self.centre.checkpoint()
        sent = time.time_ns()
        tracks, journal = (dataclasses.replace(part, sent=sent) for part in (result.tracks, result.log))
        messages = {"tracks": encode(tracks), "log": encode(journal)}
        self._checkpoint = checkpoint
        return Made(result, messages)

    def _recover(self, at: int) -> Made | None:
        """A step failed, by a fault of ours: drop what came in since the last one, and make it from the last
        checkpoint; if that fails too, begin with nothing."""
        self._counts["failed_steps"] += 1
        self._told.error("the step at %d failed: what came in for it is dropped", at)
        self._restart()
        self.centre.handle(ClockSet(at), time.time_ns())
        try:
            return self._make(at)
        except Exception:
            self._told.error("the step at %d fails without input too: starting without the checkpoint", at)
            self._checkpoint = None
            self._restart()
            return None

    def _restart(self) -> None:
        try:
            self._generation = self._state.new_generation()
        except (OSError, StateError) as error:
            self._generation += 1
            self._told.error("cannot write an id generation: %s", error)
        self.centre = self._make_centre()
        self._restarted()
        for order in self._desk.again(self._checkpoint is None):
            self.centre.handle(order, time.time_ns())
