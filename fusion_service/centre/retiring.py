"""What of a source's tracks is stale at a step, and what is told of tracks that are taken but not used."""

from __future__ import annotations

import numpy as np

from fusion_service.arrays import Ints, any_of, marked
from fusion_service.centre import notes
from fusion_service.centre.intervals import Remembered, remember, silence
from fusion_service.centre.sources import Source
from fusion_service.centre.tracks import Tracks
from fusion_service.config import CentreConfig, SourceConfig

__all__ = ["leave_out", "retire"]

NOTHING: Ints = np.zeros(0, dtype=np.intp)


def retire(source: Source, said: SourceConfig, time: int, room: int, config: CentreConfig, awake: int = -1) -> Tracks:
    """The tracks of `source` that are not stale at `time`, ns, which is its table from now on. Of the others at most
    `room` are remembered. awake: since when silence counts, ns."""
    table, age = source.tracks, time - source.tracks.time
    age = np.minimum(age, time - awake) if 0 <= awake <= time else age
    limit = silence(table.interval, said, config)
    source.why = "" if source.why == notes.waiting() else source.why
    late = age > limit
    retired = any_of(late)
    if retired:
        source.tracks = table.take(~late)
    oldest = time - round(config.remember * 1e9)
    if retired or len(source.remembered.id):
        gone = Remembered(table.id[late], table.time[late], table.interval[late], table.link[late])
        source.remembered = remember(source.remembered, gone, source.tracks.id, oldest, room)
    new = marked(late) if retired and source.arrived else NOTHING
    if len(new):
        new = new[np.isin(table.id[new], np.concatenate(source.arrived))]
        source.leave("stale", len(new))
    if len(new) and len(new) >= sum(len(ids) for ids in source.arrived):
        newest = new[age[new].argmin()]
        source.why = notes.stale(age[newest] / 1e9, limit[newest] / 1e9)
    elif source.arrived:
        source.why = ""
    elif source.ahead > time and not len(source.tracks.id):
        source.why = notes.ahead((source.ahead - time) / 1e9)
    return source.tracks


def leave_out(source: Source) -> None:
    """Its tracks are not used in this step, though they are sound."""
    if source.arrived and not source.muted:
        source.leave("waiting", sum(len(ids) for ids in source.arrived))
        source.why = notes.waiting()
