"""Messages become the drawing: picture, charts and log together, and what cannot be drawn is counted."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

from fusion_service import geodesy
from fusion_service.recording.columns import ColumnWriter, Stamp
from fusion_service.recording.drawing.charts import Charts
from fusion_service.recording.drawing.errors import TruthMatcher
from fusion_service.recording.drawing.log import EventLog
from fusion_service.recording.drawing.mission_clock import MissionClock
from fusion_service.recording.drawing.sources import SourceCharts
from fusion_service.recording.drawing.tracks import Drawing
from fusion_service.recording.drawing.traffic import TrafficCharts
from schemas import (
    FAULTS,
    Frame,
    GlobalTracks,
    LocalIntensity,
    LocalTracks,
    Message,
    SensorInfo,
    Status,
    StepLog,
    Truth,
    Wholes,
    check_numbers,
)

__all__ = ["MAX_SOURCES", "PATIENCE", "Scene"]

log = logging.getLogger(__name__)

PATIENCE = 5.0
"""Seconds for which the drawing waits for global tracks, to take their frame."""
NOT_OURS = "its time is not the mission's"
MAX_SOURCES = 256
MAX_CENTRES = 32
MAX_TRACKS = 5000
"""Sources, centres and scenarios, and tracks of one message, that are drawn; an ellipse takes 600 B. `tables` bounds
the components."""
MAX_WAITING = 10_000
"""Messages that wait for a frame or a mission time."""
MAX_REASONS = 100
"""Reasons that are told apart in `undrawn`; what is beyond them is "other"."""
MAX_ASSESSED = 1000
"""Tracks and true objects of a step that are assigned to each other."""

Drawable = LocalTracks | LocalIntensity | GlobalTracks | SensorInfo | Truth


class Scene:
    """What a recording shows, written as rows of `columns`. `undrawn`: tracks or messages left out, by reason."""

    def __init__(
        self, columns: ColumnWriter, frame: Frame | None, cutoff: float | None, focus: int | None = None
    ) -> None:
        self.drawing = Drawing(columns, frame, focus)
        self.event_log = EventLog(columns, self.drawing, focus)
        self.crowded = False
        """Whether charts have so many series that a legend would hide them."""
        self.supervised = False
        """Whether a status said how sources are trusted, or shifted."""
        self.undrawn: Counter[str] = Counter()
        self._charts = Charts(columns, focus)
        self._sources = SourceCharts(columns)
        self._traffic = TrafficCharts(columns)
        self.assessed = False
        """Whether there are errors against a truth."""
        self._matcher = TruthMatcher(cutoff)
        self._wholes = Wholes()
        self._clock = MissionClock()
        self._new: list[tuple[Message, Stamp]] = []
        self._said: set[tuple[str, str]] = set()
        self._names: dict[bool, set[str]] = {True: set(), False: set()}

    def restart(self) -> None:
        """A new part of the recording begins."""
        self._charts.restart()
        self._sources.restart()
        self._traffic.restart()
        self.drawing.changed = True

    @property
    def now(self) -> int | None:
        """The newest time of the mission, ns; None before any."""
        return self._clock.now

    def mission_time(self, message: Message | None, received: int) -> int | None:
        """The time of `message` on the mission's timeline, None where it has none, or has none yet."""
        return self._clock.place(message, received)

    def add(self, message: Message, stamp: Stamp) -> None:
        """Take a message for the next `draw`; without a mission time it is drawn at that of its arrival."""
        timed = isinstance(message, LocalTracks | LocalIntensity | Truth)
        if timed and stamp.time is None and self._clock.decided:
            self._leave_out(message.source, NOT_OURS, 1, stamp._replace(time=self.now))
            return
        self._new.append((message, stamp if timed or stamp.time is not None else stamp._replace(time=self.now)))
        if len(self._new) > MAX_WAITING and self.drawing.chart is None:
            self._new.pop(0)
            self._leave_out(message.source, "nothing has said a frame and a time yet", 1, stamp)

    def alive(self, scope: str, name: str, alive: bool, stamp: Stamp) -> None:
        """A liveliness token came or went."""
        self.event_log.alive(scope, name, alive, stamp)
        if not alive and scope == "local" and stamp.time is not None:
            self.drawing.clear(name, stamp)

    def draw(self, patience: float = PATIENCE) -> None:
        """Add the rows of all that was taken; what needs a frame waits for it, at most `patience` seconds."""
        ready = self._open_chart(patience)
        due = [self._is_due(*item, ready) for item in self._new]
        drawn = self._timely([item for item, now in zip(self._new, due, strict=True) if now])
        self._new = [item for item, now in zip(self._new, due, strict=True) if not now]
        tracks = [message for message, _ in drawn if isinstance(message, LocalTracks | LocalIntensity | GlobalTracks)]
        faults = dict(zip(map(id, tracks), check_numbers(tracks), strict=True))
        for message, stamp in drawn:
            stamp = stamp if stamp.time is not None else stamp._replace(time=self._clock.start)
            if reason := self._unfit(message):
                self._leave_out(message.source, reason, 1, stamp)
                continue
            fault = faults.get(id(message), np.zeros(0, dtype=np.uint8))
            for code in np.unique(fault[fault != 0]).tolist():
                self._leave_out(message.source, FAULTS[code], int((fault == code).sum()), stamp)
            with self._guard(message.source, stamp):
                self._draw_one(message, fault == 0, stamp)
        if drawn:
            with self._guard("truth", drawn[-1][1]._replace(time=self.now)):
                for found in self._matcher.matched():
                    over = self._charts.errors(found, self.drawing.centres)
                    if over:
                        self._leave_out(found.centre, "too many targets", over, found.stamp)
        self.drawing.colour_sources()
        if self.crowded != self._charts.crowded:
            self.crowded = self.drawing.changed = True
        if self.assessed < self._charts.assessed:
            self.assessed = self.drawing.changed = True
        if self.supervised != self._sources.seen:
            self.supervised = self.drawing.changed = True

    def _is_due(self, message: Message, stamp: Stamp, ready: bool) -> bool:
        """Whether it can be drawn now; ready: the frame is known, and a mission time."""
        if stamp.time is None and isinstance(message, LocalTracks | LocalIntensity | Truth):
            return ready and self._clock.decided
        return ready or not _needs_chart(message)

    def _timely(self, items: list[tuple[Message, Stamp]]) -> list[tuple[Message, Stamp]]:
        """Those that are on the mission's timeline, at their time; the others are left out, and said."""
        found: list[tuple[Message, Stamp]] = []
        for message, stamp in items:
            if not isinstance(message, LocalTracks | LocalIntensity | Truth):
                found.append((message, stamp))
            elif (at := self._clock.judge(message) if stamp.time is None else stamp.time) is not None:
                found.append((message, stamp._replace(time=at)))
            else:
                self._leave_out(message.source, NOT_OURS, 1, stamp._replace(time=self.now))
        return found

    def _open_chart(self, patience: float) -> bool:
        """Whether the frame of the drawing, and a mission time, are known; takes the frame if it is time to."""
        waited = bool(self._new) and self._new[-1][1].received - self._new[0][1].received >= patience * 1e9
        if waited:
            self._clock.settle(message for message, _ in self._new)
        if self.drawing.chart is None and self._new:
            messages = [message for message, _ in self._new]
            best: list[Drawable] = [m for m in messages if isinstance(m, GlobalTracks) and len(m.ids)]
            if not best and waited:
                best = [m for m in messages if isinstance(m, LocalTracks | LocalIntensity | Truth)]
                best += [m for m in messages if isinstance(m, SensorInfo)]
            for message in best:
                try:
                    self.drawing.open_chart(message)
                    break
                except geodesy.FrameError as error:
                    ours = [item for item in self._new if item[0] is message]
                    self._new = [item for item in self._new if item[0] is not message]
                    self._leave_out(message.source, str(error), len(ours), ours[0][1])
        return self.drawing.chart is not None and self.now is not None

    def _unfit(self, message: Message) -> str:
        """Why a message as a whole is not drawn; empty if it is."""
        if isinstance(message, GlobalTracks | Status | StepLog | Truth):
            known = self._names[isinstance(message, Truth)]
            if message.source not in known and len(known) >= MAX_CENTRES:
                return f"more than {MAX_CENTRES} {'scenarios' if isinstance(message, Truth) else 'centres'}"
            known.add(message.source)
        if isinstance(message, LocalTracks | GlobalTracks | Truth) and len(message.ids) > MAX_TRACKS:
            return f"more than {MAX_TRACKS} tracks"
        new = isinstance(message, LocalTracks | LocalIntensity | SensorInfo)
        if new and message.source not in self.drawing.sources and len(self.drawing.sources) >= MAX_SOURCES:
            return f"more than {MAX_SOURCES} sources"
        return ""

    def _draw_one(self, message: Message, sound: NDArray[np.bool_], stamp: Stamp) -> None:
        drawing, charts, event_log = self.drawing, self._charts, self.event_log
        if isinstance(message, LocalTracks | LocalIntensity | SensorInfo):
            event_log.begin("source", message.source, message.epoch, stamp)
        elif isinstance(message, GlobalTracks | Status):
            event_log.begin("service", message.source, message.epoch, stamp)
        if isinstance(message, Status):
            for source in event_log.status(message, stamp):
                drawing.clear(source, stamp)
            if stamp.time is not None:
                self._sources.status(message, drawing.colours, stamp)
                self._traffic.status(message, drawing.colours, stamp)
        elif isinstance(message, StepLog):
            event_log.step(message, stamp)
        elif isinstance(message, SensorInfo):
            drawing.sensor(message, stamp)
        elif isinstance(message, Truth):
            if self._assessable(message, stamp):
                self._matcher.truth(message)
            drawing.truth(message, stamp)
        elif isinstance(message, GlobalTracks):
            event_log.tracks(message, stamp)
            whole = self._wholes.of(message)
            if whole is None:
                return
            if message.delta:
                message, sound = whole, check_numbers([whole])[0] == 0
            elif self._assessable(message, stamp):
                self._matcher.step(message, stamp)
            if drawing.chart is not None:
                self._too_many(message, "components", drawing.global_tracks(message, sound, stamp), stamp)
                self._traffic.step(message, drawing.chart, stamp)
            unseen = charts.step(message, drawing.colours, drawing.centres, drawing.label, stamp)
            self._too_many(message, "series of existence", unseen, stamp)
        else:
            if isinstance(message, LocalTracks):
                over = drawing.local_tracks(message, sound, stamp)
            else:
                over = drawing.intensity(message, sound, stamp)
            self._too_many(message, "components", over, stamp)
            charts.local(message, drawing.colours, stamp)
            self._traffic.heard(message, drawing.colours, stamp)

    def _too_many(self, message: Message, what: str, count: int, stamp: Stamp) -> None:
        if count:
            self._leave_out(message.source, f"too many {what}", count, stamp)

    def _assessable(self, message: GlobalTracks | Truth, stamp: Stamp) -> bool:
        few = len(message.ids) <= MAX_ASSESSED
        if not few:
            self._leave_out(message.source, f"more than {MAX_ASSESSED} tracks to assess", 1, stamp)
        return few

    @contextmanager
    def _guard(self, source: str, stamp: Stamp) -> Iterator[None]:
        """What cannot be drawn is counted; its bytes are on file already."""
        try:
            yield
        except geodesy.FrameError as error:
            self._leave_out(source, str(error), 1, stamp)
        except Exception as error:
            log.exception("cannot draw a message of %s", source)
            self._leave_out(source, type(error).__name__, 1, stamp)

    def _leave_out(self, source: str, reason: str, count: int, stamp: Stamp) -> None:
        """Count, and say so the first time for each source and reason."""
        if reason not in self.undrawn and len(self.undrawn) >= MAX_REASONS:
            reason = "other"
        self.undrawn[reason] += count
        if (source, reason) not in self._said and len(self._said) < MAX_SOURCES:
            self._said.add((source, reason))
            self.event_log.say("recorder", "WARN", f"{source}: {count} not drawn: {reason} (said once)", stamp)


def _needs_chart(message: Message) -> bool:
    return isinstance(message, Drawable) and not (isinstance(message, GlobalTracks) and not len(message.ids))
