"""The recorder: every message as it came, and the picture that it makes, in Rerun files.

    /raw/{local|global|truth}/...     each message: its key and its bytes, on `arrival`, `received` and,
                                      where it has one, `time`
    /raw/standing/...                 in a part that goes on from another: the newest info of every source again
    /seal/...                         a chain of hashes over all these, signed where there is a key (`chain`)

and the entities of `drawing`, `charts` and `event_log`. What came is queued by `handle` and written by `tick`,
the raw bytes first; after `tick` has returned it is in the hands of the operating system, and a recorder that
is killed leaves a file that opens. No message can stop the recorder: what does not decode, or cannot be
drawn, is kept raw, counted and logged.

A recording is one file, or a folder of parts (`parts`). A part begins with all that is static, the picture as it
stands and the infos, so that it can be read by itself; arrival numbers begin anew in it. What Rerun remembers of a
file, and the series of the charts, end with a part: a recording of weeks takes the memory of its largest part.
"""

from __future__ import annotations

import logging
import shutil
import threading
import time
import uuid
from collections import Counter
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO

from fusion_service.errors import ReviewError
from fusion_service.recording.columns import ColumnWriter, Stamp, entity, import_rerun, raw
from fusion_service.recording.drawing.blueprint import blueprint, track_blueprint
from fusion_service.recording.drawing.scene import MAX_SOURCES, PATIENCE, Scene
from fusion_service.recording.parts import Folder, Rotation, begin, is_folder, number_of, parts
from fusion_service.recording.reader import recording_id
from fusion_service.recording.repair import mend
from fusion_service.recording.scoring import Scoring, write_scoring
from fusion_service.recording.sealing import Sealer, last_link
from schemas import REALM, Frame, Message, MessageError, SensorInfo, check_realm, decode, parse_key

if TYPE_CHECKING:
    from fusion_service.recording.live import Live
    from fusion_service.recording.signing import Signer

__all__ = ["Recorder"]

log = logging.getLogger(__name__)

APPLICATION = "track-fusion-centre"
DRAWN_EVERY = 10.0
MANY = 20_000
HEAVY = 32 * 2**20
"""Seconds, or rows, or bytes between writes of what was drawn: each costs a chunk for each entity, for which Rerun
keeps some 4 kB in memory until the file is closed. A killed recorder loses so much of the picture, nothing of the
messages."""
FLUSH = 10.0
"""Seconds that the disk may take before it counts as broken."""
RESERVE = 64 * 2**20
"""Bytes left on the disk at which a recording ends, while its index can still be written."""
TENDED_EVERY = 5.0
"""Seconds between looks at which old parts may go."""
LINES = 20
"""Lines of the log about undecodable messages per tick, the most frequent first."""


