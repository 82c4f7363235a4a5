"""The story of one global track, gathered step by step from step logs and pictures.

What is repeated in step after step (a link kept, a gate failed) is one event from its first to its last step. Times are
ns; d2 is the statistic that the centre's gates bound. A member is a local track that was part of the track.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fusion_service.decision_words import MINE, SAID, THEIRS, made_again
from fusion_service.recording import RawMessage
from fusion_service.recording.steps import Step
from fusion_service.review.explain.histories import GONE
from schemas import STATUSES, GlobalTracks, LocalIntensity, LocalTracks, MessageError, StepLog, decode
from schemas.messages import (
    BORN,
    BROKEN,
    COASTING,
    COASTING_NOW,
    CONFIRMED_NOW,
    DELETED,
    EXCHANGED,
    GATE_FAILED,
    KEPT,
    LINKED,
    MERGED,
    SPLIT,
    TENTATIVE,
)

__all__ = [
    "CAME",
    "WENT",
    "Composition",
    "Happening",
    "Link",
    "Member",
    "Story",
    "local_messages",
]

Member = tuple[str, int, int]
"""A local track: source, epoch, id."""
Recent = Mapping[str, deque[RawMessage]]
"""The newest messages of each source, as they came."""
Decided = dict[Member, tuple[str, float]]
"""What was decided of each member in a step: the word, and d2."""

OF_MEMBERS = (LINKED, KEPT, GATE_FAILED, BROKEN)
CAME, WENT = MINE[EXCHANGED], THEIRS[EXCHANGED]
SILENT = "the source has said nothing new"
MOST_HAPPENINGS = 10_000


@dataclass(slots=True)
class Happening:
    """Something that happened in so many steps from first to last: what, in words; member or other global track that
    it is about; low and high, the range of d2 (NaN: none)."""

    first: int
    last: int
    what: str
    member: Member | None = None
    other: int | None = None
    steps: int = 1
    low: float = math.nan
    high: float = math.nan


@dataclass(slots=True)
class Link:
    """What a member brought from its first to its last step: in so many steps, influence in total, least and most;
    there: whether it is a part in the newest step; aside: linked, but left out since it failed its gate; value: its
    newest d2."""

    first: int
    last: int
    steps: int = 0
    total: float = 0.0
    least: float = math.inf
    most: float = -math.inf
    there: bool = True
    aside: bool = False
    value: float = math.nan

    def bring(self, at: int, influence: float) -> None:
        """Its part in the step at `at`."""
        self.last, self.steps, self.there, self.aside = at, self.steps + 1, True, False
        if math.isfinite(influence):
            self.total += influence
            self.least, self.most = min(self.least, influence), max(self.most, influence)


class Composition(NamedTuple):
    """The track after one step: its row in the picture, what its members brought, their newest d2, and the newest
    messages of their sources."""

    picture: GlobalTracks
    row: int
    influence: dict[Member, float]
    values: dict[Member, float]
    recent: dict[str, tuple[RawMessage, ...]]


class Story:
    """Gathers what happened to the global track `track`. until: the time (ns) of the `composition` that is wanted, None
    for the last step that had contributions."""

    def __init__(self, track: int, until: int | None = None) -> None:
        self.track = track
        self.until = until
        self.happenings: list[Happening] = []
        self.links: dict[Member, Link] = {}
        self.status: Counter[str] = Counter()
        self.existence = (math.inf, -math.inf)
        self.first = self.last = -1
        self.steps = 0
        self.ended: tuple[int, str, int | None] | None = None
        self.ordered: set[int] = set()
        """MERGED, SPLIT: how it ended, or began, by an operator's order."""
        self.composition: Composition | None = None
        self.newest: tuple[GlobalTracks, int] | None = None
        self.supported = -1
        """Time of the last step with contributions."""
        self._open: dict[tuple[str, Member], Happening] = {}
        self._orders: list[Any] = []
        self._before = -1

    def step(self, step: Step, recent: Recent) -> None:
        """Take a step of the centre. recent: what its sources have sent until then."""
        if self.ended is not None:
            return
        decided: Decided = {}
        if step.log is not None:
            if self.first >= 0:
                self._events(step.log, step.time)
            decided = self._decisions(step.log, step.time)
        if step.picture is not None:
            self._picture(step.picture, step.log, decided, recent)

    def say(
        self, at: int, what: str, member: Member | None = None, other: int | None = None, d2: float = math.nan
    ) -> None:
        """Note a single event."""
        if len(self.happenings) < MOST_HAPPENINGS:
            self.happenings.append(Happening(at, at, what, member, other, low=d2, high=d2))

    def _events(self, log: StepLog, at: int) -> None:
        """Note what came in beside messages and is about the centre, the track or its sources."""
        sources = {member[0] for member in self.links}
        for event in log.events:
            kind, source = event.get("kind"), event.get("source")
            if kind == "start":
                kept = "checkpoint" in event or "left_out" in event
                self.say(at, f"the service began anew {'from its checkpoint' if kept else 'without a checkpoint'}")
            elif kind == "era":
                self.say(at, "the clock was set back: a new era began")
            elif kind == "revised" and sources & set(_listed(event.get("sources"))):
                self.say(at, made_again(event, at))
            elif kind in ("suspended", "resumed") and self.track in _listed(event.get("tracks")):
                self.say(at, "suspended: all that could see it are silent" if kind == "suspended" else "back")
            elif kind in ("found", "lost") and source in sources:
                self.say(at, f"{source} {'is on the bus' if kind == 'found' else 'has left the bus'}")
            elif kind == "order" and (whom := self._concerned(event, sources)):
                self._orders.append(event.get("number", 0))
                self.say(at, f"order to {event.get('what')} {whom}{_ordered(event)}")
            elif kind == "order_ended" and event.get("number") in self._orders:
                self.say(at, f"the order to {event.get('what')} stands no more: {event.get('why')}")
            elif kind in ("alarm", "alarm_over") and self.track in _listed(event.get("tracks")):
                self.say(at, f"{event.get('identity')} is {'' if kind == 'alarm' else 'no longer '}in two places")
            elif (
                kind in ("alarm", "copy")
                and event.get("why")
                and (event.get("track") == self.track or source in sources)
            ):
                self.say(at, f"{source}: {event['why']}")

    def _concerned(self, event: dict[str, Any], sources: set[str]) -> str:
        """Whom of this story an order is about; empty where nobody of it."""
        if self.track in (event.get("track"), event.get("other")):
            return "it"
        source = event.get("source")
        if isinstance(source, str) and source in sources:
            return source
        members = [(name, track) for name, _, track in self.links]
        asked = [_listed(event.get(name)) for name in ("local", "against")]
        return " and ".join(f"{one[0]} {one[2]}" for one in asked if len(one) == 3 and (one[0], one[2]) in members)

    def _decisions(self, log: StepLog, at: int) -> Decided:
        """Note the decisions about the track; those about its members."""
        one, track = log.decisions, np.uint64(self.track)
        decided: Decided = {}
        told = set()
        for row in np.flatnonzero((one.track == track) | (one.other == track)).tolist():
            kind, value, other = int(one.kind[row]), float(one.value[row]), int(one.other[row])
            mine, source = bool(one.track[row] == track), int(one.source[row])
            member = log.sources[source] if source < len(log.sources) else "", int(one.epoch[row]), int(one.id[row])
            if kind == EXCHANGED and member[0]:
                decided[member] = (CAME if mine else WENT), value
                self.say(at, CAME if mine else WENT, member, other if mine else int(one.track[row]), value)
            elif mine and kind in OF_MEMBERS and member[0]:
                decided[member] = SAID[kind], value
                told.add((SAID[kind], member))
                self._repeat(at, SAID[kind], member, value)
            elif kind == BORN:
                self.say(at, SAID[BORN])
            elif kind == SPLIT:
                whom = other if mine else int(one.track[row])
                self.say(at, (MINE if mine else THEIRS)[SPLIT], None, whom, value)
                self.ordered |= {SPLIT} if mine and _split_by_order(log, self.track) else set()
            elif kind == DELETED:
                self.ended = at, SAID[DELETED], None
            elif kind == MERGED:
                self.ended = (at, "merged", other) if mine else self.ended
                self.ordered |= {MERGED} if mine and _merged_by_order(log, self.track) else set()
                self.say(at, (MINE if mine else THEIRS)[MERGED], None, other if mine else int(one.track[row]), value)
        for key in [key for key in self._open if key not in told]:
            del self._open[key]
        return decided

    def _repeat(self, at: int, what: str, member: Member, value: float) -> None:
        """Note what may go on from step to step."""
        known = self._open.get((what, member))
        if known is None:
            self.say(at, what, member, d2=value)
            self._open[what, member] = self.happenings[-1]
            return
        known.last, known.steps = at, known.steps + 1
        known.low, known.high = float(np.fmin(known.low, value)), float(np.fmax(known.high, value))

    def _picture(self, picture: GlobalTracks, log: StepLog | None, decided: Decided, recent: Recent) -> None:
        at = picture.time
        rows = np.flatnonzero(picture.ids == np.uint64(self.track))
        if len(rows):
            self._present(picture, int(rows[0]), log, decided, recent)
        for track, reason, heir in picture.ended:
            if track == self.track:
                self.ended = at, reason, heir
        if self.first >= 0 and not len(rows) and self.ended is None:
            self.ended = at, GONE, None

    def _present(self, picture: GlobalTracks, row: int, log: StepLog | None, decided: Decided, recent: Recent) -> None:
        at, status = picture.time, int(picture.status[row])
        if self.first < 0:
            self.first = at
            if not any(one.what == SAID[BORN] for one in self.happenings):
                self.say(at, "there already")
        self.last, self.steps = at, self.steps + 1
        existence = float(picture.existence[row])
        self.existence = min(self.existence[0], existence), max(self.existence[1], existence)
        self.status[STATUSES[status]] += 1
        influence = members_of(picture, row)
        for member, part in influence.items():
            link = self.links.setdefault(member, Link(at, at))
            if (not link.there or not link.steps) and member not in decided:
                before = _elsewhere(member, log, self.track)
                self.say(at, "is a part" if before is None else "comes over from", member, before)
            link.bring(at, part)
            link.value = decided[member][1] if member in decided else math.nan
        for member, link in self.links.items():
            if (link.there or link.aside) and member not in influence:
                self._left(member, link, at, log, decided.get(member, ("", 0.0))[0], recent)
        if status != self._before:
            before, self._before = self._before, status
            if before >= 0 or status != TENTATIVE:
                self.say(at, _change(before, status))
        self.newest = picture, row
        self._compose(picture, row, influence, recent)

    def _left(self, member: Member, link: Link, at: int, log: StepLog | None, word: str, recent: Recent) -> None:
        """The member is no part of this step; word: what was decided of it."""
        after, was_aside = _elsewhere(member, log, self.track), link.aside
        link.there, link.aside = False, word == SAID[GATE_FAILED]
        if link.aside or word in (SAID[BROKEN], WENT):
            return
        why = _why(member, at, log, recent) if after is None else ""
        if was_aside and why.startswith(SILENT):
            link.aside = True
            return
        self.say(at, "goes over to" if after is not None else f"leaves: {why}", member, after)

    def _compose(self, picture: GlobalTracks, row: int, influence: dict[Member, float], recent: Recent) -> None:
        at = picture.time
        if influence:
            self.supported = at
        if (influence or self.until is not None) and (self.until is None or at <= self.until):
            values = {member: self.links[member].value for member in influence}
            sources = {member[0] for member in influence}
            held = {source: tuple(recent.get(source, ())) for source in sources}
            self.composition = Composition(picture, row, influence, values, held)


