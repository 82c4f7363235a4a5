"""What needs no truth: how often sources report, how late, and how far apart they see the same objects.

/rate/{source}                    messages per second of the mission, over its last `SPAN` messages
/offset/{centre}/{source}         s, by which its messages came after their time, as the centre's status says
/apart/{centre}/{a} - {b}         m, mean distance of the tracks of two sources that one global track is made of, both
                                  moved on to the time of the step by their velocities
"""

from __future__ import annotations

from collections import deque
from itertools import combinations

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.colours import SCREEN_NEUTRAL, Colour, marker_of, series_colour
from fusion_service.geodesy import FrameError
from fusion_service.recording.columns import ColumnWriter, Stamp, entity, import_rerun
from fusion_service.recording.drawing.focus import predicted
from fusion_service.recording.drawing.geometry import Chart
from fusion_service.recording.drawing.tables import remember
from schemas import GlobalTracks, LocalIntensity, LocalTracks, Status

__all__ = ["TrafficCharts"]

SPAN = 10
MAX_SOURCES = 100
MAX_PAIRS = 28
"""Pairs of sources of one centre that have a series: of the first eight."""


class TrafficCharts:
    """Turns messages into series."""

    def __init__(self, columns: ColumnWriter) -> None:
        self._rr = import_rerun()
        self._columns = columns
        self._styles: dict[str, tuple[Colour, str]] = {}
        self._times: dict[str, deque[int]] = {}
        self._told: dict[str, deque[LocalTracks]] = {}
        self._pairs: dict[str, dict[tuple[str, str], int]] = {}

    def restart(self) -> None:
        """A new part of the recording begins: every series says its style again."""
        self._styles.clear()

    def heard(self, message: LocalTracks | LocalIntensity, colours: dict[str, Colour], stamp: Stamp) -> None:
        """A message of a source."""
        name = message.source
        if name not in self._times and len(self._times) >= MAX_SOURCES:
            return
        if isinstance(message, LocalTracks):
            remember(self._told.setdefault(name, deque()), message, len(message.ids))
        times = self._times.setdefault(name, deque(maxlen=SPAN + 1))
        if times and message.time <= times[-1]:
            if message.time < times[0]:  # another run, or a clock set back
                times.clear()
            return
        times.append(message.time)
        if len(times) > 1:
            rate = (len(times) - 1) * 1e9 / (times[-1] - times[0])
            self._series(entity("rate", name), stamp, rate, colours.get(name, SCREEN_NEUTRAL), name)

    def status(self, message: Status, colours: dict[str, Colour], stamp: Stamp) -> None:
        """What a centre says of the delays of its sources."""
        for name, said in list(message.sources.items())[:MAX_SOURCES]:
            offset = said.get("offset")
            if isinstance(offset, float) and np.isfinite(offset):
                path = entity("offset", message.source, name)
                self._series(path, stamp, offset, colours.get(name, SCREEN_NEUTRAL), name)

    def step(self, message: GlobalTracks, chart: Chart, stamp: Stamp) -> None:
        """A picture, whole."""
        places = {}
        for index, name in enumerate(message.sources):
            found = self._places(message, index, name, chart)
            if found is not None:
                places[name] = found
        known = self._pairs.setdefault(message.source, {})
        for pair in combinations(sorted(places), 2):
            apart = np.linalg.norm(places[pair[0]] - places[pair[1]], axis=1)
            if not np.isfinite(apart).any() or (pair not in known and len(known) >= MAX_PAIRS):
                continue
            number = known.setdefault(pair, len(known))
            path, name = entity("apart", message.source, " - ".join(pair)), " - ".join(pair)
            self._series(path, stamp, float(np.nanmean(apart)), series_colour(number), name)

    def _places(self, message: GlobalTracks, index: int, name: str, chart: Chart) -> Floats | None:
        """Where the source sees each global track (T, 2), m, NaN where it does not; None where it sees none."""
        mine = np.flatnonzero(message.contributor_source == index)
        past = [one for one in self._told.get(name, ()) if one.time <= message.time]
        if not len(mine) or not past or not len(past[-1].ids):
            return None
        told = past[-1]
        owner = np.repeat(np.arange(len(message.ids)), message.contributor_counts)[mine]
        order = np.argsort(told.ids, kind="stable")
        wanted = message.contributor_id[mine]
        row = order[np.minimum(np.searchsorted(told.ids[order], wanted), len(order) - 1)]
        there = (told.ids[row] == wanted) & (message.contributor_epoch[mine] == np.uint64(told.epoch))
        if not there.any():
            return None
        means, covariances = predicted(told, message.time)
        try:
            place = chart.place(means, covariances, told.space, told.frame, told.height)
        except FrameError:
            return None
        found = np.full((len(message.ids), 2), np.nan)
        found[owner[there]] = place.xy[row[there]]
        return found

    def _series(self, path: str, stamp: Stamp, value: float, tone: Colour, name: str) -> None:
        if self._styles.get(path) != (tone, name):
            self._styles[path] = tone, name
            self._columns.static(path, self._rr.SeriesLines(colors=[tone], names=[name], widths=[1.5]), keep=False)
            if (marker := marker_of(tone)) is not None:
                self._columns.static(path, self._rr.SeriesPoints(colors=[tone], markers=[marker]), keep=False)
        self._columns.scalar(path, stamp, value)
