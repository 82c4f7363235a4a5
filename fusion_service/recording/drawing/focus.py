"""One global track and what is told of its object, seen from itself: a view that goes along.

/near/{centre}                       the track, always at the origin;  .../ellipses
/near/{centre}/local/{source}        the local tracks it was fused from;  .../ellipses
/near/{centre}/truth/{scenario}      true objects within a few of its sigmas
/near/grid                           rings at round distances;  .../labels

All but the truth are at the time of the step: a local track is moved on by its velocity (x += vx dt, with the
covariance; no process noise). Errors and covariances are seen at their true size, however far the track goes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.colours import SCREEN_GRID, SCREEN_NEUTRAL, SCREEN_TRUTH, Colour, packed
from fusion_service.recording.columns import Stamp, entity, import_rerun
from fusion_service.recording.drawing.canvas import WIDTH, Canvas
from fusion_service.recording.drawing.extent import FAINT, Corners
from fusion_service.recording.drawing.geometry import RING, rings, track_moments
from fusion_service.recording.drawing.styles import Styles
from fusion_service.recording.drawing.tables import Table, remember, tabulate
from schemas import GlobalTracks, LocalTracks

__all__ = ["FocusView", "predicted"]


AROUND = 5.0
"""Sigmas of the track within which true objects are shown."""
USUAL = 0.8
"""Share of the newest steps that the view along with a track holds whole."""


class FocusView:
    """Goes along with the global track `track`: draws what is near it, with rings at round distances.

    reach: half the width of the view, m. sight: south-west and north-east corner (2,), m, of the square about the
    track's path on the whole picture; None while it was not seen.
    """

    def __init__(self, track: int, canvas: Canvas, styles: Styles) -> None:
        self._rr = import_rerun()
        self._track = track
        self._canvas = canvas
        self._styles = styles
        self._messages: dict[str, deque[tuple[LocalTracks, NDArray[np.bool_]]]] = {}
        self._reaches: deque[float] = deque(maxlen=1000)
        self._path: Corners | None = None
        self.reach = 1.0
        self.sight: Corners | None = None

    def hear(self, message: LocalTracks, sound: NDArray[np.bool_]) -> None:
        """Local tracks, of which those are drawn that are `sound` (T,)."""
        remember(self._messages.setdefault(message.source, deque()), (message, sound), int(sound.sum()))

    def follow(self, table: Table) -> bool:
        """Let `sight` hold the track and half its ellipses around it; it grows in steps. Whether it did."""
        grown = False
        for row in np.flatnonzero(table.ids == np.uint64(self._track)).tolist():
            margin = 3.0 * float(np.sqrt(np.trace(table.place.covariance[row])))
            low, high = table.place.xy[row] - margin, table.place.xy[row] + margin
            if self._path is not None:
                low, high = np.minimum(low, self._path[0]), np.maximum(high, self._path[1])
            self._path = low, high
            if self.sight is None or (low < self.sight[0]).any() or (high > self.sight[1]).any():
                centre, half = (low + high) / 2, 0.65 * max(float((high - low).max()), 10.0)
                self.sight = centre - half, centre + half
                grown = True
        return grown

    def step(
        self,
        message: GlobalTracks,
        table: Table,
        truth: Mapping[str, Table],
        colours: tuple[Mapping[str, Colour], Mapping[str, Colour]],
        label: Callable[[int], str],
        stamp: Stamp,
    ) -> bool:
        """Draw what is near the track in the step of `message`, whose tracks `table` are drawn, and of `truth` by
        scenario. colours: of sources, and of centres. Whether `reach` changed."""
        known = ((name, self._predicted(name, message.time)) for name in self._messages)
        local = {name: one for name, one in known if one is not None}
        sources, centres = colours
        here = 0.0
        for kind, name, part in neighbours(message, self._track, table, local, truth):
            path = entity("near", message.source, *(() if kind == "global" else (kind, name)))
            colour = sources.get(name, SCREEN_NEUTRAL)
            if kind != "local":
                colour = centres[name] if kind == "global" else SCREEN_TRUTH
            bold = kind == "global"
            if not self._styles.has(path, colour):
                self._styles.tracks(path, colour, radius=4.0, width=WIDTH, alpha=255, labels=False, weighed=bold)
            labels = [label(self._track) if bold else name] * len(part.ids)
            self._canvas.tracks(path, part, labels, stamp)
            if kind != "truth":
                self._canvas.ellipses(path, part, stamp, weighed=bold, dashed=True)
            here = max(here, extent(part))
        return here > 0 and self._widen(here)

    def _widen(self, here: float) -> bool:
        self._reaches.append(here)
        reach = 1.2 * float(np.quantile(self._reaches, USUAL))
        if 0.75 < reach / self.reach < 1.25:
            return False
        self.reach = reach
        self._rings(reach)
        return True

    def _rings(self, reach: float) -> None:
        """Circles at round distances from the track, with their radii."""
        rr, tone, text, static = self._rr, packed(SCREEN_GRID, FAINT), packed(SCREEN_TRUTH), self._canvas.columns.static
        radii, labels = rings(reach)
        circles = [radius * RING.T for radius in radii]
        static("/near/grid", rr.LineStrips2D(circles, colors=[tone], radii=[-0.5], draw_order=1.0))
        places = [(0.0, radius) for radius in radii]
        static("/near/grid/labels", rr.Points2D(places, labels=labels, colors=[text], radii=[-0.5]))

    def _predicted(self, name: str, time: int) -> Table | None:
        """The tracks of a source as last told at `time`, moved on to it by their velocities."""
        past = [item for item in self._messages[name] if item[0].time <= time]
        if not past:
            return None
        message, sound = past[-1]
        means, covariances = predicted(message, time)
        place = self._canvas.placing.place(
            means[sound], covariances[sound], message.space, message.frame, message.height
        )
        return tabulate(message.epoch, message.time, message.ids[sound], place)


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


def predicted(message: LocalTracks, time: int) -> tuple[Floats, Floats]:
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


def _moved(table: Table, rows: NDArray[np.intp], origin: Floats) -> Table:
    part = table.part(rows)
    return Table(
        part.epoch, part.ids, part.times, part.place._replace(xy=part.place.xy - origin), part.codes, part.mass
    )
