"""What a centre keeps of its newest steps, so that they can be made again when late data belong to them.

Of every step of the last `lateness`, and of so much more as late data may have to wait for their turn, it keeps what
went into it: orders, sources that came and went, the messages taken. Of some it keeps the state before them, as a
checkpoint: one in about an eighth of `lateness`, fewer where the tables are large, and of the newest `RECENT` while
data come late, or where there are `MANY` tracks, so that one late scan costs a step and not six. A message is late
where a step that was made should have taken it, by its time. Before the next step the centre then goes back to the
newest kept state before that one, and makes the steps from there again with all of their inputs, each where it belongs
by its time.

Once in a step at most, and no more than `revise` steps for each step on the average: what there is no room for now is
taken as it comes, and put in its place when steps are made again the next time. So the cost of late data is bounded,
and by nothing but the inputs: a replay makes the same steps again.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from fusion_service.centre.events import Event, Skipped, SourceFound, SourceLost
from fusion_service.centre.intake import Intake
from fusion_service.centre.limits import MAX_ORDERS, MAX_SOURCES
from fusion_service.centre.pictures import as_scan, source_of
from fusion_service.centre.refusing import fault
from fusion_service.centre.scans import size_of
from fusion_service.centre.spared import Spared
from fusion_service.centre.unplaced import Key, Unplaced
from fusion_service.config import CentreConfig
from fusion_service.order import Order
from schemas import (
    Entry,
    GlobalTracks,
    LocalIntensity,
    LocalTracks,
    Message,
    MessageError,
    Status,
    check_source,
)

__all__ = ["History", "Key", "Late", "Past", "key_of"]

STATES = 8
"""Kept states in one `lateness`, about."""
MOST_ROWS = 1_000_000
"""Tracks, local and global, in all kept states together; above that there are fewer states, but two at least."""
RECENT = 3
"""Newest states that are kept while data come late."""
MANY = 2000
"""Tracks, local and global, from which on they are always kept, but while the centre is behind: to keep one costs a
tenth of a step."""
JUST = 1_000_000
"""ns: on arrival, a scan of that much before the newest step belongs to it as much as to one of its own."""
CALM = 2_000_000_000
"""ns after the newest sign that the centre is behind."""
BUSY = 20
"""Steps for which they are kept after the last late message."""
MOST_STEPS = 2000
MOST_COMPONENTS = 1_000_000
"""Of the inputs that are kept."""
MOST_OWED = 50_000


@dataclass(frozen=True, slots=True, eq=False)
class Late:
    """A queued message that an earlier step should have taken, the first at or after `due`, ns."""

    key: Key
    due: int
    event: Message
    received: int


@dataclass(slots=True, eq=False)
class Past:
    """A step that was made: its time and that of the one before it, ns; events and messages that went into it, with
    when they came; spared: whose silence said nothing before it; state: the checkpoint before it, lasting: as one of
    the few that are kept for long."""

    number: int
    time: int
    before: int
    events: tuple[tuple[Event, int], ...]
    spared: Spared
    inputs: list[tuple[Message, int]] = field(default_factory=list)
    state: bytes | None = None
    lasting: bool = False
    size: int = 0


def key_of(entry: Entry) -> Key:
    """The key of the message that a log's entry names."""
    return entry.source, entry.epoch, entry.seq, entry.hash


