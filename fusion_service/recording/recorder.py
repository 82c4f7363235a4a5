"""The recorder: every message as it came, and the picture that it makes, in one Rerun file.

    /raw/{local|global|truth}/...     each message: its key and its bytes, on `arrival`, `received` and,
                                      where it has one, `time`

and the entities of `drawing`, `charts` and `journal`. What came is queued by `handle` and written by `tick`,
the raw bytes first; after `tick` has returned it is in the hands of the operating system, and a recorder that
is killed leaves a file that opens. No message can stop the recorder: what does not decode, or cannot be
drawn, is kept raw, counted and logged.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fusion_service import geodesy
from fusion_service.inbox import Inbox
from fusion_service.recording.assessment import Assessment
from fusion_service.recording.blueprint import blueprint
from fusion_service.recording.charts import Charts
from fusion_service.recording.columns import Columns, Stamp, entity, import_rerun, raw
from fusion_service.recording.drawing import Drawing
from fusion_service.recording.journal import Journal
from schemas import (
    FAULTS,
    REALM,
    Frame,
    GlobalTracks,
    LocalIntensity,
    LocalTracks,
    Message,
    MessageError,
    SensorInfo,
    Status,
    StepLog,
    Truth,
    check_numbers,
    check_realm,
    decode,
    parse_key,
)

if TYPE_CHECKING:
    from fusion_service.bus import Bus

__all__ = ["Recorder", "default_path", "run_recorder"]

log = logging.getLogger(__name__)

APPLICATION = "track-fusion-centre"
CAPACITY = 65536
"""Slots between bus and recorder, 64 kB each."""
PATIENCE = 5.0
"""Seconds for which the drawing waits for global tracks, to take their frame."""
DRAWN_EVERY = 10.0
MANY = 20_000
"""Seconds, or rows, between writes of what was drawn: each costs a chunk for each entity, for which Rerun keeps some
400 B in memory until the file is closed. A killed recorder loses so much of the picture, nothing of the messages."""
AHEAD = 3600 * 10**9
"""Nanoseconds by which a message may be ahead of the newest global one and still be on the mission's timeline."""
FLUSH = 2.0
POLL = 0.1
"""Seconds after which a set `stop` is seen."""

Item = tuple[str, bytes | bool | int, int]
"""Key; bytes of a message, whether a token is there, or how many messages are lost; receive time, ns."""
Drawable = LocalTracks | LocalIntensity | GlobalTracks | SensorInfo | Truth


def default_path(folder: str | Path = "runs") -> Path:
    """`mission-<UTC time>.rrd` in `folder`, numbered where that exists."""
    stem = datetime.now(UTC).strftime("mission-%Y%m%dT%H%M%SZ")
    path = Path(folder) / f"{stem}.rrd"
    number = 2
    while path.exists():
        path = Path(folder) / f"{stem}-{number}.rrd"
        number += 1
    return path