def _listed(value: Any) -> list[Any]:
    return list(value) if isinstance(value, (list, tuple)) else []


def _ordered(event: dict[str, Any]) -> str:
    """What else an order says: who gave it and why, and what came of it. Logs of before say nothing of it."""
    who, why, outcome = (event.get(name) for name in ("who", "why", "outcome"))
    given = f"{f' by {who}' if who else ''}{f' ({why})' if why else ''}"
    refused = ", refused" if event.get("done") is False else ""
    return f"{given}{refused}{f': {outcome}' if outcome else ''}"


def _obeyed(log: StepLog, what: str) -> list[dict[str, Any]]:
    """The orders of this kind that the step obeyed."""
    found = [event for event in log.events if event.get("kind") == "order" and event.get("what") == what]
    return [event for event in found if event.get("done") is not False]


def _merged_by_order(log: StepLog, track: int) -> bool:
    return any(event.get("other") == track for event in _obeyed(log, "merge"))


def _split_by_order(log: StepLog, track: int) -> bool:
    """Whether a local track that the step counts to the new global one was ordered to leave another."""
    one = log.decisions
    mine = np.flatnonzero((one.track == np.uint64(track)) & (one.source < len(log.sources)))
    members = {(log.sources[s], i) for s, i in zip(one.source[mine].tolist(), one.id[mine].tolist(), strict=True)}
    locals_ = (_listed(event.get("local")) for event in _obeyed(log, "split"))
    return any(len(local) == 3 and (local[0], local[2]) in members for local in locals_)


