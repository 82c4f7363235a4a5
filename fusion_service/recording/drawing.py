"""The picture: sensors, tracks of every source, global tracks and truth, on a map and on a plane alike.

Entities, each with its places on the plane and, where the frame allows, on the map:

    /picture/sensors/{source}            position and name;  .../coverage  edges of the field of view
    /picture/local/{source}              latest tracks;      .../ellipses  95 % of the position;  .../trail
    /picture/global/{centre}             the same, labelled with the id; faint: tentative, dashed: coasting
    /picture/truth/{scenario}            true positions;     .../trail
    /grid                                on the plane only

A trail is one short line per track and message; how much of it is seen is a setting of the view.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.recording import palette
from fusion_service.recording.columns import Columns, Lines, Points, Stamp, entity, import_rerun
from fusion_service.recording.geometry import Chart, Outline, Place, ellipses, grid, moments, outline
from schemas import STATUSES, Frame, GlobalTracks, LocalIntensity, LocalTracks, SensorInfo, Truth

__all__ = ["Drawing"]

Floats = NDArray[np.float64]
U64 = NDArray[np.uint64]

TENTATIVE, COASTING = STATUSES.index("tentative"), STATUSES.index("coasting")
ALPHA = np.array([90, 255, 170])
"""Of tentative, confirmed and coasting tracks."""
INTENSITY = 0.1
"""Components of an intensity that expect less than this are not drawn."""
DEFAULT_PERIOD = 10.0
KEPT_PERIODS = 3.0
"""How long, in periods of its source, a track stays drawn that an incomplete message does not list."""


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """The newest place of each track of one entity, and when it held, ns."""

    epoch: int
    ids: U64
    times: NDArray[np.int64]
    place: Place
    codes: NDArray[np.uint8]

    def part(self, rows: NDArray[Any]) -> _Table:
        place = Place(*(column[rows] for column in self.place))
        return _Table(self.epoch, self.ids[rows], self.times[rows], place, self.codes[rows])


class Drawing:
    """Turns messages into rows of `columns`. `chart` must be set before anything but `open_chart` is called."""

    def __init__(self, columns: Columns, frame: Frame | None = None) -> None:
        self._rr = import_rerun()
        self._columns = columns
        self.chart: Chart | None = None if frame is None else Chart(frame)
        self.trails: list[str] = []
        self.sources: dict[str, str] = {}
        self.colours: dict[str, palette.Colour] = {}
        self.changed = True
        self._generations: dict[int, int] = {}
        self._tables: dict[str, _Table] = {}
        self._recolour = False
        self._info: dict[str, SensorInfo] = {}
        self._extents: dict[bool, tuple[Floats, Floats]] = {}
        self._grid: tuple[Floats, Floats] | None = None

    def open_chart(self, message: LocalTracks | LocalIntensity | GlobalTracks | SensorInfo | Truth) -> None:
        """Draw in the frame of `message` from now on."""
        near = None
        if isinstance(message, SensorInfo):
            near = message.position
        elif "z" in message.space and len(message.means):
            x, y, z = (float(message.means[0, message.space.index(name)]) for name in "xyz")
            near = x, y, z
        self.chart = Chart(message.frame, near)

    def label(self, track: int) -> str:
        """A global id by its lower half, a counter; from the second generation (upper half) seen on, after the number
        of its generation: 7, 2.7."""
        generation, counter = divmod(int(track), 1 << 32)
        number = self._generations.setdefault(generation, len(self._generations) + 1)
        return f"{number}.{counter}" if number > 1 else str(counter)

    @property
    def extent(self) -> tuple[Floats, Floats] | None:
        """South-west and north-east corner (2,) of what is drawn in m: sensors, global tracks and truth, or else
        the local tracks."""
        return self._extents.get(True) or self._extents.get(False)

    def sensor(self, info: SensorInfo, stamp: Stamp) -> None:
        """Position, name and field of view, once and whenever they change."""
        old = self._info.get(info.source)
        self._info[info.source] = info
        if old is not None and (old.position, old.frame, old.coverage) == (info.position, info.frame, info.coverage):
            return
        self._source(info.source)
        path = entity("picture", "sensors", info.source)
        state = np.array([info.position])
        place = self._chart.place(state, np.zeros((1, 3, 3)), ("x", "y", "z"), info.frame)
        self._grow(place.xy, main=True)
        self._columns.points(path, stamp, self._points(place, labels=[info.source]))
        edges, frame = outline(info)
        moved = [self._chart.place(edge, np.zeros((len(edge), 2, 2)), ("x", "y"), frame) for edge in edges]
        xy = np.concatenate([np.zeros((0, 2)), *(part.xy for part in moved)])
        z = np.concatenate([np.zeros(0), *(part.z for part in moved)])
        lengths = np.array([len(edge) for edge in edges], dtype=np.int64)
        self._columns.lines(f"{path}/coverage", stamp, self._lines(xy, z, lengths))

    def local_tracks(self, message: LocalTracks | LocalIntensity, sound: NDArray[np.bool_], stamp: Stamp) -> None:
        """`sound` (T,): the tracks that are drawn. Of an intensity, the components that expect a good part of an
        object, labelled with their weight."""
        self._source(message.source)
        shown = sound & (message.weights >= INTENSITY) if isinstance(message, LocalIntensity) else sound
        drawn = np.flatnonzero(shown)
        means, covariances = moments(message)
        place = self._chart.place(means[drawn], covariances[drawn], message.space, message.frame, message.height)
        ids = drawn.astype(np.uint64) if isinstance(message, LocalIntensity) else message.ids[drawn]
        table = _table(message.epoch, message.time, ids, place, np.ones(len(ids), dtype=np.uint8))
        self._grow(table.place.xy, main=False)
        path = entity("picture", "local", message.source)
        if isinstance(message, LocalIntensity):
            labels = [f"{message.weights[row]:.2f}" for row in table.ids.tolist()]
            self._tables[path] = table
        else:
            period = self._info[message.source].period if message.source in self._info else DEFAULT_PERIOD
            keep = 0 if message.complete else round(KEPT_PERIODS * period * 1e9)
            table = self._trail(path, table, keep, stamp)
            labels = [str(track) for track in table.ids.tolist()]
        self._columns.points(path, stamp, self._points(table.place, labels))
        self._ellipses(path, table, stamp)

    def global_tracks(self, message: GlobalTracks, sound: NDArray[np.bool_], stamp: Stamp) -> None:
        """`sound` (T,): the tracks that are drawn."""
        means, covariances = moments(message)
        place = self._chart.place(means[sound], covariances[sound], message.space, message.frame)
        table = _table(message.epoch, message.time, message.ids[sound], place, message.status[sound])
        self._grow(table.place.xy, main=True)
        path = entity("picture", "global", message.source)
        if self._first(path):
            self._style(path, palette.FUSED, radius=4.5, width=1.5, alpha=255, labels=True)
        table = self._trail(path, table, 0, stamp)
        labels = [self.label(track) for track in table.ids.tolist()]
        colours = palette.packed(palette.FUSED, 0) + ALPHA.astype(np.uint32)[table.codes]
        self._columns.points(path, stamp, self._points(table.place, labels, colours.astype(np.uint32)))
        self._ellipses(path, table, stamp, colours.astype(np.uint32))

    def truth(self, message: Truth, stamp: Stamp) -> None:
        n = len(message.space)
        place = self._chart.place(message.means, np.zeros((len(message.ids), n, n)), message.space, message.frame)
        table = _table(message.epoch, message.time, message.ids, place, np.ones(len(message.ids), dtype=np.uint8))
        self._grow(table.place.xy, main=True)
        path = entity("picture", "truth", message.source)
        if self._first(path):
            self._style(path, palette.TRUTH, radius=2.0, width=0.5, alpha=255, labels=False)
        table = self._trail(path, table, 0, stamp)
        self._columns.points(path, stamp, self._points(table.place, [f"target {track}" for track in table.ids]))

    def clear(self, source: str, stamp: Stamp) -> None:
        """Draw no tracks of `source` until it sends again."""
        path = entity("picture", "local", source)
        table = self._tables.pop(path, None)
        if table is not None:
            nothing = table.part(np.zeros(0, dtype=np.intp))
            self._columns.points(path, stamp, self._points(nothing.place, labels=[]))
            self._ellipses(path, nothing, stamp)

    @property
    def _chart(self) -> Chart:
        assert self.chart is not None, "open_chart comes first"
        return self.chart

    def _points(self, place: Place, labels: list[str], colours: NDArray[np.uint32] | None = None) -> Points:
        return Points(self._chart.plane(place.xy), self._chart.geo(place.xy, place.z), labels, colours)

    def _lines(
        self, xy: Floats, z: Floats, lengths: NDArray[np.int64], colours: NDArray[np.uint32] | None = None
    ) -> Lines:
        return Lines(self._chart.plane(xy), self._chart.geo(xy, z), lengths, colours)

    def _ellipses(self, path: str, table: _Table, stamp: Stamp, colours: NDArray[np.uint32] | None = None) -> None:
        drawn: Outline = ellipses(table.place, table.codes == COASTING)
        z = np.repeat(table.place.z[drawn.owner], drawn.lengths)
        shown = None if colours is None else colours[drawn.owner]
        self._columns.lines(f"{path}/ellipses", stamp, self._lines(drawn.xy, z, drawn.lengths, shown))

    def _trail(self, path: str, new: _Table, keep: int, stamp: Stamp) -> _Table:
        """Draw a line from each track's place before to its place in `new`. Returns what is drawn now: `new`, and
        what was known at most `keep` ns ago. One that is older than the last is drawn alone, at its own time."""
        old = self._tables.get(path)
        if old is not None and old.epoch == new.epoch and len(old.ids):
            if len(new.ids) and new.times[0] < old.times.max():
                return new
            _, before, after = np.intersect1d(old.ids, new.ids, assume_unique=True, return_indices=True)
            ends = np.stack([old.place.xy[before], new.place.xy[after]], axis=1).reshape(-1, 2)
            z = np.stack([old.place.z[before], new.place.z[after]], axis=1).reshape(-1)
            self._columns.lines(f"{path}/trail", stamp, self._lines(ends, z, np.full(len(before), 2)))
            if keep and stamp.time is not None:
                standing = ~np.isin(old.ids, new.ids) & (old.times >= stamp.time - keep)
                new = _join(old.part(np.flatnonzero(standing)), new)
        self._tables[path] = new
        return new

    def _source(self, name: str) -> None:
        if name not in self.sources:
            self.sources[name] = entity("picture", "local", name)
            self.trails.append(f"{self.sources[name]}/trail")
            self.changed = self._recolour = True

    def _first(self, path: str) -> bool:
        """Whether an entity with a trail is new."""
        if f"{path}/trail" in self.trails:
            return False
        self.trails.append(f"{path}/trail")
        self.changed = True
        return True

    def colour_sources(self) -> None:
        """Give each source its colour; a new one may change those of others."""
        if not self._recolour:
            return
        self._recolour = False
        for name, colour in palette.source_colours(self.sources).items():
            if self.colours.get(name) == colour:
                continue
            self.colours[name] = colour
            self._style(self.sources[name], colour, radius=2.5, width=0.75, alpha=130, labels=False)
            path = entity("picture", "sensors", name)
            self._columns.static(path, *_both(self._rr, "Points", colors=[palette.packed(colour)], radii=[-6.0]))
            edge = _both(self._rr, "Lines", colors=[palette.packed(colour, 110)], radii=[-0.75])
            self._columns.static(f"{path}/coverage", *edge)

    def _style(
        self,
        path: str,
        colour: palette.Colour,
        *,
        radius: float,
        width: float,
        alpha: int,
        labels: bool,
    ) -> None:
        """What all rows of an entity, its ellipses and its trail share; sizes in points of the screen."""
        rr, static = self._rr, self._columns.static
        static(path, *_both(rr, "Points", colors=[palette.packed(colour)], radii=[-radius]))
        static(path, rr.Points2D.from_fields(show_labels=labels))
        faint = palette.packed(colour, alpha)
        static(f"{path}/ellipses", *_both(rr, "Lines", colors=[faint], radii=[-width]))
        static(f"{path}/trail", *_both(rr, "Lines", colors=[faint], radii=[-0.75 * width]))

    def _grow(self, xy: Floats, *, main: bool) -> None:
        """Let the extent hold `xy` (T, 2); the grid and the view follow in steps."""
        if not len(xy):
            return
        low, high = xy.min(axis=0), xy.max(axis=0)
        if main in self._extents:
            low, high = np.minimum(low, self._extents[main][0]), np.maximum(high, self._extents[main][1])
        self._extents[main] = low, high
        if self.extent is not self._extents[main]:
            return
        centre, half = (low + high) / 2, max(float((high - low).max()) / 2, 10.0) * 1.1
        if self._grid is not None and (self._grid[0] <= low).all() and (high <= self._grid[1]).all():
            return
        self._grid = centre - half, centre + half
        self.changed = True
        lines, labels = grid(*self._grid)
        rr, tone = self._rr, palette.packed(palette.GRID)
        self._columns.static("/grid", rr.LineStrips2D([line * (1, -1) for line in lines], colors=[tone], radii=[-0.5]))
        corner = centre - 0.94 * half
        places = [np.where(line[0] == line[1], line[0], corner) * (1, -1) for line in lines]
        text = palette.packed(palette.TRUTH)
        self._columns.static("/grid/labels", rr.Points2D(places, labels=labels, colors=[text], radii=[-0.5]))

    @property
    def bounds(self) -> tuple[Floats, Floats] | None:
        """South-west and north-east corner (2,) of the square that the grid covers, m."""
        return self._grid


def _both(rr: Any, kind: str, **fields: Any) -> tuple[Any, Any]:
    plane, geo = {"Points": (rr.Points2D, rr.GeoPoints), "Lines": (rr.LineStrips2D, rr.GeoLineStrings)}[kind]
    return plane.from_fields(**fields), geo.from_fields(**fields)


def _table(epoch: int, time: int, ids: U64, place: Place, codes: NDArray[np.uint8]) -> _Table:
    """A table of one message, without what is not to be placed (its vertical misses the Earth)."""
    table = _Table(epoch, ids, np.full(len(ids), time), place, codes)
    good = np.isfinite(place.xy).all(axis=1) & np.isfinite(place.covariance).all(axis=(1, 2))
    return table if good.all() else table.part(np.flatnonzero(good))


def _join(first: _Table, second: _Table) -> _Table:
    place = Place(*(np.concatenate(pair) for pair in zip(first.place, second.place, strict=True)))
    return _Table(
        second.epoch,
        np.concatenate([first.ids, second.ids]),
        np.concatenate([first.times, second.times]),
        place,
        np.concatenate([first.codes, second.codes]),
    )