class Recorder:
    """Writes one recording. All methods are for one thread; a context manager that closes.

    path: a new file; `FileExistsError` if there is one, `OSError` if it cannot be made. frame: draw in this
    frame; None takes that of the first global tracks, or of the first other message if none come in the first
    seconds. cutoff: of the assignment of tracks to true objects, m; None chooses one for each step. trail:
    seconds of each trail that are seen at first. draw: False records the messages alone.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        realm: str = REALM,
        frame: Frame | None = None,
        cutoff: float | None = None,
        trail: float = 300.0,
        draw: bool = True,
    ) -> None:
        rr = import_rerun()
        self.path = Path(path)
        self.messages = 0
        self.bytes = 0
        self.undecodable: Counter[str] = Counter()
        self.undrawn: Counter[str] = Counter()
        self._prefix = f"{check_realm(realm)}/v1/"
        self._trail = trail
        self._draw = draw
        self._new: list[tuple[Message, Stamp]] = []
        self._held: list[tuple[Message, Stamp]] = []
        self._bad: Counter[tuple[str, str]] = Counter()
        self._said: set[tuple[str, str]] = set()
        self._patience = PATIENCE
        self._now: int | None = None
        self._by_centre = False
        self._drawn_last = -DRAWN_EVERY
        self._closed = False

        self.path.parent.mkdir(parents=True, exist_ok=True)
        try:
            self.path.open("xb").close()
        except FileExistsError:
            raise FileExistsError(f"{self.path} exists already: name another file, or move it away") from None
        self._stream = rr.RecordingStream(APPLICATION, send_properties=True)
        self._stream.set_sinks(rr.FileSink(str(self.path)))
        self._stream.send_recording_name(self.path.stem)
        self._raw = Columns(self._stream)
        self._columns = Columns(self._stream)
        self._drawing = Drawing(self._columns, frame)
        self._charts = Charts(self._columns)
        self._journal = Journal(self._columns, self._drawing)
        self._assessment = Assessment(cutoff)
        self.tick()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def rows(self) -> int:
        """Rows written until now, of messages and drawing."""
        return self._raw.sent + self._columns.sent

    def handle(self, key: str, data: bytes, received: int) -> None:
        """Queue one message for the next `tick`; `received`: when it came, ns UTC."""
        message: Message | None = None
        try:
            message = decode(data)
        except MessageError as error:
            self.undecodable[error.reason] += 1
            self._bad[key, error.reason] += 1
        at = self._mission_time(message)
        path = entity("raw", *key.removeprefix(self._prefix).split("/"))
        self._raw.add(path, raw, Stamp(received, at, self.messages), (key, data))
        self.messages += 1
        self.bytes += len(data)
        if message is not None and self._draw:
            self._new.append((message, Stamp(received, at)))

    def alive(self, key: str, alive: bool, received: int) -> None:
        """Note that a liveliness token came or went."""
        try:
            name = parse_key(key)
        except ValueError:
            return
        stamp = Stamp(received, self._now)
        self._journal.alive(name.scope, name.name, alive, stamp)
        if not alive and name.scope == "local" and self._now is not None:
            self._drawing.clear(name.name, stamp)

    def lost(self, key: str, count: int, received: int) -> None:
        """Note that `count` messages on `key` were lost on their way here."""
        self._journal.say("recorder", "WARN", f"{count} messages on {key} were lost", Stamp(received, self._now))

    def tick(self) -> None:
        """Hand what came since the last tick to the operating system, and every few seconds what was drawn."""
        self._write(DRAWN_EVERY)
        self._stream.flush(timeout_sec=FLUSH)

    def close(self) -> None:
        """Write what waits and the index of the file. A second call does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            self._patience = 0.0
            self._write(0.0)
            for reason, count in sorted(self.undrawn.items()):
                text = f"{count} tracks or messages were not drawn: {reason}"
                self._journal.say("recorder", "WARN", text, Stamp(time.time_ns(), self._now))
            self._journal.release(self._now)
            self._columns.send()
        finally:
            self._stream.disconnect()

    def _write(self, interval: float) -> None:
        self._raw.send()
        if not self._draw:
            return
        for (key, reason), count in self._bad.items():
            text = f"{count} messages on {key} do not decode: {reason}"
            self._journal.say("recorder", "WARN", text, Stamp(time.time_ns(), self._now))
        self._bad.clear()
        self._draw_new()
        if time.monotonic() - self._drawn_last < interval and self._columns.waiting < MANY:
            return
        self._drawn_last = time.monotonic()
        self._columns.send()
        drawing = self._drawing
        if drawing.changed:
            drawing.changed = False
            frame = drawing.chart.frame if drawing.chart else None
            self._stream.send_blueprint(blueprint(frame, drawing.bounds, drawing.trails, self._trail))

    def _mission_time(self, message: Message | None) -> int | None:
        """The time of `message` on the mission's timeline, None where it has none or is impossibly far ahead. That of
        a status is the service's own until its first step, which may be years from a mission played back."""
        at: int | None = getattr(message, "time", None)
        if at is None or isinstance(message, Status):
            return None
        from_centre = isinstance(message, GlobalTracks | StepLog)
        if self._by_centre and not from_centre and self._now is not None and at > self._now + AHEAD:
            return None
        if from_centre or not self._by_centre:
            self._by_centre = from_centre
            self._now = at if self._now is None or from_centre else max(self._now, at)
        return at

    def _draw_new(self) -> None:
        held, self._new = self._held + self._new, []
        ready = self._open_chart(held)
        drawn = [item for item in held if ready or not _needs_chart(item[0])]
        self._held = [item for item in held if not ready and _needs_chart(item[0])]
        tracks = [message for message, _ in drawn if isinstance(message, LocalTracks | LocalIntensity | GlobalTracks)]
        faults = dict(zip(map(id, tracks), check_numbers(tracks), strict=True))
        for message, stamp in drawn:
            if stamp.time is None:
                stamp = stamp._replace(time=self._now)
                if isinstance(message, LocalTracks | LocalIntensity | Truth):
                    self._not_drawn(message.source, "its time is far ahead", 1, stamp)
                    continue
            fault = faults.get(id(message), np.zeros(0, dtype=np.uint8))
            for code in np.unique(fault[fault != 0]).tolist():
                self._not_drawn(message.source, FAULTS[code], int((fault == code).sum()), stamp)
            with self._guard(message.source, stamp):
                self._draw_one(message, fault == 0, stamp)
        if drawn:
            with self._guard("truth", drawn[-1][1]):
                for score in self._assessment.scores():
                    self._charts.score(score)

    def _open_chart(self, held: Sequence[tuple[Message, Stamp]]) -> bool:
        """Whether the frame of the drawing, and a mission time, are known; takes the frame if it is time to."""
        if self._drawing.chart is None and held:
            messages = [message for message, _ in held]
            best: list[Drawable] = [m for m in messages if isinstance(m, GlobalTracks) and len(m.ids)]
            if not best and held[-1][1].received - held[0][1].received >= self._patience * 1e9:
                best = [m for m in messages if isinstance(m, LocalTracks | LocalIntensity | Truth)]
                best += [m for m in messages if isinstance(m, SensorInfo)]
            if best:
                self._drawing.open_chart(best[0])
        return self._drawing.chart is not None and self._now is not None

    def _draw_one(self, message: Message, sound: NDArray[np.bool_], stamp: Stamp) -> None:
        drawing, charts, journal = self._drawing, self._charts, self._journal
        if isinstance(message, LocalTracks | LocalIntensity | SensorInfo):
            journal.begin("source", message.source, message.epoch, stamp)
        elif isinstance(message, GlobalTracks | Status):
            journal.begin("service", message.source, message.epoch, stamp)
        if isinstance(message, Status):
            for source in journal.status(message, stamp):
                drawing.clear(source, stamp)
        elif isinstance(message, StepLog):
            journal.step(message, stamp)
        elif isinstance(message, SensorInfo):
            drawing.sensor(message, stamp)
        elif isinstance(message, Truth):
            self._assessment.truth(message)
            drawing.truth(message, stamp)
        elif isinstance(message, GlobalTracks):
            journal.tracks(message, stamp)
            self._assessment.step(message, stamp)
            if drawing.chart is not None:
                drawing.global_tracks(message, sound, stamp)
            charts.step(message, drawing.colours(), stamp)
        else:
            drawing.local_tracks(message, sound, stamp)
            charts.local(message, drawing.colours(), stamp)

    @contextmanager
    def _guard(self, source: str, stamp: Stamp) -> Iterator[None]:
        """What cannot be drawn is counted; its bytes are on file already."""
        try:
            yield
        except geodesy.FrameError as error:
            self._not_drawn(source, str(error), 1, stamp)
        except Exception as error:
            log.exception("cannot draw a message of %s", source)
            self._not_drawn(source, type(error).__name__, 1, stamp)

    def _not_drawn(self, source: str, reason: str, count: int, stamp: Stamp) -> None:
        """Count, and say so the first time for each source and reason."""
        self.undrawn[reason] += count
        if (source, reason) not in self._said:
            self._said.add((source, reason))
            self._journal.say("recorder", "WARN", f"{source}: {count} not drawn: {reason} (said once)", stamp)