def _change(before: int, status: int) -> str:
    if status == COASTING:
        return SAID[COASTING_NOW]
    if status == TENTATIVE:
        return "is tentative again"
    return "has a source again" if before == COASTING else SAID[CONFIRMED_NOW]


def members_of(picture: GlobalTracks, row: int) -> dict[Member, float]:
    """The influence of each member of the track in `row`."""
    ends = np.cumsum(picture.contributor_counts, dtype=np.intp)
    some = slice(int(ends[row]) - int(picture.contributor_counts[row]), int(ends[row]))
    columns = (picture.contributor_source, picture.contributor_epoch, picture.contributor_id)
    source, epoch, local = (column[some].tolist() for column in columns)
    influence = picture.contributor_influence[some].tolist()
    return {
        (picture.sources[s], e, i): float(part) for s, e, i, part in zip(source, epoch, local, influence, strict=True)
    }


def local_messages(raws: Iterable[RawMessage]) -> list[LocalTracks | LocalIntensity]:
    """Those that can be read, the latest time last."""
    found: list[LocalTracks | LocalIntensity] = []
    for raw in raws:
        try:
            message = decode(raw.data)
        except MessageError:
            continue
        if isinstance(message, LocalTracks | LocalIntensity):
            found.append(message)
    return sorted(found, key=lambda one: (one.epoch, one.time, one.seq))


