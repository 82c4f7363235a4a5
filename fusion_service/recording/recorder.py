"""The recorder: every message as it came, and the picture that it makes, in one Rerun file.

    /raw/{local|global|truth}/...     each message: its key and its bytes, on `arrival`, `received` and,
                                      where it has one, `time`

and the entities of `drawing`, `charts` and `journal`. What came is queued by `handle` and written by `tick`,
the raw bytes first; after `tick` has returned it is in the hands of the operating system, and a recorder that
is killed leaves a file that opens. No message can stop the recorder: what does not decode, or cannot be
drawn, is kept raw, counted and logged.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections import Counter
from pathlib import Path
from types import TracebackType

from fusion_service.recording.blueprint import blueprint
from fusion_service.recording.columns import Columns, Stamp, entity, import_rerun, raw
from fusion_service.recording.scene import PATIENCE, Scene
from schemas import REALM, Frame, Message, MessageError, check_realm, decode, parse_key

__all__ = ["Recorder"]

APPLICATION = "track-fusion-centre"
DRAWN_EVERY = 10.0
MANY = 20_000
"""Seconds, or rows, between writes of what was drawn: each costs a chunk for each entity, for which Rerun keeps some
400 B in memory until the file is closed. A killed recorder loses so much of the picture, nothing of the messages."""
FLUSH = 10.0
"""Seconds that the disk may take before it counts as broken."""
RESERVE = 64 * 2**20
"""Bytes left on the disk at which a recording ends, while its index can still be written."""
LINES = 20
"""Lines of the log about undecodable messages per tick, the most frequent first."""


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
        self._prefix = f"{check_realm(realm)}/v1/"
        self._trail = trail
        self._draw = draw
        self._bad: Counter[tuple[str, str]] = Counter()
        self._drawn_last = -DRAWN_EVERY
        self._closed = False
        self._broken = False

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
        self._scene = Scene(self._columns, frame, cutoff)
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

    @property
    def undrawn(self) -> Counter[str]:
        """Tracks or messages that were recorded but not drawn, by reason."""
        return self._scene.undrawn

    def handle(self, key: str, data: bytes, received: int) -> None:
        """Queue one message for the next `tick`; `received`: when it came, ns UTC."""
        message: Message | None = None
        try:
            message = decode(data)
        except MessageError as error:
            self.undecodable[error.reason] += 1
            self._bad[key, error.reason] += 1
        at = self._scene.mission_time(message)
        path = entity("raw", *key.removeprefix(self._prefix).split("/"))
        self._raw.add(path, raw, Stamp(received, at, self.messages), (key, data))
        self.messages += 1
        self.bytes += len(data)
        if message is not None and self._draw:
            self._scene.add(message, Stamp(received, at))

    def alive(self, key: str, alive: bool, received: int) -> None:
        """Note that a liveliness token came or went."""
        try:
            name = parse_key(key)
        except ValueError:
            return
        self._scene.alive(name.scope, name.name, alive, Stamp(received, self._scene.now))

    def lost(self, key: str, count: int, received: int) -> None:
        """Note that `count` messages on `key` were lost on their way here."""
        self._say(f"{count} messages on {key} were lost", received)

    def tick(self) -> None:
        """Hand what came since the last tick to the operating system, and every few seconds what was drawn.
        `OSError` if that cannot be written, or the disk is all but full."""
        self._write(DRAWN_EVERY)
        try:
            self._stream.flush(timeout_sec=FLUSH)
        except RuntimeError as error:
            self._broken = True
            raise OSError(f"cannot write to {self.path} any more ({error}): what it holds can be read") from None
        if (free := shutil.disk_usage(self.path.parent).free) < RESERVE:
            raise OSError(f"the disk of {self.path} is full but for {free >> 20} MiB: the recording ends here")

    def close(self) -> None:
        """Write what waits and the index of the file. A second call does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            self._write(0.0, patience=0.0)
            for reason, count in sorted(self.undrawn.items()):
                self._say(f"{count} tracks or messages were not drawn: {reason}", time.time_ns())
            self._scene.journal.release(self._scene.now)
            self._columns.send()
        finally:
            self._disconnect()

    def _disconnect(self) -> None:
        """Write the index. A stream whose writer has died waits for it for ever, here or when it is deleted or the
        process ends: a thread that sleeps keeps it from being deleted."""
        if not self._broken:
            self._stream.disconnect()
            return
        import_rerun().unregister_shutdown()
        threading.Thread(target=lambda _: threading.Event().wait(), args=(self._stream,), daemon=True).start()

    def _say(self, text: str, received: int) -> None:
        self._scene.journal.say("recorder", "WARN", text, Stamp(received, self._scene.now))

    def _write(self, interval: float, patience: float = PATIENCE) -> None:
        self._raw.send()
        for (key, reason), count in self._bad.most_common(LINES):
            self._say(f"{count} messages on {key} do not decode: {reason}", time.time_ns())
        self._bad.clear()
        self._scene.draw(patience)
        if time.monotonic() - self._drawn_last < interval and self._columns.waiting < MANY:
            return
        self._drawn_last = time.monotonic()
        self._columns.send()
        drawing = self._scene.drawing
        if self._draw and drawing.changed:
            drawing.changed = False
            frame = drawing.chart.frame if drawing.chart else None
            self._stream.send_blueprint(blueprint(frame, drawing.bounds, drawing.trails, self._trail))