def _needs_chart(message: Message) -> bool:
    return isinstance(message, Drawable) and not (isinstance(message, GlobalTracks) and not len(message.ids))


def run_recorder(
    bus: Bus,
    path: str | Path | None = None,
    *,
    realm: str = REALM,
    stop: threading.Event,
    frame: Frame | None = None,
    cutoff: float | None = None,
    trail: float = 300.0,
    draw: bool = True,
    interval: float = 1.0,
    on_tick: Callable[[Recorder], None] | None = None,
) -> Recorder:
    """Record all that crosses `bus` under `realm` until `stop` is set, and close the file. Returns the recorder.

    path: None for `default_path()`. interval: seconds between ticks; a recorder that is killed loses at most what
    came since the last. on_tick: called after each. The rest, and what is raised, as in `Recorder`; the file is made
    when the subscription stands.
    """
    inbox: Inbox[Item] = Inbox(CAPACITY)

    def put(key: str, said: bytes | bool | int) -> None:
        inbox.put(key, (key, said, time.time_ns()), len(said) if isinstance(said, bytes) else 0)

    declared = [
        bus.watch(f"{realm}/v1/*/*/alive", put),
        bus.subscribe(f"{realm}/v1/**", put, on_miss=put),
    ]
    try:
        path = path or default_path()
        with Recorder(path, realm=realm, frame=frame, cutoff=cutoff, trail=trail, draw=draw) as recorder:
            log.info("recording %s/v1/** into %s", realm, path)
            _loop(inbox, recorder, stop, interval, on_tick or (lambda recorder: None))
            for declaration in declared:
                declaration.close()
            _take(inbox, recorder, 0.0)
    finally:
        for declaration in declared:
            declaration.close()
    log.info("%s: %d messages, %d rows", path, recorder.messages, recorder.rows)
    return recorder


def _loop(
    inbox: Inbox[Item], recorder: Recorder, stop: threading.Event, interval: float, on_tick: Callable[[Recorder], None]
) -> None:
    due = time.monotonic() + interval
    dropped: Counter[str] = Counter()
    while not stop.is_set():
        _take(inbox, recorder, min(max(due - time.monotonic(), 0.0), POLL))
        if time.monotonic() < due:
            continue
        due = time.monotonic() + interval
        before, dropped = dropped, Counter(inbox.dropped)
        for key, count in (dropped - before).items():
            recorder.lost(key, count, time.time_ns())
        recorder.tick()
        on_tick(recorder)


def _take(inbox: Inbox[Item], recorder: Recorder, timeout: float) -> None:
    for _, (key, said, received) in inbox.take(timeout):
        if isinstance(said, bytes):
            recorder.handle(key, said, received)
        elif isinstance(said, bool):
            recorder.alive(key, said, received)
        else:
            recorder.lost(key, said, received)