def _elsewhere(member: Member, log: StepLog | None, track: int) -> int | None:
    """The other global track to which a decision of this step links the member."""
    if log is None:
        return None
    one, (source, epoch, local) = log.decisions, member
    linked = np.isin(one.kind, (LINKED, KEPT, GATE_FAILED, EXCHANGED)) & (one.track != np.uint64(track))
    for row in np.flatnonzero(linked & (one.id == np.uint64(local)) & (one.epoch == np.uint64(epoch))).tolist():
        if int(one.source[row]) < len(log.sources) and log.sources[int(one.source[row])] == source:
            return int(one.track[row])
    return None


def _why(member: Member, at: int, log: StepLog | None, recent: Recent) -> str:
    """Why a member is a part no more, as far as its source's messages and the log tell."""
    source, epoch, local = member
    orders = [event for event in log.events if event.get("what") == "mute"] if log is not None else []
    if any(event.get("source") == source for event in orders):
        return "the source was muted by order"
    messages = [one for one in local_messages(recent.get(source, ())) if one.time <= at]
    if not messages:
        return "nothing of the source is in the recording"
    newest = messages[-1]
    age = (at - newest.time) / 1e9
    if newest.epoch != epoch:
        return "the source began anew"
    if isinstance(newest, LocalTracks) and newest.complete and local not in newest.ids:
        return f"the source lists it no more (its scan is {age:.1f} s old)"
    if isinstance(newest, LocalIntensity):
        return f"the source expects too little there (its intensity is {age:.1f} s old)"
    return f"{SILENT} of it for {age:.1f} s"
