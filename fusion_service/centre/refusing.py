"""Why a message is refused as a whole, before anything of it is taken.

Reasons, beside those of `schemas.MessageError` (what cannot be decoded) and `schemas.FAULTS` (bad
numbers): type, muted, origin, loop, future, old-epoch, repeat, late, space, frame, intensity (or tracks: what this
centre does not fuse), length, bad-info, too-many-tracks, too-many-sources.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from fusion_service.centre.clock import horizon
from fusion_service.centre.pictures import as_scan, is_own, source_of
from fusion_service.centre.scans import fits, is_sound
from fusion_service.centre.sources import Source
from fusion_service.config import CentreConfig
from schemas import Frame, LocalIntensity, LocalTracks, Message, SensorInfo, check_source

__all__ = ["fault", "would_refuse"]


class Known(Protocol):
    """What of an `Intake` decides."""

    @property
    def config(self) -> CentreConfig: ...
    @property
    def frame(self) -> Frame | None: ...
    @property
    def sources(self) -> Mapping[str, Source]: ...
    @property
    def is_full(self) -> bool: ...
    def blank(self, name: str) -> Source: ...
    def is_stale(self, source: Source, time: int) -> bool: ...


def fault(intake: Known, source: Source, message: Message, code: int, time: int, last: int, received: int) -> str:
    """Why `message` of the digest `code`, received at `received`, is refused in the step at `time` after one at `last`,
    ns; empty where it is not."""
    config = intake.config
    if not isinstance(message, (LocalTracks, LocalIntensity, SensorInfo)):
        return "type"
    if source.muted:
        return "muted"
    if message.origin not in config.source(source.name).allowed_origins:
        return "origin"
    if is_own(message, config):
        return "loop"
    holds = getattr(message, "time", -1)
    started = -1 if message.epoch == source.epoch else message.epoch
    if max(started, holds) > horizon(received, config):
        return "future"
    if message.epoch < source.epoch and not intake.is_stale(source, time):
        return "old-epoch"
    if message.epoch == source.epoch and source.is_repeat(message.type, message.seq, code):
        return "repeat"
    if isinstance(message, SensorInfo):
        return "" if is_sound(message) else "bad-info"
    if last >= 0 and holds < last - round(config.lateness * 1e9):
        return "late"
    if config.kind == "intensity" and not set(config.space) <= set(message.space):
        return "space"
    if isinstance(message, LocalIntensity) is not (config.kind == "intensity"):
        return "intensity" if isinstance(message, LocalIntensity) else "tracks"
    return "" if fits(message) else "length"


def would_refuse(intake: Known, event: Message, code: int, received: int, last: int) -> bool:
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
    return bool(fault(intake, source or intake.blank(name), message, code, last + 1, last, received))
