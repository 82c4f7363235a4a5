"""The picture: sensors, tracks of every source, global tracks and truth, on a map and on a plane alike.

Entities, each with its places on the plane and, where the frame allows, on the map:

    /picture/sensors/{source}            position and name;  .../coverage  edges of the field of view
    /picture/local/{source}              latest tracks;      .../ellipses  95 % of the position;  .../trail
    /picture/global/{centre}             the same, labelled with the id; faint: tentative, dashed: coasting
    .../components                       the Gaussians of the tracks that are mixtures;  .../ellipses
    /picture/local/{source}/intensity    those of an intensity;                          .../ellipses
    /picture/global/{centre}/links/...   lines from the local tracks of each source to the global ones: `links`
    /picture/truth/{scenario}            true positions;     .../trail
    /grid                                on the plane only

A trail is one short line per track and message; how much of it is seen is a setting of the view. A track is drawn by
the moments of its mixture, over its components. The opacity of a point says its existence, or the weight of its
component, as class 0..15, whose colours are static: a source's may change when another comes. On the map lines have no
classes, only widths.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion_service.colours import (
    SCREEN_GRID,
    SCREEN_NEUTRAL,
    SCREEN_TRUTH,
    Colour,
    centre_colours,
    packed,
    screen_source_colours,
)
from fusion_service.linalg import FloatArray
from fusion_service.recording.columns import ColumnWriter, Lines, Points, Stamp, entity, import_rerun
from fusion_service.recording.drawing.focus import extent, neighbours, predicted
from fusion_service.recording.drawing.geometry import (
    CORNERS,
    RING,
    Chart,
    Outline,
    Place,
    ellipses,
    grid,
    outline,
    rings,
    track_moments,
)
from fusion_service.recording.drawing.labels import Labels
from fusion_service.recording.drawing.links import links
from fusion_service.recording.drawing.tables import COASTING, LEVELS, Table, drawn_components, hold, levels, tabulate
from schemas import Frame, GlobalTracks, LocalIntensity, LocalTracks, SensorInfo, Truth

__all__ = ["Drawing"]

U64 = NDArray[np.uint64]
T = TypeVar("T")

DEFAULT_PERIOD = 10.0
KEPT_PERIODS = 3.0
"""How long, in periods of its source, a track stays drawn that an incomplete message does not list."""
FAINTEST = 40
"""Opacity of what hardly exists, of 255."""
FEW = 100
"""Components of one message whose ellipses are drawn finely."""
TOLD, TOLD_TRACKS = 64, 5000
"""Newest messages of a source, and tracks in them, among which that is sought which a step could know: in a fast
playback the sources are far ahead of the centre."""
USUAL = 0.8
"""Share of the newest steps that the view along with a track holds whole."""
LINK = 200
"""Opacity of the lines from local tracks to global ones."""
WIDTH = 1.5
"""Of the ellipse of a global track, and of a component of weight 1, in points of the screen."""


class Drawing:
    """Turns messages into rows of `columns`. `chart` must be set before anything but `open_chart` is called.

    focus: the global track about whose path the view is, None for the whole picture.
    """

    def __init__(self, columns: ColumnWriter, frame: Frame | None = None, focus: int | None = None) -> None:
        self._rr = import_rerun()
        self._columns = columns
        self.chart: Chart | None = None if frame is None else Chart(frame)
        self.trails: list[str] = []
        self.sources: dict[str, str] = {}
        self.colours: dict[str, Colour] = {}
        self.centres: dict[str, Colour] = {}
        self._told: dict[str, deque[Table]] = {}
        self._messages: dict[str, deque[tuple[LocalTracks, NDArray[np.bool_]]]] = {}
        self.linked: set[tuple[str, str]] = set()
        self._focus = focus
        self._reaches: deque[float] = deque(maxlen=1000)
        self.reach = 1.0
        """Half the width, m, of the view that goes along with the `focus`."""
        self._scenarios: dict[str, str] = {}
        self._sight: tuple[FloatArray, FloatArray] | None = None
        self._path: tuple[FloatArray, FloatArray] | None = None
        self.changed = True
        self.label = Labels()
        self._tables: dict[str, Table] = {}
        self._tones: dict[str, Colour] = {}
        self._mixed: set[str] = set()
        self._recolour = False
        self._info: dict[str, SensorInfo] = {}
        self._extents: dict[bool, tuple[FloatArray, FloatArray]] = {}
        self._grid: tuple[FloatArray, FloatArray] | None = None

    def open_chart(self, message: LocalTracks | LocalIntensity | GlobalTracks | SensorInfo | Truth) -> None:
        """Draw in the frame of `message` from now on."""
        near = None
        if isinstance(message, SensorInfo):
            near = message.position
        elif "z" in message.space and len(message.means):
            x, y, z = (float(message.means[0, message.space.index(name)]) for name in "xyz")
            near = x, y, z
        self.chart = Chart(message.frame, near)

    @property
    def extent(self) -> tuple[FloatArray, FloatArray] | None:
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

    def local_tracks(self, message: LocalTracks, sound: NDArray[np.bool_], stamp: Stamp) -> int:
        """`sound` (T,): the tracks that are drawn. Returns how many components are too many to draw."""
        self._source(message.source)
        means, covariances = track_moments(message)
        place = self._chart.place(means[sound], covariances[sound], message.space, message.frame, message.height)
        ids = message.ids[sound]
        mass = None if message.existence is None else message.existence[sound]
        table = tabulate(message.epoch, message.time, ids, place, mass=mass)
        if self._focus is not None:
            _remember(self._messages.setdefault(message.source, deque()), (message, sound), len(ids))
        self._grow(table.place.xy, main=False)
        path = self.sources[message.source]
        period = self._info[message.source].period if message.source in self._info else DEFAULT_PERIOD
        keep = 0 if message.complete else round(KEPT_PERIODS * period * 1e9)
        over = self._components(f"{path}/components", message, sound, stamp, keep)
        table = self._trail(path, table, message.time, keep, stamp)
        _remember(self._told.setdefault(message.source, deque()), table, len(table.ids))
        self._tracks(path, table, [str(track) for track in table.ids.tolist()], stamp)
        self._ellipses(path, table, stamp)
        return over

    def intensity(self, message: LocalIntensity, sound: NDArray[np.bool_], stamp: Stamp) -> int:
        """`sound` (C,): the components that are drawn. Returns how many are too many to draw."""
        self._source(message.source)
        return self._components(f"{self.sources[message.source]}/intensity", message, sound, stamp)

    def global_tracks(self, message: GlobalTracks, sound: NDArray[np.bool_], stamp: Stamp) -> int:
        """`sound` (T,): the tracks that are drawn. Returns how many components are too many to draw."""
        means, covariances = track_moments(message)
        place = self._chart.place(means[sound], covariances[sound], message.space, message.frame)
        status, mass = message.status[sound], message.existence[sound]
        table = tabulate(message.epoch, message.time, message.ids[sound], place, status, mass)
        self._grow(table.place.xy, main=True)
        path = entity("picture", "global", message.source)
        if self._first(path):
            self.centres = centre_colours([*self.centres, message.source])
            self._recolour = True
        over = self._components(f"{path}/components", message, sound, stamp)
        table = self._trail(path, table, message.time, 0, stamp)
        self._tracks(path, table, [self.label(track) for track in table.ids.tolist()], stamp)
        self._ellipses(path, table, stamp, weighed=True, dashed=True)
        self._links(message, table, stamp)
        if self._focus is not None:
            self._follow(table, self._focus)
            self._near(message, table, self._focus, stamp)
        return over

    def _links(self, message: GlobalTracks, table: Table, stamp: Stamp) -> None:
        known = ((name, _as_of(told, message.time)) for name, told in self._told.items())
        local = {name: table for name, table in known if table is not None}
        for name, ends, z in links(message, table, local):
            key = message.source, name
            if not len(ends) and key not in self.linked:
                continue
            if key not in self.linked:
                if name not in self.sources:
                    continue
                self.linked.add(key)
                self._style_links(*key)
            lengths = np.full(len(ends), 2)
            content = self._lines(ends.reshape(-1, 2), z.reshape(-1), lengths)
            self._columns.lines(_links_path(*key), stamp, content)

    def _follow(self, table: Table, track: int) -> None:
        """Let the view hold the track and half its ellipses around it; it grows in steps."""
        for row in np.flatnonzero(table.ids == np.uint64(track)).tolist():
            margin = 3.0 * float(np.sqrt(np.trace(table.place.covariance[row])))
            low, high = table.place.xy[row] - margin, table.place.xy[row] + margin
            if self._path is not None:
                low, high = np.minimum(low, self._path[0]), np.maximum(high, self._path[1])
            self._path = low, high
            if self._sight is None or (low < self._sight[0]).any() or (high > self._sight[1]).any():
                centre, half = (low + high) / 2, 0.65 * max(float((high - low).max()), 10.0)
                self._sight = centre - half, centre + half
                self.changed = True

    def _near(self, message: GlobalTracks, table: Table, track: int, stamp: Stamp) -> None:
        known = ((name, self._predicted(name, message.time)) for name in self._messages)
        local = {name: one for name, one in known if one is not None}
        truth = {name: self._tables[own] for name, own in self._scenarios.items() if own in self._tables}
        here = 0.0
        for kind, name, part in neighbours(message, track, table, local, truth):
            path = entity("near", message.source, *(() if kind == "global" else (kind, name)))
            colour = self.colours.get(name, SCREEN_NEUTRAL)
            if kind != "local":
                colour = self.centres[name] if kind == "global" else SCREEN_TRUTH
            if self._tones.get(path) != colour:
                bold = kind == "global"
                self._style(path, colour, radius=4.0, width=WIDTH, alpha=255, labels=False, weighed=bold)
            labels = [self.label(track) if kind == "global" else name] * len(part.ids)
            self._tracks(path, part, labels, stamp)
            if kind != "truth":
                self._ellipses(path, part, stamp, weighed=kind == "global", dashed=True)
            here = max(here, extent(part))
        if here > 0:
            self._reaches.append(here)
            reach = 1.2 * float(np.quantile(self._reaches, USUAL))
            if not 0.75 < reach / self.reach < 1.25:
                self.reach, self.changed = reach, True
                self._rings(reach)

    def _rings(self, reach: float) -> None:
        """Circles at round distances from the `focus`, with their radii."""
        rr, tone, text = self._rr, packed(SCREEN_GRID), packed(SCREEN_TRUTH)
        radii, labels = rings(reach)
        circles = [radius * RING.T for radius in radii]
        self._columns.static("/near/grid", rr.LineStrips2D(circles, colors=[tone], radii=[-0.5], draw_order=1.0))
        places = [(0.0, radius) for radius in radii]
        self._columns.static("/near/grid/labels", rr.Points2D(places, labels=labels, colors=[text], radii=[-0.5]))

    def _predicted(self, name: str, time: int) -> Table | None:
        """The tracks of a source as last told at `time`, moved on to it by their velocities."""
        past = [item for item in self._messages[name] if item[0].time <= time]
        if not past:
            return None
        message, sound = past[-1]
        means, covariances = predicted(message, time)
        place = self._chart.place(means[sound], covariances[sound], message.space, message.frame, message.height)
        return tabulate(message.epoch, message.time, message.ids[sound], place)

    def truth(self, message: Truth, stamp: Stamp) -> None:
        n = len(message.space)
        place = self._chart.place(message.means, np.zeros((len(message.ids), n, n)), message.space, message.frame)
        table = tabulate(message.epoch, message.time, message.ids, place)
        self._grow(table.place.xy, main=True)
        path = self._scenarios[message.source] = entity("picture", "truth", message.source)
        if self._first(path):
            self._style(path, SCREEN_TRUTH, radius=2.0, width=0.5, alpha=255, labels=False)
        table = self._trail(path, table, message.time, 0, stamp)
        self._tracks(path, table, [f"target {track}" for track in table.ids.tolist()], stamp)

    def clear(self, source: str, stamp: Stamp) -> None:
        """Draw no tracks of `source` until it sends again."""
        own = entity("picture", "local", source)
        self._told.pop(source, None)
        for path in (own, f"{own}/components", f"{own}/intensity"):
            table = self._tables.pop(path, None)
            if table is not None:
                nothing = table.part(np.zeros(0, dtype=np.intp))
                self._tracks(path, nothing, [], stamp)
                self._ellipses(path, nothing, stamp, weighed=path != own)

    def _components(
        self,
        path: str,
        message: LocalTracks | LocalIntensity | GlobalTracks,
        sound: NDArray[np.bool_],
        stamp: Stamp,
        keep: int = 0,
    ) -> int:
        """Draw the components of mixtures, labelled with their weights: a row if there are any, or were before.
        Returns how many are too many."""
        rows, owner, weights, over = drawn_components(message, sound)
        if not len(rows) and path not in self._tables:
            return 0
        height = None if isinstance(message, GlobalTracks) else message.height
        means, covariances = message.means[rows], message.covariances[rows]
        place = self._chart.place(means, covariances, message.space, message.frame, height)
        whole = isinstance(message, LocalIntensity)
        tracks = np.arange(len(sound), dtype=np.uint64) if isinstance(message, LocalIntensity) else message.ids
        codes = message.status[owner] if isinstance(message, GlobalTracks) else None
        table = tabulate(message.epoch, message.time, tracks[owner], place, codes, weights)
        if whole:
            self._grow(table.place.xy, main=False)
        if path not in self._mixed:
            self._mixed.add(path)
            self._style_components(path)
        table = self._hold(path, table, tracks, message.time, keep)
        name = self.label if isinstance(message, GlobalTracks) else str
        pairs = zip(table.ids.tolist(), table.mass.tolist(), strict=True)
        labels = [f"{weight:.2f}" if whole else f"{name(track)}: {weight:.2f}" for track, weight in pairs]
        self._tracks(path, table, labels, stamp)
        self._ellipses(path, table, stamp, weighed=True)
        return over

    @property
    def _chart(self) -> Chart:
        assert self.chart is not None, "open_chart comes first"
        return self.chart

    def _points(self, place: Place, labels: list[str], classes: NDArray[np.uint16] | None = None) -> Points:
        return Points(self._chart.plane(place.xy), self._chart.geo(place.xy, place.z), labels, classes)

    def _tracks(self, path: str, table: Table, labels: list[str], stamp: Stamp) -> None:
        self._columns.points(path, stamp, self._points(table.place, labels, levels(table)))

    def _lines(self, xy: FloatArray, z: FloatArray, lengths: NDArray[np.int64], **looks: Any) -> Lines:
        return Lines(self._chart.plane(xy), self._chart.geo(xy, z), lengths, **looks)

    def _ellipses(self, path: str, table: Table, stamp: Stamp, *, weighed: bool = False, dashed: bool = False) -> None:
        """`weighed`: opacity and width by mass. `dashed`: while a track coasts."""
        corners = CORNERS if dashed or not weighed or len(table.ids) <= FEW else CORNERS // 2
        drawn: Outline = ellipses(table.place, (table.codes == COASTING) & dashed, corners)
        z = np.repeat(table.place.z[drawn.owner], drawn.lengths)
        looks: dict[str, Any] = {}
        if weighed:
            classes = levels(table)[drawn.owner]
            looks = {"classes": classes, "widths": WIDTH * (0.2 + 0.8 * classes / (LEVELS - 1))}
        self._columns.lines(f"{path}/ellipses", stamp, self._lines(drawn.xy, z, drawn.lengths, **looks))

    def _trail(self, path: str, new: Table, time: int, keep: int, stamp: Stamp) -> Table:
        """Draw a line from each track's place before to its place in `new`, and see `_hold`."""
        old = self._tables.get(path)
        if old is not None and old.epoch == new.epoch and len(old.ids) and time >= old.times.max():
            _, before, after = np.intersect1d(old.ids, new.ids, assume_unique=True, return_indices=True)
            ends = np.stack([old.place.xy[before], new.place.xy[after]], axis=1).reshape(-1, 2)
            z = np.stack([old.place.z[before], new.place.z[after]], axis=1).reshape(-1)
            pieces = self._lines(ends, z, np.full(len(before), 2))
            self._columns.lines(f"{path}/trail", stamp, pieces, stands=False)
        return self._hold(path, new, new.ids, time, keep)

    def _hold(self, path: str, new: Table, listed: U64, time: int, keep: int) -> Table:
        """What is drawn now: `new`, and what was known at most `keep` ns ago of tracks that are not `listed`. A
        message older than the last is drawn alone, at its own time."""
        old = self._tables.get(path)
        if old is not None and old.epoch == new.epoch and len(old.ids) and time < old.times.max():
            return new
        if keep:
            new = hold(old, new, listed, time - keep)
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
        for name, colour in self.centres.items():
            path = entity("picture", "global", name)
            if self._tones.get(path) != colour:
                self._style(path, colour, radius=4.5, width=WIDTH, alpha=255, labels=True, weighed=True)
        for name, colour in screen_source_colours(self.sources).items():
            if self.colours.get(name) == colour:
                continue
            self.colours[name] = colour
            self._style(self.sources[name], colour, radius=2.5, width=0.75, alpha=130, labels=False)
            path = entity("picture", "sensors", name)
            self._columns.static(path, *_both(self._rr, "Points", colors=[packed(colour)], radii=[-6.0]))
            edge = _both(self._rr, "Lines", colors=[packed(colour, 110)], radii=[-0.75])
            self._columns.static(f"{path}/coverage", *edge)
            for centre, source in self.linked:
                if source == name:
                    self._style_links(centre, source)

    def _style_links(self, centre: str, source: str) -> None:
        """Thin, under the tracks."""
        tone = packed(self.colours.get(source, SCREEN_NEUTRAL), LINK)
        path = _links_path(centre, source)
        self._columns.static(path, *_both(self._rr, "Lines", colors=[tone], radii=[-0.5]))
        self._columns.static(path, self._rr.LineStrips2D.from_fields(draw_order=10.0))

    def _style(
        self,
        path: str,
        colour: Colour,
        *,
        radius: float,
        width: float,
        alpha: int,
        labels: bool,
        weighed: bool = False,
    ) -> None:
        """What all rows of an entity, its ellipses and its trail share; sizes in points of the screen."""
        rr, static = self._rr, self._columns.static
        self._tones[path] = colour
        alphas = np.linspace(FAINTEST, 255, LEVELS).round().astype(int).tolist()
        shades = [packed(colour, opacity) for opacity in alphas]
        static(path, rr.AnnotationContext([rr.AnnotationInfo(k, color=shade) for k, shade in enumerate(shades)]))
        static(path, *_both(rr, "Points", radii=[-radius]))
        static(path, rr.Points2D.from_fields(show_labels=labels))
        faint = packed(colour, alpha)
        edge = _both(rr, "Lines", colors=[faint], radii=[-width])
        if weighed:  # what is static counts, whatever the rows say
            edge = (rr.GeoLineStrings.from_fields(colors=[faint]),)
        static(f"{path}/ellipses", *edge)
        static(f"{path}/trail", *_both(rr, "Lines", colors=[faint], radii=[-0.75 * width]))
        for part in self._mixed.intersection((f"{path}/components", f"{path}/intensity")):
            self._style_components(part)

    def _style_components(self, path: str) -> None:
        """Under the tracks; the colours of their entity, once it has one."""
        rr, static = self._rr, self._columns.static
        if (colour := self._tones.get(path.rpartition("/")[0])) is None:
            return
        static(path, *_both(rr, "Points", radii=[-2.0]))
        static(path, rr.Points2D.from_fields(show_labels=False, draw_order=12.0))
        static(f"{path}/ellipses", rr.GeoLineStrings.from_fields(colors=[packed(colour)]))
        static(f"{path}/ellipses", rr.LineStrips2D.from_fields(draw_order=11.0))

    def _grow(self, xy: FloatArray, *, main: bool) -> None:
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
        rr, tone = self._rr, packed(SCREEN_GRID)
        plane = [line * (1, -1) for line in lines]
        self._columns.static("/grid", rr.LineStrips2D(plane, colors=[tone], radii=[-0.5], draw_order=1.0))
        corner = centre - 0.94 * half
        places = [np.where(line[0] == line[1], line[0], corner) * (1, -1) for line in lines]
        text = packed(SCREEN_TRUTH)
        self._columns.static("/grid/labels", rr.Points2D(places, labels=labels, colors=[text], radii=[-0.5]))

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray] | None:
        """South-west and north-east corner (2,) of the square that is seen at first, m: all that the grid covers, or
        the path of the `focus`."""
        return self._sight or self._grid


def _as_of(told: Sequence[Table], time: int) -> Table | None:
    """The newest of `told`, in the order they came, that is not of after `time`."""
    past = [table for table in told if not len(table.ids) or table.times.max() <= time]
    return past[-1] if past else None


def _remember(held: deque[T], item: T, tracks: int) -> None:
    """Add `item`, and drop the oldest so that at most `TOLD` stay, and no more than `TOLD_TRACKS` if all have `tracks`
    tracks."""
    held.append(item)
    while len(held) > max(1, min(TOLD, TOLD_TRACKS // max(tracks, 1))):
        held.popleft()


def _links_path(centre: str, source: str) -> str:
    return entity("picture", "global", centre, "links", source)


def _both(rr: Any, kind: str, **fields: Any) -> tuple[Any, ...]:
    plane, geo = {"Points": (rr.Points2D, rr.GeoPoints), "Lines": (rr.LineStrips2D, rr.GeoLineStrings)}[kind]
    return plane.from_fields(**fields), geo.from_fields(**fields)
