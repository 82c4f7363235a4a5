"""A centre that goes on whatever happens: it is made from its checkpoint, and made again from it should a step fail.

What a step publishes waits for the disk only where a lost checkpoint would take back what was said: a track is
confirmed, merged or split, one of an intensity begins, or something other than data came in (a source, an order, an
era). Ids that end are noted in a few bytes (`State.note_ended`), since an id that has ended never returns, and so are
tracks that begin, with the local tracks that feed them (`young`), which begin them again under the same ids. Else the
checkpoint is saved after publishing, every `SAVED_EVERY` at most. So a service that is killed goes on with the ids that
it has published, from data that are a second old at most. The centre is told for how long it was not there (`Skipped`).
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre import (
    Centre,
    ClockSet,
    Event,
    Order,
    Refused,
    Skipped,
    StepResult,
    glance,
    make_centre,
    source_of,
)
from fusion_service.config import CentreConfig
from fusion_service.records import altered
from fusion_service.service.bounded import BoundedLog
from fusion_service.service.isolating import TooManyTries, culprits
from fusion_service.service.ordering import OrderDesk
from fusion_service.service.state import State, StateError
from fusion_service.service.syncing import sync_to_disk
from fusion_service.service.young import Born, born_in, noted, padded
from schemas import Message, StepLog, encode, messages

__all__ = ["SAVED_EVERY", "LastingCentre", "Made"]

NONE: NDArray[np.uint64] = np.zeros(0, dtype=np.uint64)
SAVED_EVERY = 1.0
"""Seconds between checkpoints of steps that change no id."""

MOST_SINCE = 20_000
"""Messages of one step among which one that makes it fail is looked for."""
MOST_FAULTY = 1000
"""Messages that made a step fail, which are known again when they come again."""

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
        self._changed = self._fresh = False
        self._saved_at = float("-inf")
        self._inherited = state.inherits
        self._checkpoint = self._usable(state.load())
        self._ended, self._born = [state.ended()], [state.born()]
        known = glance(self._checkpoint or b"").generation
        self._generation = state.new_generation(max(known, int(self._ended[0].max(initial=0)) >> 32))
        self._newest = self._saved = 0
        self._noted = b""
        self._since: list[tuple[Event, int]] = []
        self._faulty: dict[tuple[str, str, int, int], None] = {}
        self.centre = self._make_centre()
        desk.follow(self.centre)
        self._held = state.held
        for order in self._held.read(self.centre.orders.next):
            log.info("order %d of before is given again: %s", order.number, order.what)
            desk.promises.wait_for(order)
            self.handle(order, time.time_ns())

    def _usable(self, checkpoint: bytes | None) -> bytes | None:
        """The checkpoint, but for one that is of a time to come, by more than anything is remembered: it is set aside.
        By less it is used, and a new era begins (see `centre.era`)."""
        ahead = glance(checkpoint or b"").time / 1e9 - time.time() - self._config.remember
        if checkpoint is None or self._config.clock != "wall" or ahead <= 0:
            return checkpoint
        self._state.set_aside("ahead")
        words = "the checkpoint is %.1f h ahead of the clock, which may be wrong: it is kept as checkpoint.ahead"
        log.warning(words, (ahead + self._config.remember) / 3600)
        self._state.new_generation(glance(checkpoint).generation)
        return None

    @property
    def alarm(self) -> str:
        """Why something is not on disk that should be; empty where all is."""
        return self._state.trouble

    def _make_centre(self) -> Centre:
        epoch = max(time.time_ns(), self._state.epoch_above + 1)
        self._slept = self._checkpoint is not None
        if self._checkpoint is not None:
            ended, born = (
                np.concatenate(self._ended),
                born_in(b"".join(map(padded, self._born))),
            )
            self._checkpoint = without(self._config, self._checkpoint, ended, born)
        self._ended, self._born = [NONE], [b""]
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
        elif isinstance(event, Message):
            if (name := _name_of(event)) in self._faulty:
                event = Refused(name[0], "failed", 1)
            elif len(self._since) <= MOST_SINCE:
                self._since.append((event, received))
        self.centre.handle(event, received)

    def step(self, at: int) -> Made | None:
        """Make the step at `at`, ns, saved if it must be before it is published; None where it fails even without what
        came in for it. Call `save` when it has been."""
        unsaved = self._counts["unsaved"]
        try:
            made = self._make(at)
        except Exception:
            again = self._recover(at)
            if again is None:
                return None
            made = again
        finally:  # what waits for a later step may make that one fail
            self._since = [one for one in self._since if getattr(one[0], "time", -1) > at]
        self._desk.follow(self.centre)
        self._settle(made.result.log, self._counts["unsaved"] == unsaved)
        return made

    def _settle(self, journal: StepLog, saved: bool) -> None:
        """Let the orders of a step be answered, whose checkpoint was `saved`, once it is published."""
        orders = [event for event in journal.events if event.get("kind") == "order"]
        if not orders:
            return
        kept = saved and self._state.folder is not None
        if kept and self._state.folder is not None:
            try:
                sync_to_disk(self._state.folder / "checkpoint")
                self._held.saved(self.centre.orders.next)
            except OSError as error:
                kept = False
                self._told.error("cannot keep what was ordered: %s", error)
        self._desk.promises.settle(orders, kept)

    def _hold_orders(self) -> None:
        """Write down the orders that have waited for a step for too long, and answer what may be answered."""
        overdue = self._desk.promises.overdue()
        if overdue:
            try:
                kept = self._held.add(overdue)
            except OSError as error:
                kept = False
                self._told.error("cannot keep what was ordered: %s", error)
            self._desk.promises.hold(overdue, kept)
        self._desk.promises.release()

    @property
    def generation(self) -> int:
        """The upper half of the ids that are given now."""
        return self._generation

    def save(self, *, at_once: bool = False) -> None:
        """Save what has changed, where that is due, and orders that wait for a step."""
        self._hold_orders()
        if self._changed and (at_once or time.monotonic() - self._saved_at >= SAVED_EVERY):
            self._keep(self.centre.checkpoint())
        elif self._fresh:
            self.centre.foresee()
        self._fresh = False

    def _keep(self, checkpoint: bytes) -> None:
        self._checkpoint, self._changed, self._saved_at = checkpoint, False, time.monotonic()
        self._ended, self._born = [NONE], [b""]
        self._saved, self._noted = self._newest, b""
        try:
            self._state.save(checkpoint)
        except OSError as error:
            self._counts["unsaved"] += 1
            self._told.error("cannot save the checkpoint: %s", error)

    def _make(self, at: int) -> Made:
        """Make a step, and all that it leaves behind, or raise with nothing left behind."""
        self._tell_sleep(at)
        result = self.centre.step(at)
        checkpoint = self.centre.checkpoint() if _settles(result, self._config.kind) else None
        sent = time.time_ns()
        tracks, journal = altered(result.tracks, sent=sent), altered(result.log, sent=sent)
        payloads = {"tracks": encode(tracks, sound=True), "log": encode(journal, sound=True)}
        self._changed = self._fresh = True
        self._newest = max(self._newest, int(result.picture.ids.max(initial=0)))
        if checkpoint is not None:
            self._keep(checkpoint)
        else:
            self._note_ended(np.array([track for track, _, _ in result.tracks.ended], dtype=np.uint64))
            self._note_born(noted(result.picture, self._saved, self.centre.young))
        return Made(result, payloads)

    def _tell_sleep(self, at: int) -> None:
        """The first step after a checkpoint: those between were not made. Who takes over has heard what came
        meanwhile."""
        missed = (at - self.centre.time) // round(self._config.period * 1e9) - 1
        if self._slept and self.centre.time >= 0 and missed > 0:
            self.centre.handle(Skipped(missed, absent=not self._inherited), time.time_ns())
        self._slept = False

    def _note_born(self, note: bytes) -> None:
        """Of the tracks that are not in the checkpoint, where something is new about them."""
        if not note or note == self._noted:
            return
        self._noted = note
        self._born.append(note)
        try:
            self._state.note_born(note)
        except OSError as error:
            self._counts["unsaved"] += 1
            self._told.error("cannot note what has begun: %s", error)

    def _note_ended(self, ids: NDArray[np.uint64]) -> None:
        self._ended.append(ids)
        try:
            self._state.note_ended(ids)
        except OSError as error:
            self._counts["unsaved"] += 1
            self._told.error("cannot note what has ended, so that the checkpoint is set aside: %s", error)
            self._state.set_aside("old")

    def _recover(self, at: int) -> Made | None:
        """A step failed, by a fault of ours: make it from the last checkpoint, with what came in since the last one
        but the messages without which it does not fail; if it fails with none, begin with nothing."""
        self._counts["failed_steps"] += 1
        self._told.error("the step at %d failed", at)
        left, faulty = self._sorted_out(at)
        self._restart()
        for event, received in [(ClockSet(at), time.time_ns()), *left]:
            self.centre.handle(event, received)
        for name, count in Counter(source_of(event) for event, _ in faulty).items():
            self.centre.handle(Refused(name, "failed", count), time.time_ns())
        try:
            return self._make(at)
        except Exception:
            self._told.error("the step at %d fails without input too: starting without the checkpoint", at)
            self._checkpoint, self._born = None, [b""]
            self._restart()
            return None

    def _sorted_out(self, at: int) -> tuple[list[tuple[Event, int]], list[tuple[Message, int]]]:
        """What came in for the step at `at`, without the messages that make it fail, and these; all are dropped where
        they are not found."""
        since = [(event, received) for event, received in self._since if isinstance(event, Message)]
        if len(since) > MOST_SINCE:
            self._told.error("the step at %d had too many messages to try: all that came in for it is dropped", at)
            return [], []
        try:
            places = set(culprits([(source_of(one[0]), one) for one in since], lambda some: self._fails(at, some)))
        except TooManyTries:
            self._told.error("what made the step at %d fail is not found: all that came in for it is dropped", at)
            return [], since
        faulty = [since[place] for place in sorted(places)]
        for event, _ in faulty:
            name = _name_of(event)
            self._told.error("it failed for the message %d of %s (%s), which is refused", event.seq, *name[:2])
            self._faulty[name] = None
            if len(self._faulty) > MOST_FAULTY:
                del self._faulty[next(iter(self._faulty))]
        return [one for place, one in enumerate(since) if place not in places], faulty

    def _fails(self, at: int, some: list[tuple[Message, int]]) -> bool:
        """Whether the step at `at` fails with these messages, tried by a centre of the last checkpoint."""
        try:
            centre, _ = make_centre(self._config, self._checkpoint, generation=self._generation)
            for event, received in [(ClockSet(at), time.time_ns()), *some]:
                centre.handle(event, received)
            result = centre.step(at)
            encode(result.tracks)
            encode(result.log)
            result.settle()
            centre.checkpoint()
        except Exception:
            return True
        return False

    def _restart(self) -> None:
        try:
            self._generation = self._state.new_generation()
        except (OSError, StateError) as error:
            self._generation += 1
            self._told.error("cannot write an id generation: %s", error)
        self._inherited = False
        self.centre = self._make_centre()
        self._restarted()
        for order in self._desk.again(self._checkpoint is None):
            self.centre.handle(order, time.time_ns())


def _settles(result: StepResult, kind: str) -> bool:
    """Whether a step says something, or obeys something, that a centre made anew must know. Tracks of an intensity have
    no local tracks by which a note could tell them."""
    picture, log = result.tracks, result.log
    merged = any(heir is not None for _, _, heir in picture.ended)
    known = messages.BORN if kind == "intensity" else messages.CONFIRMED_NOW
    began = np.isin(log.decisions.kind, (known, messages.CONFIRMED_NOW)).any()
    return bool(merged or picture.split_from or any(map(_lasts, log.events)) or began)


def _lasts(event: Mapping[str, Any]) -> bool:
    """Whether a lost checkpoint would take back what an event tells. Not that steps were skipped, which costs most when
    it is saved each time, and is told anew by a service that begins anew; nor that some were made again for late data,
    where no track came back by that: what began or ended is noted."""
    kind = event.get("kind")
    return kind != "skipped" and (kind != "revised" or "back" in event)


def _name_of(message: Message) -> tuple[str, str, int, int]:
    """What tells a message apart: source, kind, run and number."""
    return source_of(message), message.type, message.epoch, message.seq


def without(config: CentreConfig, checkpoint: bytes, ended: NDArray[np.uint64], born: Born | None = None) -> bytes:
    """A checkpoint without the global tracks `ended`, and with the ids of those that were `born` after it; as it is
    where there are none, or it cannot be read."""
    over = set(ended.tolist())
    tracks = [one for one in born.tracks if one[1] not in over] if born is not None else []
    if not len(ended) and not tracks:
        return checkpoint
    centre, fault = make_centre(config, checkpoint)
    if fault:
        return checkpoint
    gone = centre.let_go(ended)
    centre.promise(tracks, born.where if born is not None else ())
    return centre.checkpoint() if gone or tracks else checkpoint
