"""The picture: sensors, tracks of every source, global tracks and truth, on a map and on a plane alike.

Entities, each with its places on the plane and, where the frame allows, on the map:

    /picture/sensors/{source}            position and name;  .../coverage  edges of the field of view
    /picture/local/{source}              latest tracks;      .../ellipses  95 % of the position;  .../trail
    /picture/global/{centre}             the same, labelled with the id; faint: tentative, dashed: coasting
    .../components                       the Gaussians of the tracks that are mixtures;  .../ellipses
    /picture/local/{source}/intensity    those of an intensity;                          .../ellipses
    /picture/global/{centre}/links/...   lines from the local tracks of each source to the global ones: `links`
    /picture/truth/{scenario}            true positions;     .../trail
    .../hull                             of tracks and truth that tell their extent: `hulls`

A trail is one short line per track and message; how much of it is seen is a setting of the view. A track is drawn by
the moments of its mixture, over its components.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats
from fusion_service.colours import SCREEN_NEUTRAL, SCREEN_TRUTH, Colour, centre_colours, screen_source_colours
from fusion_service.coverage import at_platform
from fusion_service.geodesy import FrameError
from fusion_service.labels import Labels
from fusion_service.recording.columns import ColumnWriter, Stamp, entity
from fusion_service.recording.drawing.canvas import WIDTH, Canvas
from fusion_service.recording.drawing.extent import Corners, Extent
from fusion_service.recording.drawing.focus import FocusView
from fusion_service.recording.drawing.geometry import Chart, outline, track_moments
from fusion_service.recording.drawing.hulls import Hulls
from fusion_service.recording.drawing.links import links, links_path
from fusion_service.recording.drawing.styles import Styles
from fusion_service.recording.drawing.tables import Table, drawn_components, remember, tabulate
from schemas import Frame, GlobalTracks, LocalIntensity, LocalTracks, SensorInfo, Truth

__all__ = ["Drawing"]

DEFAULT_PERIOD = 10.0
KEPT_PERIODS = 3.0
"""How long, in periods of its source, a track stays drawn that an incomplete message does not list."""


class Drawing:
    """Turns messages into rows of `columns`. `chart` must be set before anything but `open_chart` is called.

    focus: the global track about whose path the view is, None for the whole picture. changed: whether the view is to
    be told anew. sources: the entity of each; trails: entities; colours, centres: of sources and of centres.
    """

    def __init__(self, columns: ColumnWriter, frame: Frame | None = None, focus: int | None = None) -> None:
        self._canvas = Canvas(columns, frame)
        self._styles = Styles(columns)
        self._extent = Extent(columns)
        self._hulls = Hulls(self._canvas, self._styles)
        self._focus = None if focus is None else FocusView(focus, self._canvas, self._styles)
        self.trails: list[str] = []
        self.sources: dict[str, str] = {}
        self.colours: dict[str, Colour] = {}
        self.centres: dict[str, Colour] = {}
        self.label = Labels()
        self.changed = True
        self._told: dict[str, deque[Table]] = {}
        self._linked: set[tuple[str, str]] = set()
        self._scenarios: dict[str, str] = {}
        self._recolour = False
        self._info: dict[str, SensorInfo] = {}

    @property
    def chart(self) -> Chart | None:
        """The frame of the drawing, None while nothing has said one."""
        return self._canvas.chart

    @property
    def bounds(self) -> Corners | None:
        """South-west and north-east corner (2,) of the square that is seen at first, m: all that the grid covers, or
        the path of the `focus`."""
        return (self._focus.sight if self._focus is not None else None) or self._extent.square

    @property
    def reach(self) -> float:
        """Half the width, m, of the view that goes along with the `focus`."""
        return self._focus.reach if self._focus is not None else 1.0

    def open_chart(self, message: LocalTracks | LocalIntensity | GlobalTracks | SensorInfo | Truth) -> None:
        """Draw in the frame of `message` from now on."""
        near = None
        if isinstance(message, SensorInfo):
            near = message.position
        elif "z" in message.space and len(message.means):
            x, y, z = (float(message.means[0, message.space.index(name)]) for name in "xyz")
            near = x, y, z
        self._canvas.chart = Chart(message.frame, near)

    def sensor(self, info: SensorInfo, stamp: Stamp) -> None:
        """Position, name and field of view, once and whenever they change. Raises `geodesy.FrameError`, as the other
        methods do, where the message's frame has no relation to the chart's."""
        old = self._info.get(info.source)
        self._info[info.source] = info
        if old is not None and (old.position, old.frame, old.coverage) == (info.position, info.frame, info.coverage):
            return
        self._source(info.source)
        path, canvas = entity("picture", "sensors", info.source), self._canvas
        place = canvas.placing.place(np.array([info.position]), np.zeros((1, 3, 3)), ("x", "y", "z"), info.frame)
        edges, frame = outline(info)
        if not np.isfinite(place.xy).all():
            raise FrameError("its sensor has no place on Earth")
        self._grow(place.xy, main=True)
        canvas.points(path, place, [info.source], stamp)
        moved = [canvas.placing.place(edge, np.zeros((len(edge), 2, 2)), ("x", "y"), frame) for edge in edges]
        xy = np.concatenate([np.zeros((0, 2)), *(part.xy for part in moved)])
        z = np.concatenate([np.zeros(0), *(part.z for part in moved)])
        canvas.lines(f"{path}/coverage", xy, z, np.array([len(edge) for edge in edges], dtype=np.int64), stamp)

    def local_tracks(self, message: LocalTracks, sound: NDArray[np.bool_], stamp: Stamp) -> int:
        """`sound` (T,): the tracks that are drawn. Returns how many components are too many to draw."""
        self._source(message.source)
        means, covariances = track_moments(message)
        place = self._canvas.placing.place(
            means[sound], covariances[sound], message.space, message.frame, message.height
        )
        if message.platform is not None and message.source in self._info:
            self.sensor(at_platform(self._info[message.source], message.platform, message.frame), stamp)
        ids = message.ids[sound]
        mass = None if message.existence is None else message.existence[sound]
        table = tabulate(message.epoch, message.time, ids, place, mass=mass)
        if self._focus is not None:
            self._focus.hear(message, sound)
        self._grow(table.place.xy, main=False)
        path = self.sources[message.source]
        period = self._info[message.source].period if message.source in self._info else DEFAULT_PERIOD
        keep = 0 if message.complete else round(KEPT_PERIODS * period * 1e9)
        over = self._components(f"{path}/components", message, sound, stamp, keep)
        table = self._canvas.trail(path, table, message.time, keep, stamp)
        remember(self._told.setdefault(message.source, deque()), table, len(table.ids))
        self._canvas.tracks(path, table, [str(track) for track in table.ids.tolist()], stamp)
        self._canvas.ellipses(path, table, stamp)
        self._hulls.draw(path, message, table, stamp)
        return over

    def intensity(self, message: LocalIntensity, sound: NDArray[np.bool_], stamp: Stamp) -> int:
        """`sound` (C,): the components that are drawn. Returns how many are too many to draw."""
        self._source(message.source)
        return self._components(f"{self.sources[message.source]}/intensity", message, sound, stamp)

    def global_tracks(self, message: GlobalTracks, sound: NDArray[np.bool_], stamp: Stamp) -> int:
        """`sound` (T,): the tracks that are drawn. Returns how many components are too many to draw."""
        means, covariances = track_moments(message)
        place = self._canvas.placing.place(means[sound], covariances[sound], message.space, message.frame)
        status, mass = message.status[sound], message.existence[sound]
        table = tabulate(message.epoch, message.time, message.ids[sound], place, status, mass)
        self._grow(table.place.xy, main=True)
        path = entity("picture", "global", message.source)
        if self._first(path):
            self.centres = centre_colours([*self.centres, message.source])
            self._recolour = True
        over = self._components(f"{path}/components", message, sound, stamp)
        table = self._canvas.trail(path, table, message.time, 0, stamp)
        self._canvas.tracks(path, table, [self.label(track) for track in table.ids.tolist()], stamp)
        self._canvas.ellipses(path, table, stamp, weighed=True, dashed=True)
        self._hulls.draw(path, message, table, stamp)
        self._links(message, table, stamp)
        if self._focus is not None:
            tables = self._canvas.tables
            truth = {name: tables[own] for name, own in self._scenarios.items() if own in tables}
            self.changed |= self._focus.follow(table)
            self.changed |= self._focus.step(message, table, truth, (self.colours, self.centres), self.label, stamp)
        return over

    def truth(self, message: Truth, stamp: Stamp) -> None:
        """True positions, and their trail."""
        n = len(message.space)
        place = self._canvas.placing.place(
            message.means, np.zeros((len(message.ids), n, n)), message.space, message.frame
        )
        table = tabulate(message.epoch, message.time, message.ids, place)
        self._grow(table.place.xy, main=True)
        path = self._scenarios[message.source] = entity("picture", "truth", message.source)
        if self._first(path):
            self._styles.tracks(path, SCREEN_TRUTH, radius=2.0, width=0.5, alpha=255, labels=False)
        table = self._canvas.trail(path, table, message.time, 0, stamp)
        self._canvas.tracks(path, table, [f"target {track}" for track in table.ids.tolist()], stamp)
        self._hulls.draw(path, message, table, stamp)

    def clear(self, source: str, stamp: Stamp) -> None:
        """Draw no tracks of `source` until it sends again."""
        own = entity("picture", "local", source)
        self._told.pop(source, None)
        self._hulls.clear(own, stamp)
        for path in (own, f"{own}/components", f"{own}/intensity"):
            table = self._canvas.tables.pop(path, None)
            if table is not None:
                nothing = table.part(np.zeros(0, dtype=np.intp))
                self._canvas.tracks(path, nothing, [], stamp)
                self._canvas.ellipses(path, nothing, stamp, weighed=path != own)

    def colour_sources(self) -> None:
        """Give each source its colour; a new one may change those of others."""
        if not self._recolour:
            return
        self._recolour = False
        for name, colour in self.centres.items():
            path = entity("picture", "global", name)
            if not self._styles.has(path, colour):
                self._styles.tracks(path, colour, radius=4.5, width=WIDTH, alpha=255, labels=True, weighed=True)
        for name, colour in screen_source_colours(self.sources).items():
            if self.colours.get(name) == colour:
                continue
            self.colours[name] = colour
            self._styles.tracks(self.sources[name], colour, radius=2.5, width=0.75, alpha=130, labels=False)
            self._styles.sensor(name, colour)
            for centre, source in self._linked:
                if source == name:
                    self._styles.links(centre, source, colour)

    def _links(self, message: GlobalTracks, table: Table, stamp: Stamp) -> None:
        known = ((name, _as_of(told, message.time)) for name, told in self._told.items())
        local = {name: table for name, table in known if table is not None}
        for name, ends, z in links(message, table, local):
            key = message.source, name
            if not len(ends) and key not in self._linked:
                continue
            if key not in self._linked:
                if name not in self.sources:
                    continue
                self._linked.add(key)
                self._styles.links(*key, self.colours.get(name, SCREEN_NEUTRAL))
            self._canvas.lines(links_path(*key), ends.reshape(-1, 2), z.reshape(-1), np.full(len(ends), 2), stamp)

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
        if not len(rows) and path not in self._canvas.tables:
            return 0
        height = None if isinstance(message, GlobalTracks) else message.height
        means, covariances = message.means[rows], message.covariances[rows]
        place = self._canvas.placing.place(means, covariances, message.space, message.frame, height)
        whole = isinstance(message, LocalIntensity)
        tracks = np.arange(len(sound), dtype=np.uint64) if isinstance(message, LocalIntensity) else message.ids
        codes = message.status[owner] if isinstance(message, GlobalTracks) else None
        table = tabulate(message.epoch, message.time, tracks[owner], place, codes, weights)
        if whole:
            self._grow(table.place.xy, main=False)
        self._styles.components(path)
        table = self._canvas.hold(path, table, tracks, message.time, keep)
        name = self.label if isinstance(message, GlobalTracks) else str
        pairs = zip(table.ids.tolist(), table.mass.tolist(), strict=True)
        labels = [f"{weight:.2f}" if whole else f"{name(track)}: {weight:.2f}" for track, weight in pairs]
        self._canvas.tracks(path, table, labels, stamp)
        self._canvas.ellipses(path, table, stamp, weighed=True)
        return over

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

    def _grow(self, xy: Floats, *, main: bool) -> None:
        self.changed |= self._extent.grow(xy, main=main)


def _as_of(told: Sequence[Table], time: int) -> Table | None:
    """The newest of `told`, in the order they came, that is not of after `time`."""
    past = [table for table in told if not len(table.ids) or table.times.max() <= time]
    return past[-1] if past else None