class History:
    """The newest steps of a centre. past: in order; late: messages put in their place since the start, by source,
    and reordered, those of them that came after a later one; revised: steps made again since the start; unplaced: what
    was late and stays where it came."""

    def __init__(self, config: CentreConfig) -> None:
        self._lateness = round(config.lateness * 1e9)
        self._pace = config.revise
        self._window = round(self._lateness * (min(2.0, self._pace / (self._pace - 1)) if self._pace > 1 else 2.0))
        self._just = JUST if config.trigger == "arrival" else 0
        self.on = self._pace > 0 and self._lateness > 0
        self.past: list[Past] = []
        self.late: Counter[str] = Counter()
        self.reordered: Counter[str] = Counter()
        self.revised = 0
        self.unplaced = Unplaced()
        self._credit = 0.0
        self._calm = -1
        self._busy = 0
        self._size = 0
        self._owed: dict[Key, int] = {}
        self._presence: dict[str, tuple[Event, int]] = {}
        self._orders: list[tuple[Event, int]] = []

    @property
    def oldest(self) -> int:
        """The number of the oldest step that may be made again."""
        return self.past[0].number if self.past else 2**63

    def note(self, event: Event, received: int) -> None:
        """An event was queued for the next step."""
        if not self.on:
            return
        if isinstance(event, (SourceFound, SourceLost)):
            if event.source in self._presence or len(self._presence) < 2 * MAX_SOURCES:
                self._presence[event.source] = event, received
        elif isinstance(event, (Order, Skipped)) and len(self._orders) < MAX_ORDERS:
            self._orders.append((event, received))

    def noted(self) -> tuple[tuple[Event, int], ...]:
        """The events for the step that is made now."""
        events = (*self._presence.values(), *self._orders)
        self._presence, self._orders = {}, []
        return events

    def clear(self) -> None:
        """Nothing that was made so far is made again."""
        self.past, self._owed, self._size, self._credit, self._calm = [], {}, 0, 0.0, -1
        self.unplaced.began = self.unplaced.cut = -1

    def find(self, intake: Intake, last: int) -> list[Late]:
        """The queued messages that a step until `last`, ns, should have taken, and that would be taken now."""
        found: dict[Key, Late] = {}
        for event, received in intake.queue:
            if not isinstance(event, (LocalTracks, LocalIntensity, GlobalTracks)):
                continue
            due = event.time - intake.treatment(source_of(event)).clock
            if due > last - self._just or event.time < last - self._lateness:
                continue
            try:
                code = intake.ahead.digest(event)
            except MessageError:
                continue
            key = source_of(event), event.epoch, event.seq, code
            if key not in found and not _would_be_refused(intake, event, code, received, last):
                found[key] = Late(key, due, event, received)
        return list(found.values())

    def behind(self) -> None:
        """Steps were skipped, or data dropped: for `CALM` no step is made again, which would only cost more of them.
        What comes late in that time is used as it comes."""
        self.unplaced.behind(self._owed)
        self._calm, self._owed = (self.past[-1].time if self.past else 0) + CALM, {}

    def start(self, late: Sequence[Late]) -> int | None:
        """The step in `past` from which steps are to be made again for these and what is owed, None where nothing is.
        Call it once a step."""
        self._credit = min(self._credit + self._pace, max(float(len(self.past)), self._pace))
        first = next((i for i, one in enumerate(self.past) if one.state is not None), None)
        if first is None:
            self.unplaced.gone(self._owed.items())
            self._owed = {}
            return None
        floor = self.past[first].before
        self.unplaced.gone((key, due) for key, due in self._owed.items() if due <= floor)
        self._owed = {key: due for key, due in self._owed.items() if due > floor}
        dues = [one.due for one in late if one.due > floor] + list(self._owed.values())
        if late:
            self._busy = self.past[-1].number + BUSY
        if not dues or self.past[-1].time < self._calm:
            return None
        at = bisect_left(self.past, min(dues), key=lambda one: one.time)
        start = max(i for i in range(first, at + 1) if self.past[i].state is not None)
        if len(self.past) - start > self._credit:
            return None
        self._credit -= len(self.past) - start
        return start

    def reached(self, late: Iterable[Late], start: int) -> list[Late]:
        """Those of them that belong to the steps from `start` on."""
        return [one for one in late if one.due > self.past[start].before]

    def rewind(self, start: int) -> tuple[list[Past], list[Key]]:
        """Take the steps from `start` on away, to be made again; and what was owed to them."""
        again, owed = self.past[start:], list(self._owed)
        del self.past[start:]
        self._size -= sum(one.size for one in again)
        self._owed = {}
        return again, owed

    def told(self, steps: int, moved: Iterable[Key]) -> None:
        """So many steps were made again, and these messages are now in their places."""
        self.revised += steps
        for name, *_ in moved:
            if name in self.late or len(self.late) < 2 * MAX_SOURCES:
                self.late[name] += 1

    def futile(self, steps: int) -> None:
        """It changed nothing to make them again."""
        self._credit += steps

    def keeps(self, last: int, number: int, rows: int, left: int) -> bool | None:
        """Whether the state after the step `number`, at `last`, ns, of so many rows is kept for the next one: True, for
        long; False, while it is one of the newest; None, not. left: steps that are still to be made again."""
        kept = next((one for one in reversed(self.past) if one.lasting), None)
        spacing = self._lateness // max(2, min(STATES, MOST_ROWS // max(rows, 1)))
        if kept is None or last - kept.before >= spacing:
            return True
        many = MANY <= rows <= MOST_ROWS // STATES
        recent = number < self._busy or (many and last >= self._calm)
        return False if recent and left < RECENT else None

    def told_in(self, status: Status) -> Status:
        """A status with what was put in its place, and how many steps were made again, since the start."""
        status = self.unplaced.told_in(status)
        if not self.late:
            return status
        queue = dict(status.queue) | {"late": self.late.total(), "revised": self.revised}
        sources = {
            name: entry | {"late": self.late[name], "reordered": entry["reordered"] + self.reordered[name]}
            for name, entry in status.sources.items()
        }
        return replace(status, queue=queue, sources=sources)

    def add(self, one: Past, raw: dict[Key, tuple[Message, int, int]], taken: Iterable[Entry], owes: bool) -> None:
        """A step was made that took `taken` of `raw`. owes: it is no step made again, so that what it took late is
        owed to earlier ones."""
        if not self.on:
            return
        for entry in taken:
            key = key_of(entry)
            if key in raw:
                event, received, due = raw[key]
                one.inputs.append((event, received))
                one.size += size_of(event)
                if owes and isinstance(event, (LocalTracks, LocalIntensity, GlobalTracks)):
                    self._owe(key, due, one.before)
        self.past.append(one)
        self.unplaced.began = max(one.before, 0) if self.unplaced.began < 0 else self.unplaced.began
        self._size += one.size
        for old in self.past[:-RECENT][-BUSY:]:
            if not old.lasting:
                old.state = None
        self._trim(one.time - self._window)

    def _owe(self, key: Key, due: int, before: int) -> None:
        if before < 0 or due > before - self._just:
            return
        if before >= self._calm and len(self._owed) < MOST_OWED:
            self._owed[key] = due
        else:
            self.unplaced.behind((key,))

    def _trim(self, oldest: int) -> None:
        """Let go what no late message reaches any more, or there is no room for."""
        starts = [i for i, one in enumerate(self.past) if one.state is not None]
        if not starts:
            self._cut(len(self.past), 0)
            return
        cut = max((i for i in starts if self.past[i].before <= oldest), default=starts[0])
        size = self._size - sum(one.size for one in self.past[:cut])
        while len(self.past) - cut > MOST_STEPS or size > MOST_COMPONENTS:
            after = next((i for i in starts if i > cut), len(self.past))
            size -= sum(one.size for one in self.past[cut:after])
            cut = after
            self.unplaced.cut = self.past[cut - 1].time
            if cut == len(self.past):
                break
        self._cut(cut, size)

    def _cut(self, steps: int, size: int) -> None:
        del self.past[:steps]
        self._size = size


def _would_be_refused(intake: Intake, event: Message, code: int, received: int, last: int) -> bool:
    """Whether a message of the digest `code` would be refused in the next step after one at `last`, ns."""
    name = source_of(event)
    try:
        check_source(name)
    except ValueError:
        return True
    source = intake.sources.get(name)
    if source is None and intake.is_full:
        return True
    message = as_scan(event, intake.config, intake.frame)
    about = source or intake.blank(name)
    return bool(fault(intake.config, about, message, code, last, received, lambda one: intake.is_stale(one, last + 1)))