class Recorder:
    """Writes one recording. All methods are for one thread; a context manager that closes.

    path: a new file, `FileExistsError` if there is one; or a folder of parts: one that exists (or a name that ends
    with /), or any name with `rotation`; parts that are there stay, and are gone on from. `OSError` if it cannot be
    made. frame: draw in this frame; None takes that of the first global tracks, or of the first other message if none
    come in the first seconds. cutoff: of the assignment of tracks to true objects, m; None chooses one for each step.
    every: s between scored times. Both are kept in the recording, for `evaluate`.
    trail: seconds of each trail that are seen at first. draw: False records the messages alone. focus: the id of a
    global track; the recording opens on this one alone, with its series. live: shown the same picture; closed with
    the recorder. signer: signs the chain of hashes.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        realm: str = REALM,
        frame: Frame | None = None,
        cutoff: float | None = None,
        every: float | None = None,
        trail: float = 300.0,
        draw: bool = True,
        rotation: Rotation | None = None,
        focus: int | None = None,
        live: Live | None = None,
        signer: Signer | None = None,
    ) -> None:
        import_rerun()
        self.path = Path(path)
        """The file, or the part, that is being written."""
        self.messages = self.bytes = 0
        self.undecodable: Counter[str] = Counter()
        self.missing = 0
        self._scoring = Scoring(cutoff, every)
        self._prefix = f"{check_realm(realm)}/v1/"
        self._trail = trail
        self._draw = draw
        self._focus = focus
        self._live = live
        self._ticked = 0
        self._bad: Counter[tuple[str, str]] = Counter()
        self._infos: dict[str, tuple[int, int, str, bytes, int]] = {}
        self._arrival = self._repeated = 0
        self._written = 0
        self._drawn_last = self._tended = -DRAWN_EVERY
        self._closed = False
        self._broken = False
        self._stream: Any = None
        self._writing: BinaryIO | None = None
        self._sealer = Sealer(signer, keeps=rotation is not None and rotation.keeps)

        self._folder: Folder | None = None
        begins = "start"
        self._id = uuid.uuid4().hex
        if rotation is not None or is_folder(path):
            if self.path.is_file():
                raise FileExistsError(f"{self.path} is a file: name a folder for the parts")
            self._folder = Folder(self.path, rotation or Rotation())
        try:
            if self._folder is not None:
                begins = self._resume(self._folder)
                self.path = self._folder.next()
            self._open(begins)
            self._raw = ColumnWriter(self._stream)
            self._columns = ColumnWriter(self._stream, live)
            self._scene = Scene(self._columns, frame, cutoff, focus)
            if begins == "resume":
                self._say(f"recording goes on in part {self.path.name}: it was not running before", time.time_ns())
            self.tick()
        except BaseException:
            self._release()
            raise

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def rows(self) -> int:
        """Rows written until now, of messages and drawing."""
        return self._written + self._raw.sent + self._columns.sent

    @property
    def undrawn(self) -> Counter[str]:
        """Tracks or messages that were recorded but not drawn, by reason."""
        return self._scene.undrawn

    @property
    def heavy(self) -> bool:
        """Whether so many bytes wait for a tick that one should be made before the next message."""
        return self.bytes - self._ticked >= HEAVY

    def handle(self, key: str, data: bytes, received: int) -> None:
        """Queue one message for the next `tick`; `received`: when it came, ns UTC."""
        message: Message | None = None
        try:
            message = decode(data)
        except MessageError as error:
            self.undecodable[error.reason] += 1
            self._bad[key, error.reason] += 1
        at = self._scene.mission_time(message, received)
        path = entity("raw", *key.removeprefix(self._prefix).split("/"))
        self._raw.add(path, raw, Stamp(received, at, self._arrival), (key, data))
        self._sealer.add(key, data, received)
        self._arrival += 1
        self.messages += 1
        self.bytes += len(data)
        if self._folder is not None and isinstance(message, SensorInfo):
            self._keep(message, key, data, received)
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
        self.missing += count
        self._say(f"{count} messages on {key} were lost", received)

    def next_part(self) -> bool:
        """Begin the next part at the next `tick` with a message in this one; whether the recording is in parts. On any
        thread."""
        if self._folder is not None:
            self._folder.ask()
        return self._folder is not None

    def tick(self) -> None:
        """Hand what came since the last tick to the operating system, and every few seconds what was drawn; end a
        part that is full. `OSError` if that cannot be written, or the disk is all but full."""
        self._ticked = self.bytes
        self._write(DRAWN_EVERY)
        self._flush()
        if self._live is not None:
            self._live.push()
        if self._folder is not None:
            if time.monotonic() - self._tended >= TENDED_EVERY:
                self._tended = time.monotonic()
                self._folder.retain(self.path)
            if self._arrival > self._repeated and self._folder.full(self.path):
                self._rotate(self._folder)
        while (free := shutil.disk_usage(self.path.parent).free) < RESERVE:
            if self._folder is None or not self._folder.make_room(self.path):
                raise OSError(f"the disk of {self.path} is full but for {free >> 20} MiB: the recording ends here")

    def close(self) -> None:
        """Write what waits and the index of the file. A second call does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            if self._stream is not None:
                self._write(0.0, patience=0.0)
                for reason, count in sorted(self.undrawn.items()):
                    self._say(f"{count} tracks or messages were not drawn: {reason}", time.time_ns())
                self._scene.event_log.release(self._scene.now)
                self._columns.send()
                self._sealer.seal("recording")
                if self._live is not None:
                    self._live.push()
        finally:
            self._release()

    def _release(self) -> None:
        self._closed = True
        try:
            self._disconnect()
        finally:
            if self._folder is not None:
                self._folder.close()
            if self._live is not None:
                self._live.close()

    def _resume(self, folder: Folder) -> str:
        """How a recording in `folder` begins. The last part there is made whole, and its recording goes on."""
        there = parts(folder.path)
        for path in reversed(there):
            try:
                done = mend(path, index=False)
                self._id = recording_id(path)
                self._sealer.follow(last_link(there))
            except (ReviewError, OSError) as error:
                log.warning("%s is left as it is: %s", path, error)
                continue
            if done.cut:
                log.warning("%s: %s", path, done)
            break
        return "resume" if there else "start"

    def _open(self, begins: str) -> None:
        """Begin a file at `self.path`. begins: "start", "resume" after a recorder that ended, "rotation"."""
        rr = import_rerun()
        self._writing = begin(self.path)
        stream = rr.RecordingStream(APPLICATION, recording_id=self._id, send_properties=True)
        stream.set_sinks(rr.FileSink(str(self.path)))
        stream.send_recording_name(self.path.stem if self._folder is None else self.path.parent.name)
        part = (number_of(self.path) or 0) if self._folder is not None else 0
        stream.send_property("part", rr.AnyValues(number=number_of(self.path) or 0, begins=begins))
        write_scoring(stream, self._scoring)
        self._stream = stream
        self._sealer.begin(stream, self._id, part)

    def _rotate(self, folder: Folder) -> None:
        """End the part and begin the next. What comes meanwhile waits before `handle`."""
        began = time.monotonic()
        self._write(0.0)
        self._sealer.seal("part")
        self._flush()
        self._disconnect()
        self._stream, before = None, self.path
        self.path = folder.next()
        self._open("rotation")
        self._written += self._raw.sent
        self._raw = ColumnWriter(self._stream)
        self._arrival = 0
        now = Stamp(time.time_ns(), self._scene.now)
        for _, _, key, data, received in self._infos.values():
            path = entity("raw", "standing", *key.removeprefix(self._prefix).split("/"))
            self._raw.add(path, raw, Stamp(received, None, self._arrival), (key, data))
            self._sealer.add(key, data, received, standing=True)
            self._arrival += 1
        self._repeated = self._arrival
        self._scene.restart()
        self._columns.restart(self._stream, now)
        self._say(f"part {self.path.name} goes on from {before.name}", now.received, "INFO")
        self._write(0.0)
        self._flush()
        folder.retain(self.path)
        log.info("%s goes on from %s (%.2f s)", self.path, before.name, time.monotonic() - began)

    def _keep(self, info: SensorInfo, key: str, data: bytes, received: int) -> None:
        known = self._infos.get(info.source)
        if known is None and len(self._infos) >= MAX_SOURCES:
            return
        if known is None or (info.epoch, info.seq) >= known[:2]:
            self._infos[info.source] = info.epoch, info.seq, key, data, received

    def _flush(self) -> None:
        try:
            self._stream.flush(timeout_sec=FLUSH)
        except RuntimeError as error:
            self._broken = True
            raise OSError(f"cannot write to {self.path} any more ({error}): what it holds can be read") from None

    def _disconnect(self) -> None:
        """Write the index. A stream whose writer has died waits for it for ever, here or when it is deleted or the
        process ends: a thread that sleeps keeps it from being deleted."""
        try:
            if self._stream is not None and not self._broken:
                self._stream.disconnect()
            elif self._stream is not None:
                import_rerun().unregister_shutdown()
                threading.Thread(target=lambda _: threading.Event().wait(), args=(self._stream,), daemon=True).start()
        finally:
            if self._writing is not None:
                self._writing.close()

    def _say(self, text: str, received: int, level: str = "WARN") -> None:
        self._scene.event_log.say("recorder", level, text, Stamp(received, self._scene.now))

    def _write(self, interval: float, patience: float = PATIENCE) -> None:
        self._raw.send()
        self._sealer.seal()
        for (key, reason), count in self._bad.most_common(LINES):
            self._say(f"{count} messages on {key} do not decode: {reason}", time.time_ns())
        self._bad.clear()
        self._scene.draw(patience)
        few = self._columns.waiting < MANY and self._columns.bytes_waiting < HEAVY
        if few and time.monotonic() - self._drawn_last < interval:
            return
        self._drawn_last = time.monotonic()
        self._columns.send()
        drawing = self._scene.drawing
        if self._draw and drawing.changed:
            drawing.changed = False
            shown = self._blueprint()
            self._stream.send_blueprint(shown)
            if self._live is not None:
                self._live.blueprint(shown)

    def _blueprint(self) -> Any:
        drawing = self._scene.drawing
        frame = drawing.chart.frame if drawing.chart else None
        seen: dict[str, Any] = {"trails": drawing.trails, "trail": self._trail, "centres": sorted(drawing.centres)}
        if self._focus is None:
            scene = self._scene
            seen |= {"crowded": scene.crowded, "supervised": scene.supervised, "assessed": scene.assessed}
            return blueprint(frame, drawing.bounds, **seen)
        return track_blueprint(frame, drawing.bounds, drawing.label(self._focus), reach=drawing.reach, **seen)
