"""One global track and what is told of its object, seen from itself: a view that goes along.

/near/{centre}                       the track, always at the origin;  .../ellipses
/near/{centre}/local/{source}        the local tracks it was fused from;  .../ellipses
/near/{centre}/truth/{scenario}      true objects within a few of its sigmas

All but the truth are at the time of the step: a local track is moved on by its velocity (x += vx dt, with the
covariance; no process noise). Errors and covariances are seen at their true size, however far the track goes.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.linalg import FloatArray
from fusion_service.recording.drawing.geometry import track_moments
from fusion_service.recording.drawing.tables import Table
from schemas import GlobalTracks, LocalTracks

__all__ = ["Neighbour", "extent", "neighbours", "predicted"]


AROUND = 5.0
"""Sigmas of the track within which true objects are shown."""


class Neighbour(NamedTuple):
    """Tracks of one kind ("global", "local" or "truth") and one name, at their places from the track."""

    kind: str
    name: str
    table: Table


def neighbours(
    message: GlobalTracks, track: int, fused: Table, local: Mapping[str, Table], truth: Mapping[str, Table]
) -> Iterator[Neighbour]:
    """What is near the global track `track` of `message`; nothing if it is not among those that are drawn, `fused`."""
    rows, drawn = np.flatnonzero(message.ids == np.uint64(track)), np.flatnonzero(fused.ids == np.uint64(track))
    if not len(rows) or not len(drawn):
        return
    origin = fused.place.xy[drawn[0]]
    yield Neighbour("global", message.source, _moved(fused, drawn[:1], origin))
    first = int(message.contributor_counts[: rows[0]].sum())
    part = slice(first, first + int(message.contributor_counts[rows[0]]))
    for index, name in enumerate(message.sources):
        if (table := local.get(name)) is None:
            continue
        mine = message.contributor_source[part] == index
        mine &= message.contributor_epoch[part] == np.uint64(table.epoch)
        told = np.flatnonzero(np.isin(table.ids, message.contributor_id[part][mine]))
        yield Neighbour("local", name, _moved(table, told, origin))
    reach = AROUND * float(np.sqrt(np.trace(fused.place.covariance[drawn[0]])))
    for name, table in truth.items():
        there = np.flatnonzero(np.linalg.norm(table.place.xy - origin, axis=1) <= reach)
        yield Neighbour("truth", name, _moved(table, there, origin))


def predicted(message: LocalTracks, time: int) -> tuple[FloatArray, FloatArray]:
    """Means (T, n) and covariances (T, n, n) of the tracks, moved on to `time` by their velocities."""
    means, covariances = track_moments(message)
    F = np.eye(len(message.space))
    for name in "xyz":
        if name in message.space and f"v{name}" in message.space:
            F[message.space.index(name), message.space.index(f"v{name}")] = (time - message.time) / 1e9
    return means @ F.T, F @ covariances @ F.T


def extent(table: Table) -> float:
    """How far the 95 % ellipses, about, reach from the origin, m; 0 without any."""
    if not len(table.ids):
        return 0.0
    spread = np.sqrt(table.place.covariance.trace(axis1=1, axis2=2))
    return float((np.linalg.norm(table.place.xy, axis=1) + 2.5 * spread).max())


def _moved(table: Table, rows: NDArray[np.intp], origin: FloatArray) -> Table:
    part = table.part(rows)
    return Table(
        part.epoch, part.ids, part.times, part.place._replace(xy=part.place.xy - origin), part.codes, part.mass
    )
