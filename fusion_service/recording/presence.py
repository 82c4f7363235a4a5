"""That a recorder is there, and what it keeps: for `status` and `top`, and whoever else looks.

A liveliness token on `{realm}/v1/record/{name}/alive`, and on `.../state` an answer in JSON, as it was after the last
write. Nobody is told anything unasked.
"""

from __future__ import annotations

import json
import logging
import re
import shutil
import socket
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fusion_service.errors import FusionError
from fusion_service.recording.parts import is_folder, parts
from schemas import REALM, record_key

if TYPE_CHECKING:
    from fusion_service.bus import Bus
    from fusion_service.recording.recorder import Recorder

__all__ = ["Presence", "host_name"]

log = logging.getLogger(__name__)


def host_name() -> str:
    """The name of this computer, as far as it can stand in a key."""
    plain = re.sub(r"[^A-Za-z0-9_.:-]", "-", socket.gethostname())[:64].lstrip("_.:-")
    return plain or "recorder"


class Presence:
    """Of the recorder `name`, which records into `path`, on an open bus. `note` is called after each write; with the
    first of them the token is there."""

    def __init__(self, bus: Bus, name: str, path: Path, realm: str = REALM) -> None:
        self._bus = bus
        self._keys = [record_key(name, what, realm) for what in ("alive", "state")]
        self._path = path
        self._said: dict[str, Any] = {
            "file": str(path.absolute()),
            "host": socket.gethostname(),
            "since": time.time_ns(),
        }
        self._written = time.monotonic()
        self._declared = False

    def answer(self) -> bytes:
        """What is kept, and for how many seconds nothing was written."""
        return json.dumps({**self._said, "silent": round(time.monotonic() - self._written, 3)}).encode()

    def note(self, recorder: Recorder) -> None:
        """What was written is on its way to the disk."""
        told: dict[str, Any] = {}
        try:
            files = parts(self._path) if is_folder(self._path) else [self._path]
            told = {"bytes": sum(file.stat().st_size for file in files), "parts": len(files)}
            told["free"] = shutil.disk_usage(self._path.absolute().parent).free
        except OSError:
            log.debug("%s cannot be looked at", self._path, exc_info=True)
        self._said = {
            **self._said,
            **told,
            "messages": recorder.messages,
            "undecodable": sum(recorder.undecodable.values()),
            "lost": recorder.missing,
        }
        self._written = time.monotonic()
        if not self._declared:
            self._declared = True
            try:
                self._bus.announce(self._keys[0])
                self._bus.answer(self._keys[1], lambda _: self.answer())
            except FusionError as error:  # an older hub does not let it; it records all the same
                log.warning("nobody can see that this recorder is there: %s", error)
