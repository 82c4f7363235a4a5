"""The recorder as a process: what crosses the bus goes into a file until it is stopped."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fusion_service.bus.inbox import Inbox
from fusion_service.recording.parts import Rotation
from fusion_service.recording.recorder import Recorder
from schemas import REALM, Frame

if TYPE_CHECKING:
    from fusion_service.bus import Bus
    from fusion_service.recording.live import Live
    from fusion_service.recording.signing import Signer

__all__ = ["default_path", "run_recorder"]

log = logging.getLogger(__name__)

CAPACITY = 65536
SLOT = 4096
"""Slots between bus and recorder, and their bytes: 256 MiB in all."""
POLL = 0.1
"""Seconds after which a set `stop` is seen."""

Item = tuple[str, bytes | bool | int, int]
"""Key; bytes of a message, whether a token is there, or how many messages are lost; receive time, ns."""


def default_path(folder: str | Path = "runs", suffix: str = ".rrd") -> Path:
    """`mission-<UTC time>.rrd` in `folder`, numbered where that exists. suffix: empty for a folder of parts."""
    stem = datetime.now(UTC).strftime("mission-%Y%m%dT%H%M%SZ")
    path = Path(folder) / f"{stem}{suffix}"
    number = 2
    while path.exists():
        path = Path(folder) / f"{stem}-{number}{suffix}"
        number += 1
    return path


def run_recorder(
    bus: Bus,
    path: str | Path | None = None,
    *,
    realm: str = REALM,
    stop: threading.Event,
    frame: Frame | None = None,
    cutoff: float | None = None,
    every: float | None = None,
    trail: float = 300.0,
    draw: bool = True,
    rotation: Rotation | None = None,
    live: Live | None = None,
    signer: Signer | None = None,
    interval: float = 1.0,
    on_tick: Callable[[Recorder], None] | None = None,
) -> Recorder:
    """Record all that crosses `bus` under `realm` until `stop` is set, and close the file, and `live`. Returns the
    recorder.

    path: None for `default_path()`. interval: seconds between ticks; a recorder that is killed loses at most what
    came since the last. on_tick: called after each. The rest, and what is raised, as in `Recorder`; the file is made
    when the subscription stands.
    """
    inbox: Inbox[Item] = Inbox(CAPACITY, slot_bytes=SLOT)

    def put(key: str, said: bytes | bool | int) -> None:
        inbox.put(key, (key, said, time.time_ns()), len(said) if isinstance(said, bytes) else 0)

    declared = [
        bus.watch(f"{realm}/v1/*/*/alive", put),
        bus.subscribe(f"{realm}/v1/**", put, on_miss=put),
    ]
    try:
        path = path or default_path(suffix=".rrd" if rotation is None else "")
        how: dict[str, Any] = {"rotation": rotation, "live": live, "signer": signer, "every": every}
        with Recorder(path, realm=realm, frame=frame, cutoff=cutoff, trail=trail, draw=draw, **how) as recorder:
            log.info("recording %s/v1/** into %s", realm, path)
            dropped = _loop(inbox, recorder, stop, interval, on_tick or (lambda recorder: None))
            for declaration in declared:
                declaration.close()
            _take(inbox, recorder, 0.0)
            _note_dropped(inbox, recorder, dropped)
    finally:
        for declaration in declared:
            declaration.close()
        if live is not None:
            live.close()
    log.info("%s: %d messages, %d rows", path, recorder.messages, recorder.rows)
    return recorder


def _loop(
    inbox: Inbox[Item], recorder: Recorder, stop: threading.Event, interval: float, on_tick: Callable[[Recorder], None]
) -> Counter[str]:
    """Returns what the inbox had dropped, as far as it is noted."""
    due = time.monotonic() + interval
    dropped: Counter[str] = Counter()
    while not stop.is_set():
        _take(inbox, recorder, min(max(due - time.monotonic(), 0.0), POLL))
        if time.monotonic() < due:
            continue
        due = time.monotonic() + interval
        dropped = _note_dropped(inbox, recorder, dropped)
        recorder.tick()
        on_tick(recorder)
    return dropped


def _note_dropped(inbox: Inbox[Item], recorder: Recorder, before: Counter[str]) -> Counter[str]:
    """Note what the inbox has dropped since it had dropped `before`."""
    dropped = Counter(inbox.dropped)
    for key, count in (dropped - before).items():
        recorder.lost(key, count, time.time_ns())
    return dropped


def _take(inbox: Inbox[Item], recorder: Recorder, timeout: float) -> None:
    for _, (key, said, received) in inbox.take(timeout):
        if recorder.heavy:
            recorder.tick()
        if isinstance(said, bytes):
            recorder.handle(key, said, received)
        elif isinstance(said, bool):
            recorder.alive(key, said, received)
        else:
            recorder.lost(key, said, received)
