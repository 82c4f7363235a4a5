"""Sources that have nothing to say rest, and in the end are forgotten.

A source rests when it has no tracks, none that it had was in a global track that is there, nothing of it waits, and it
has been silent for longer than it is when its tracks are stale: at once where less than `FEW` messages of it came, else
after `SILENT` seconds, so that what was learned of a source that pauses is not lost. Its run, its sequence and its info
are kept; what supervision has learned of it is not.
It is awake again with whatever comes from it, or is ordered about it. Sources that the config names, that orders stand
about, or that are treated as others than they say, never rest.

One that rests and whose token is not there is forgotten after `forget` seconds, unless suspended tracks wait for it; 0:
no source rests, nor is forgotten.
All follows from what came and from the times of the steps, so that a replay does the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import among
from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.resting import Resting
from fusion_service.centre.sources import Source

__all__ = ["FEW", "SILENT", "rest"]

FEW = 16
SILENT = 60.0


def rest(intake: Intake, time: int, journal: Journal, there: NDArray[np.uint64]) -> None:
    """Before a step, the last one having been at `time`, ns (-1: none), and having left the global tracks `there`: let
    those rest that have nothing to say, and forget those that are long gone."""
    config = intake.config
    if not config.forget or time < 0:
        return
    ordered = {one.order.source for one in intake.orders.standing.values()}
    for name, source in list(intake.sources.items()):
        if name not in ordered and _may_rest(source, intake, time) and not among(source.remembered.link, there).any():
            del intake.sources[name]
            intake.resting[name] = Resting.of(source, time)
    oldest = time - round(config.forget * 1e9)
    for name in sorted(one.name for one in intake.resting.values() if one.since < oldest and one.alive is not True):
        if name in intake.spared.awaited:
            continue
        del intake.resting[name]
        journal.event({"kind": "forgotten", "source": name})


def _may_rest(source: Source, intake: Intake, time: int) -> bool:
    name = source.name
    if len(source.tracks.id) or intake.waits_for(name):
        return False
    if source.messages >= FEW and time - source.last <= SILENT * 1e9:
        return False
    return name not in intake.config.sources and name not in intake.treatments and intake.is_stale(source, time)
