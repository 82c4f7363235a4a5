"""The state of the active centre, held by another process: a checkpoint of it, and every step since as its log says.

A step log names what the step took; the messages came here too, so the same step is made of them. What comes of it is
compared with the picture that the active centre published. Where a message is missing, a step failed or gave other
tracks, or the settings differ, nothing more is made: `wanted` says why a new checkpoint is needed. Until it is there,
this process would go on from the last step that it made, or, where that came out wrong, from the last checkpoint,
without the tracks that have ended since, as a service does that was killed, with the ids of those that have begun, for
their local tracks, and with the orders given since. Where the
same tracks have other numbers, it goes on, and takes a new checkpoint when it may: a checkpoint does not tell what came
before it, so that data that were late for steps before it change the active centre's alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre import Centre, Order, make_centre, source_of
from fusion_service.centre.inputs import Input, InputBuffer
from fusion_service.centre.retracing import events_of, step_again
from fusion_service.config import CentreConfig
from fusion_service.service.heard import HeardOrders
from fusion_service.service.young import noted, padded, places_of
from schemas import GlobalTracks, LocalIntensity, LocalTracks, MessageError, SensorInfo, StepLog, digest

__all__ = ["PATIENCE", "Heritage", "Mark", "Shadow", "same_numbers", "same_tracks"]

PATIENCE = 0.5
"""Seconds for which a step waits for the messages that it took, and for the log of the one before it."""
LEISURE = 10.0
"""Seconds, and four times `lateness`, for which numbers may differ before a new checkpoint is taken."""
MOST = 256
"""Logs, and pictures, that wait."""
NEAR = 1e-6
"""Relative difference of means up to which pictures of two machines are alike."""

Mark = tuple[int, int]
"""A step: the epoch of the run, and its number."""


class Kept(NamedTuple):
    """A checkpoint, after which step it was made, and the number of the first order that it does not know."""

    blob: bytes
    mark: Mark
    following: int


class Heritage(NamedTuple):
    """What to go on from: a checkpoint, None where there is none, and since then tracks that have ended, orders, and
    notes of tracks that have begun (see `young`)."""

    checkpoint: bytes | None
    ended: NDArray[np.uint64]
    orders: list[Order]
    born: bytes


class Shadow:
    """Follows the centre of `config`. now: seconds, of a clock that never goes back.

    mark: the step that it stands at; wanted: why it needs a checkpoint, "" while it is in step; steps: made since the
    start; fetched: checkpoints taken."""

    def __init__(self, config: CentreConfig, now: Callable[[], float]) -> None:
        self._config = config
        self._now = now
        self._buffer = InputBuffer()
        self._centre: Centre | None = None
        self._kept: Kept | None = None
        self._logs: dict[Mark, tuple[StepLog, float]] = {}
        self._pictures: dict[Mark, GlobalTracks] = {}
        self._made: dict[Mark, GlobalTracks] = {}
        self._ended: dict[Mark, NDArray[np.uint64]] = {}
        self._born: dict[Mark, bytes] = {}
        self._above = 0
        """The newest id that the kept checkpoint has."""
        self.mark: Mark = (-1, -1)
        self.newest: Mark = (-1, -1)
        """The newest step that a log or picture was heard of."""
        self.wanted = "it has none yet"
        self.loaded = float("-inf")
        """When a checkpoint was taken, s."""
        self.orders = HeardOrders()
        self._off = self._astray = False
        self.off = 0
        """Steps whose numbers differed."""
        self.steps = self.fetched = 0

    @property
    def lacks(self) -> bool:
        """Whether a new checkpoint should be taken now."""
        leisure = max(LEISURE, 4 * self._config.lateness)
        return bool(self.wanted) or (self._off and self._now() - self.loaded > leisure)

    @property
    def ready(self) -> bool:
        """Whether it has a state to go on from."""
        return self._kept is not None

    def load(self, blob: bytes, mark: Mark) -> str:
        """Begin with a checkpoint of the active centre. Why it cannot be used, "" if it can."""
        centre, fault = make_centre(self._config, blob, epoch=mark[0])
        if fault:
            return fault
        self._centre, self.mark, self.wanted = centre, mark, ""
        self.fetched, self.loaded, self._off, self._astray = self.fetched + 1, self._now(), False, False
        self._keep(centre, blob)
        self._made.clear()
        for _, (log, _) in sorted(self._logs.items()):
            if (log.epoch, log.step) <= mark:
                self._buffer.settle(log, self._config.lateness)
        for held in (self._logs, self._pictures):
            for old in [one for one in held if one <= mark]:
                del held[old]
        return ""

    def _keep(self, centre: Centre, blob: bytes) -> None:
        """This checkpoint, of the step at `mark`, is what is gone on from where a later one came out wrong."""
        self._kept = Kept(blob, self.mark, centre.orders.next)
        self._above = int(centre.view().ids.max(initial=0))
        self.orders.settle(self.mark[0], centre.orders.next)
        for held in (self._ended, self._born):
            for old in [one for one in held if one <= self.mark]:
                del held[old]

    def local(self, message: object, key: str, data: bytes, received: int) -> None:
        """A message of a source, or the picture of another centre that is one."""
        if isinstance(message, (LocalTracks, LocalIntensity, SensorInfo, GlobalTracks)):
            try:
                code = digest(message)
            except MessageError:
                return
            self._buffer.add(code, Input(message, received, len(data), key=key, data=data))

    def output(self, message: object) -> None:
        """A log or picture of the active centre."""
        if not isinstance(message, (StepLog, GlobalTracks)):
            return
        mark = message.epoch, message.step
        self.newest = max(self.newest, mark)
        if isinstance(message, StepLog):
            self.orders.tell(message.epoch, message.events)
        else:
            self._note(mark, message)
        if mark <= self.mark:
            if isinstance(message, GlobalTracks):
                self._check(mark, message)
            return
        if isinstance(message, StepLog):
            self._logs[mark] = message, self._now()
        else:
            self._pictures[mark] = message
        for held in (self._logs, self._pictures):
            while len(held) > MOST:
                del held[min(held)]

    def _note(self, mark: Mark, published: GlobalTracks) -> None:
        """What a picture says has ended and begun since the kept checkpoint."""
        if self._kept is not None and mark <= self._kept.mark:
            return
        if published.ended:
            self._ended[mark] = np.array([one for one, _, _ in published.ended], dtype=np.uint64)
        if note := noted(published, self._above, lambda above: places_of(published, above)):
            self._born[mark] = note
        while len(self._born) > MOST:
            del self._born[min(self._born)]

    @property
    def waits(self) -> bool:
        """Whether a step is to be made yet, for which something has not come."""
        return not self.wanted and any(one > self.mark for one in self._logs)

    def advance(self) -> None:
        """Make the steps that can be made."""
        while not self.wanted and self._centre is not None:
            mark = self.mark[0], self.mark[1] + 1
            log, since = self._logs.get(mark, (None, 0.0))
            if log is None:
                later = [since for one, (_, since) in self._logs.items() if one > mark]
                if any(one[0] > mark[0] for one in self._logs):
                    self.wanted = "the active centre began anew"
                elif later and self._now() - min(later) > PATIENCE:
                    self.wanted = f"the log of step {mark[1]} did not come"
                return
            if log.config_hash != self._centre.config_hash:
                self.wanted = "the active centre has other settings: its steps cannot be made here"
            elif self._buffer.has_all(log):
                self._make(log, mark)
            elif self._now() - since > PATIENCE:
                self.wanted = f"a message that step {mark[1]} took did not come here"
            else:
                return

    def _make(self, log: StepLog, mark: Mark) -> None:
        assert self._centre is not None
        inputs = [one for entry in log.taken if (one := self._buffer.get(entry.hash)) is not None]
        try:
            result = step_again(self._centre, events_of(log), inputs, log.time)
        except Exception as error:  # whatever the active centre did, this one goes on
            self._stray(f"step {mark[1]} cannot be made here ({type(error).__name__}: {error})")
            return
        if result.tracks.step != mark[1]:
            self._stray(f"step {mark[1]} came out as step {result.tracks.step}")
            return
        self.mark, self.steps = mark, self.steps + 1
        self._buffer.settle(log, self._config.lateness)
        del self._logs[mark]
        self._made[mark] = result.picture
        while len(self._made) > MOST:
            del self._made[min(self._made)]
        if (published := self._pictures.pop(mark, None)) is not None:
            self._check(mark, published)
        if not self._astray and (self.orders.full or len(self._ended) + len(self._born) > MOST):
            self._keep(self._centre, self._centre.checkpoint())

    def _stray(self, why: str) -> None:
        """What was made here is not the active centre's state."""
        self.wanted, self._astray = why, True

    def _check(self, mark: Mark, published: GlobalTracks) -> None:
        made = self._made.pop(mark, None)
        if made is None or self.wanted:
            return
        if not same_tracks(made, published):
            self._stray(f"step {mark[1]} gave other tracks than the active centre's")
        elif not same_numbers(made, published):
            self._off, self.off = True, self.off + 1

    def heritage(self) -> Heritage:
        """See the class of it."""
        if self._centre is not None and not self._astray:
            blob, mark, following = self._centre.checkpoint(), self.mark, self._centre.orders.next
        elif self._kept is not None:
            blob, mark, following = self._kept
        else:
            return Heritage(None, np.zeros(0, dtype=np.uint64), self.orders.since(0), b"")
        gone = [ids for one, ids in sorted(self._ended.items()) if one > mark]
        born = b"".join(padded(note) for one, note in sorted(self._born.items()) if one > mark)
        ended = np.concatenate([np.zeros(0, dtype=np.uint64), *gone])
        return Heritage(blob, ended, self.orders.since(following), born)

    def left(self, since: int) -> list[tuple[str, Input]]:
        """What came since then, ns, and was in no step yet, each with its source, in the order of arrival."""
        inputs = self._buffer.unclaimed(2**63, 2**63, None)
        return [(source_of(one.message), one) for one in inputs if one.received >= since]


def same_tracks(made: GlobalTracks, published: GlobalTracks) -> bool:
    """Whether a whole picture has the tracks of the one that was published, of which a delta says a part."""
    ids = made.ids[np.isin(made.ids, published.ids)] if published.delta else made.ids
    return np.array_equal(ids, published.ids) and made.space == published.space and made.frame == published.frame


def same_numbers(made: GlobalTracks, published: GlobalTracks) -> bool:
    """Whether pictures of the same tracks say the same of them, as far as two machines compute alike. Of mixtures in a
    delta only the status is compared."""
    listed = np.isin(made.ids, published.ids)
    if not np.array_equal(made.status[listed], published.status):
        return False
    means = made.means
    if published.delta:
        if made.counts is not None or published.counts is not None:
            return True
        means = means[listed]
    return means.shape == published.means.shape and np.allclose(means, published.means, rtol=NEAR, atol=NEAR)
