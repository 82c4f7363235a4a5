"""`Centre`: what every kind of centre shares: events in, the frame of a step, what it publishes, its checkpoint.

A kind says how the usable local tracks become the picture of a step (`_advance`); everything before and after is here.
Everything that changes a result enters by `handle`; `step(time)` takes what is queued with a time up to then and
returns the global tracks, a log that is enough to make the step again, and status. Within a step inputs are sorted by
(source, epoch, seq) before anything is computed, so the order of arrival does not matter, and no operation's bits
depend on the size of its batch: the same events give the same bytes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service import __version__
from fusion_service.centre.align import usable_rows
from fusion_service.centre.checkpoint import CheckpointError, pack_state, unpack_state
from fusion_service.centre.deltas import Deltas
from fusion_service.centre.era import GLOBAL_TIMES, ClockSet, EraWatch, NewEra, rebased
from fusion_service.centre.events import Event, Refused, Skipped
from fusion_service.centre.history import History, Past
from fusion_service.centre.ids import Ids
from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal, start_event
from fusion_service.centre.judging import View
from fusion_service.centre.labels import Labels
from fusion_service.centre.lifecycle import empty_picture
from fusion_service.centre.naming import Book, LocalKey
from fusion_service.centre.obeying import heirs, obey, view_of
from fusion_service.centre.orders import Orders
from fusion_service.centre.publishing import Contributions, picture_message
from fusion_service.centre.quieting import rest
from fusion_service.centre.result import StepResult
from fusion_service.centre.revising import Revision
from fusion_service.centre.rows import Rows
from fusion_service.centre.status import step_status
from fusion_service.centre.whereabouts import Whereabouts
from fusion_service.config import CentreConfig, centre_config, config_hash
from fusion_service.order import Order
from schemas import Status, StepLog, messages

__all__ = ["Centre"]


class Centre(ABC):
    """Fuses what many sources say into one picture; no clock, no thread, no socket.

    config: a `CentreConfig`, or a dict of the same shape ({} gives the defaults; `ConfigError` says all that
    is wrong). checkpoint: what `checkpoint()` gave before; `CheckpointError` if it cannot be used. generation: the
    upper half of the ids given from now on; a new one for every start keeps ids from ever being used again (a
    checkpoint alone goes on in its own generation). epoch: start of this run, ns, for the header of what it publishes.
    """

    def __init__(
        self,
        config: CentreConfig | Mapping[str, Any],
        checkpoint: bytes | None = None,
        *,
        generation: int | None = None,
        epoch: int = 0,
    ) -> None:
        self.config = self._own_kind(centre_config(config))
        self.config_hash = config_hash(self.config)
        self.epoch = epoch
        self._intake = Intake(self.config)
        self._picture = empty_picture(len(self.config.space))
        self._labels = Labels(self._intake)
        self._ids = Ids()
        self._history = History(self.config)
        self._ids.book = Book() if self._history.on else None
        self._state: bytes | None = None
        self._other: dict[int, int] = {}
        self._step = 0
        self._published = 0
        self._time = -1
        self._journal = Journal(self.config.name, self.config_hash, __version__)
        self._era = EraWatch(self.config)
        self._deltas = Deltas(self.config)
        self._newest: StepResult | None = None
        self._begin()
        if checkpoint is not None:
            state, self._picture = unpack_state(checkpoint, self._intake, self._labels)
            self._step, self._time, self._ids.next = state["step"], state["time"], state["next_id"]
            self._era.unpack(state["era"])
            self._ids.promised.restore(state["promised"])
            try:
                if state["own"] is not None:
                    self._restore(state["own"])
            except Exception as error:
                raise CheckpointError(f"the checkpoint cannot be read: {type(error).__name__}: {error}") from None
        if generation is not None:
            self._ids.begin(generation)
        self._journal.event(start_event(self.config, epoch, generation, checkpoint))

    @property
    def time(self) -> int:
        """Time of the newest step, ns; -1 before the first. A new era may set it back (see `era`)."""
        return self._time

    def handle(self, event: Event, received: int) -> None:
        """Queue a message or another event for the next step; `received` is when it came, ns. Never raises
        for what a message contains: it is checked, and refused with a reason, in the step."""
        self._settle()
        era = self._era.judge(event, received, self._time)
        if era is not None:
            self._begin_era(era, received)
        if isinstance(event, Skipped):
            self._journal.event({"kind": "skipped", "steps": event.steps} | ({"absent": True} if event.absent else {}))
            self._history.behind()
        if not isinstance(event, (ClockSet, NewEra)):
            self._intake.put(event, received)
            self._history.note(event, received)

    def _begin_era(self, time: int, now: int) -> None:
        self._journal.event(self._era.begin(time, self._time))
        self._time = time
        self._intake.rebase(time, now)
        self._labels.rebase(time)
        self._picture = rebased(self._picture, GLOBAL_TIMES, time)
        self._rebase(time)
        self._history.clear()
        self._state = None

    def step(self, time: int) -> StepResult:
        """Make the step at `time`, ns, which must be after the last. `ValueError` if it is not."""
        if time <= self._time:
            raise ValueError(f"a step at {time} is not after the last, at {self._time}")
        self._settle()
        revised = self._revise()
        contributions = self._make(time)
        journal = self._journal
        picture = picture_message(
            self._picture,
            self._intake,
            journal,
            contributions,
            self._labels,
            epoch=self.epoch,
            seq=self._published,
            step=self._step,
            time=time,
            rule=self._rule,
            revised=revised,
        )
        tracks = self._deltas.of(picture, self._intake.sources.values())
        log = journal.write(self.epoch, self._published, self._step, time)
        self._published += 1
        self._newest = StepResult(tracks, log, lambda: self._status(log), picture)
        return self._newest

    def _status(self, log: StepLog) -> Status:
        """After the step of this log."""
        notes, journal = self._era.notes(log.time), self._journal
        status = step_status(self._intake, journal, log, self._numbers(), self.refusals(), notes, self._watched())
        return self._history.told_in(status)

    def _settle(self) -> None:
        """What is told of the last step is made now, if it is not yet."""
        newest, self._newest = self._newest, None
        if newest is not None:
            newest.settle()

    def _make(self, time: int, events: tuple[tuple[Event, int], ...] | None = None, left: int = 0) -> Contributions:
        """Make the step at `time`, ns, as far as it changes the state, and remember what went into it. events: of a
        step that is made again, with `left` more to come; None: those that were queued."""
        past = self._begin_step(time, self._history.noted() if events is None else events, left)
        journal = self._journal
        self._obey(self._intake.take_orders(), time)
        rest(self._intake, self._time, journal, self._picture.id)
        self._forget_lineages()
        told = len(journal.taken())  # of what was late
        self._intake.admit(time, self._time, journal)
        if events is None:
            past.events += tuple((Refused(name, "queue", 1, True), time) for name in sorted(self._intake.spared.newest))
        self._history.add(past, self._intake.raw, journal.taken()[told:], owes=events is None)
        self._time = time
        if self._intake.reframed:
            self._intake.reframed = False
            self._end_all(self._picture.id, "frame")
        rows = usable_rows(self._intake, time, journal)
        names = self._intake.names()
        journal.name_sources(names)
        contributions = self._advance(rows, names, time)
        gone_on = {**heirs(journal.ended()), **self._other}
        self._other = {}
        self._intake.orders.follow(gone_on)
        self._labels.follow(rows, self._picture, names, gone_on, time, journal)
        for track in self._ids.promised.settle(self._picture.id, time):
            journal.end(track, "lost", None)
        return contributions

    def _begin_step(self, time: int, events: tuple[tuple[Event, int], ...], left: int) -> Past:
        past = Past(self._step + 1, time, self._time, events, copy(self._intake.spared))
        if self._history.on:
            kept = self._kept_by_next(past.number, left)
            if kept is not None:
                past.state, past.lasting = self._state or self.checkpoint(), kept
        self._step, self._state = past.number, None
        if self._ids.book is not None:
            self._ids.book.step = past.number
            self._ids.book.forget(self._history.oldest)
        return past

    def foresee(self) -> None:
        """Make what the next step would begin with, where there is time: the state that it keeps. Nothing depends on
        whether this is called."""
        if self._history.on and self._state is None and self._kept_by_next(self._step + 1, 0) is not None:
            self.checkpoint()

    def _kept_by_next(self, number: int, left: int) -> bool | None:
        rows = len(self._picture.id) + sum(len(one.tracks.id) for one in self._intake.sources.values())
        return self._history.keeps(self._time, number, rows, left)

    def _revise(self) -> int | None:
        """Make the steps again that late data belong to. The time of the first that they change, ns; None: nothing is
        made again."""
        if self._intake.lossy:
            self._history.behind()
        late = self._history.find(self._intake, self._time) if self._history.on else []
        start = self._history.start(late) if self._history.on else None
        if start is None:
            return None
        ids = self._ids.known(self._picture.id)
        revision = Revision(self._history, start, late, self._intake, ids, self._ids.next)
        own, queue = self._journal, revision.left(self._intake.emptied())
        self._go_back(revision)
        for place, past in enumerate(revision.steps):
            self._journal = Journal(self.config.name, self.config_hash, __version__)
            for event, received in revision.events(past, self._intake, self._picture.id):
                self._intake.put(event, received)
            revision.feed(past, self._intake)
            self._make(past.time, past.events, len(revision.steps) - place - 1)
            revision.look(past, self._journal)
        self._journal = own
        revision.finish(self._intake, queue)
        if self._ids.book is not None:
            there = revision.there.union(one for one in self._picture.id.tolist() if one >= revision.following)
            self._go_on_as(self._ids.book.done(self._picture.id.tolist(), there, self._ids.fresh))
            waiting = self._ids.known(self._picture.id[:0])
            over = waiting[(waiting < revision.following) & ~np.isin(waiting, ids)]
            self._stop_waiting(over)
            self._ids.promised.drop(over.tolist())
        return revision.tell(own, self._intake, self._ids.known(self._picture.id), self._other)

    def _go_on_as(self, new: dict[int, int]) -> None:
        """Tracks that have ended, and are there after all, take other ids: {old: new}."""
        self._other = new
        if new:
            ids = np.array([new.get(one, one) for one in self._picture.id.tolist()], dtype=np.uint64)
            self._picture = replace(self._picture, id=ids).take(np.argsort(ids))
            self._renamed(new)
            self._intake.orders.follow(new)

    def _go_back(self, revision: Revision) -> None:
        """To the state before the first of the steps to be made again. Ids go on, and eras."""
        if self._ids.book is not None:
            self._ids.book.again(revision.steps[0].number - 1, revision.tables, revision.there)
        state = revision.steps[0].state
        self._intake = Intake(self.config, self._intake.ahead)
        self._intake.spared = revision.steps[0].spared.rested()
        self._labels = Labels(self._intake)
        self._begin()
        kept, self._picture = unpack_state(state or b"", self._intake, self._labels)
        self._step, self._time = kept["step"], kept["time"]
        self._ids.promised.restore(kept["promised"])
        self._restore(kept["own"])
        self._state = state

    def refusals(self) -> dict[str, int]:
        """Refusals by reason since the start, those included that no step has told yet."""
        return dict(sorted((self._journal.refused + self._intake.waiting_refusals()).items()))

    @property
    def orders(self) -> Orders:
        """The orders that stand."""
        return self._intake.orders

    def view(self) -> View:
        """What orders are judged by now, as it is: no copy that later steps leave alone."""
        return view_of(self._intake, self._picture, self._time)

    def let_go(self, tracks: NDArray[np.uint64]) -> int:
        """Forget global tracks that have ended since the checkpoint that this centre was made from; how many it had."""
        self._settle()
        gone = np.isin(self._picture.id, tracks)
        self._forget(self._picture.id[gone].tolist())
        self._ids.promised.drop(tracks.tolist())
        self._picture = self._picture.take(~gone)
        self._state = None
        return int(gone.sum()) + self._stop_waiting(tracks)

    def promise(self, born: Iterable[tuple[LocalKey, int]], where: Iterable[Whereabouts] = ()) -> None:
        """Ids that were published for these local tracks since the checkpoint that this centre was made from: tracks
        that they begin, or that begin where they were last, take them. Of ids that it has already nothing is new."""
        there = {*self._picture.id.tolist(), *self._ids.waiting.tolist()}
        self._ids.promised.add([one for one in born if one[1] not in there], where)
        self._state = None

    def young(self, above: int) -> Whereabouts:
        """Where the tracks are whose ids are above `above`."""
        return Whereabouts.of(self._picture, above, self._intake.frame)

    def checkpoint(self) -> bytes:
        """The whole state but what is queued, as versioned MessagePack: a centre made from it goes on as this one."""
        state = {
            "space": list(self.config.space),
            "step": self._step,
            "time": self._time,
            "next_id": self._ids.next,
            "era": self._era.pack(),
            "promised": self._ids.promised.packed(),
            "own": self._kept(),
        }
        self._state = pack_state(self.config_hash, state, self._intake, self._labels, self._picture)
        return self._state

    @staticmethod
    @abstractmethod
    def _own_kind(config: CentreConfig) -> CentreConfig:
        """The config with the kind of this centre."""

    @abstractmethod
    def _begin(self) -> None:
        """Make what this kind has of its own."""

    @abstractmethod
    def _kept(self) -> dict[str, Any]:
        """What of that a checkpoint holds, and `_restore` takes again."""

    @abstractmethod
    def _restore(self, state: dict[str, Any]) -> None:
        """Go on with what `_kept` gave."""

    @abstractmethod
    def _rebase(self, time: int) -> None:
        """A new era begins at `time`, ns: nothing that this kind has of its own is later."""

    @abstractmethod
    def _renamed(self, new: dict[int, int]) -> None:
        """Tracks of the picture have other ids now: {old: new}."""

    @property
    @abstractmethod
    def _rule(self) -> str:
        """The rule that the picture names."""

    @abstractmethod
    def _advance(self, rows: Rows, names: tuple[str, ...], time: int) -> Contributions:
        """Bring the picture to `time`, ns, with these rows; names: all sources, sorted. Who fed each track."""

    def _watched(self) -> dict[str, dict[str, Any]]:
        """What the status says of sources, by name, beside what every kind of centre says."""
        return {}

    def _stop_waiting(self, tracks: NDArray[np.uint64]) -> int:
        """Suspended tracks that do not come back; how many of them there were."""
        return 0

    @abstractmethod
    def _forget(self, tracks: Iterable[int]) -> None:
        """Undo whatever refers to global tracks that are no more."""

    def _obey(self, orders: list[Order], time: int) -> None:
        obeyed = obey(orders, self._intake, self._picture, self._ids, self._journal, time, self._step)
        self._picture = obeyed.picture
        if obeyed.gone:
            self._forget(obeyed.gone)

    def _end_all(self, tracks: NDArray[np.uint64], reason: str) -> None:
        """End those of these global tracks that there are."""
        for track in self._picture.id[np.isin(self._picture.id, tracks)].tolist():
            self._journal.end(track, reason, None)
        self.let_go(tracks)

    def _forget_lineages(self) -> None:
        """Let go the lineages that nothing has any more, where they are many."""
        sources = self._intake.sources.values()
        new = self._intake.lineages.compacted([self._picture.lineage, *(one.tracks.lineage for one in sources)])
        if new is None:
            return
        self._picture = replace(self._picture, lineage=new[self._picture.lineage])
        for source in sources:
            source.tracks = replace(source.tracks, lineage=new[source.tracks.lineage])

    def _numbers(self) -> dict[str, int]:
        kinds = np.bincount(self._picture.status, minlength=len(messages.STATUSES)).tolist()
        counts = {name: kinds[code] for code, name in enumerate(messages.STATUSES)}
        counts |= {"suspended": len(self._ids.waiting)} if len(self._ids.waiting) else {}
        return counts | self._labels.numbers()
