"""Why a message is refused as a whole, before anything of it is taken.

Reasons, beside those of `schemas.MessageError` (what cannot be decoded) and `schemas.FAULTS` (bad
numbers): type, muted, origin, loop, future, old-epoch, repeat, late, space, frame, intensity (or tracks: what this
centre does not fuse), length, bad-info, too-many-components, too-many-tracks, too-many-sources, failed (see `trying`).
"""

from __future__ import annotations

from collections.abc import Callable

from fusion_service.centre.clock import horizon
from fusion_service.centre.pictures import is_own
from fusion_service.centre.scans import fits, is_sound
from fusion_service.centre.sources import Source
from fusion_service.config import CentreConfig
from schemas import LocalIntensity, LocalTracks, Message, SensorInfo

__all__ = ["fault"]


def fault(
    config: CentreConfig,
    source: Source,
    message: Message,
    code: int,
    last: int,
    received: int,
    stale: Callable[[Source], bool],
) -> str:
    """Why `message` of the digest `code`, received at `received`, is refused in the step after one at `last`, ns; empty
    where it is not. stale: whether a source has been silent for long."""
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
    if message.epoch < source.epoch and not stale(source):
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
    if not fits(message):
        return "length"
    return "too-many-components" if _is_heavy(message, config) else ""


def _is_heavy(message: LocalTracks | LocalIntensity, config: CentreConfig) -> bool:
    """Whether it has more components than the config allows: of a track, or of all its tracks, each counted as large as
    the largest, which is what they cost."""
    if isinstance(message, LocalIntensity):
        return len(message.weights) > config.message_components
    most = 1 if message.counts is None else int(message.counts.max(initial=1))
    return most > config.track_components or most * len(message.ids) > config.message_components
