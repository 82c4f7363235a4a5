"""The picture of another centre as a scan of a source, whose name is `global/{centre}`.

A global track stands as a local track of the same id: its density, existence, identity and class, and as `updated` the
time of the newest measurement in it, so that a track that only coasts brings nothing new. What that centre tracks
apart, since its operator does not trust the source, is left out. A full picture is a complete scan: a track that has
ended is gone. A delta is a partial one: it says nothing of what it does not list.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fusion_service.config import CentreConfig
from schemas import Frame, GlobalTracks, LocalTracks, Message, centre_source
from schemas.messages import APART

__all__ = ["PictureScan", "as_scan", "is_own", "is_picture_of", "source_of"]

CENTRE = centre_source("")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PictureScan(LocalTracks):
    """Tracks of another centre; track_origin (T,) u8 as in `GlobalTracks`, None: that of the message."""

    type: ClassVar[str] = "global_tracks"
    track_origin: NDArray[np.uint8] | None = None


def is_picture_of(name: str) -> str:
    """The centre whose pictures come as the source `name`, empty where it is a source of another kind."""
    return name.removeprefix(CENTRE) if name.startswith(CENTRE) else ""


def source_of(message: Message) -> str:
    """The name of the source that a message is of."""
    return centre_source(message.source) if isinstance(message, GlobalTracks) else message.source


def is_own(message: Message, config: CentreConfig) -> bool:
    """Whether a centre hears itself. Tracks with its data in them are fused as such; intensities cannot be."""
    name = config.name
    if message.source in (name, centre_source(name)):
        return True
    return name in (message.lineage or ()) and config.kind == "intensity"


def as_scan(message: Message, config: CentreConfig, frame: Frame | None = None) -> Message:
    """The picture of a centre that the config names as a source, or of the own one, as a scan, complete unless it is a
    delta; any other message, and what does not belong together, as it is. frame: that in which a picture without
    tracks says so."""
    if not isinstance(message, GlobalTracks) or not _fits(message):
        return message
    if source_of(message) not in config.sources and message.source != config.name:
        return message
    marks = np.zeros(len(message.ids), dtype=np.uint8) if message.marks is None else message.marks
    some = marks & APART == 0
    counts = message.counts
    rows = some if counts is None else np.repeat(some, counts.astype(np.intp))
    spoken = message.frame if frame is None or some.any() else frame

    def texts(column: tuple[str | None, ...] | None) -> tuple[str | None, ...] | None:
        return None if column is None else tuple(text for text, kept in zip(column, some.tolist(), strict=True) if kept)

    return PictureScan(
        source=source_of(message),
        epoch=message.epoch,
        seq=message.seq,
        sent=message.sent,
        origin=message.origin,
        lineage=message.lineage or (message.source,),
        time=message.time,
        complete=not message.delta,
        space=message.space,
        frame=spoken,
        ids=message.ids[some],
        means=message.means[rows],
        covariances=message.covariances[rows],
        counts=None if counts is None else counts[some],
        weights=None if message.weights is None else message.weights[rows],
        existence=message.existence[some],
        updated=message.updated[some],
        identity=texts(message.identity),
        kind=texts(message.kind),
        kind_p=None if message.kind_p is None else message.kind_p[some],
        track_lineage=None if message.track_lineage is None else message.track_lineage[some],
        track_origin=None if message.track_origin is None else message.track_origin[some],
        extent=None if message.extent is None else message.extent[some],
        extent_sigma=None if message.extent_sigma is None else message.extent_sigma[some],
        shape=message.shape,
    )


def _fits(message: GlobalTracks) -> bool:
    """Whether what is read of a picture that was never encoded belongs together."""
    tracks = len(message.ids)
    total = tracks if message.counts is None else int(np.sum(message.counts))
    columns = (message.existence, message.updated, message.counts, message.identity, message.kind, message.kind_p)
    more = (message.marks, message.track_origin, message.track_lineage, message.extent, message.extent_sigma)
    return (
        len(message.means) == len(message.covariances) == total
        and all(column is None or len(column) == tracks for column in (*columns, *more))
        and (message.weights is None or len(message.weights) == total)
    )
