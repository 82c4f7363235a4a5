"""The recording of a replay: the mission's messages as they came, and beside them what each variant publishes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

from fusion_service.centre import StepResult
from fusion_service.recording import RawMessage, Recorder
from fusion_service.recording.parts import unused
from fusion_service.recording.scoring import Scoring
from fusion_service.recording.survey import key_of
from fusion_service.review.replay.verifying import published_as
from schemas import Message, encode, global_key

__all__ = ["ReplayWriter"]

TICK_MESSAGES, TICK_BYTES = 2000, 8 * 2**20
"""What is written at once."""
STATUS_PERIOD = 10**9
"""Nanoseconds of the mission between two statuses of a variant."""
UNSAID = Scoring()


class ReplayWriter:
    """Writes one new recording; a context manager that closes it. Arguments as of `Recorder`; keep_recorded: with what
    the mission's own centres published; scoring: that of the mission."""

    def __init__(
        self,
        path: str | Path,
        realm: str,
        *,
        keep_recorded: bool = True,
        draw: bool = True,
        scoring: Scoring = UNSAID,
    ) -> None:
        self._realm = realm
        self._keep_recorded = keep_recorded
        self._recorder = Recorder(unused(path), realm=realm, draw=draw, **scoring._asdict())
        self._messages = self._bytes = 0
        self._told: dict[str, int] = {}
        self._began: dict[str, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._recorder.close()

    def copy(self, raw: RawMessage) -> None:
        """A recorded message, with its own key and receive time."""
        key = key_of(raw.key)
        if self._keep_recorded or key is None or key.scope != "global":
            self._write(raw.key, raw.data, raw.received)

    def publish(self, name: str, result: StepResult, received: int) -> None:
        """What the variant `name` made in a step."""
        at = result.tracks.time
        self._put(name, "tracks", published_as(result.tracks, name), received)
        self._put(name, "log", replace(result.log, source=name, origin="replay"), received)
        if at - self._told.get(name, at - STATUS_PERIOD) >= STATUS_PERIOD:
            self._told[name] = at
            uptime = (at - self._began.setdefault(name, at)) / 1e9
            status = replace(result.status, source=name, origin="replay", uptime=max(uptime, 0.0))
            self._put(name, "status", status, received)

    def _put(self, name: str, what: str, message: Message, received: int) -> None:
        self._write(global_key(name, what, self._realm), encode(message), received)

    def _write(self, key: str, data: bytes, received: int) -> None:
        self._recorder.handle(key, data, received)
        self._messages += 1
        self._bytes += len(data)
        if self._messages >= TICK_MESSAGES or self._bytes >= TICK_BYTES:
            self._messages = self._bytes = 0
            self._recorder.tick()
