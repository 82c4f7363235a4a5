"""Time series beside the picture: errors, NEES, counts and influence.

/error/{centre}/{target}              distance to the track assigned to each true object, m
/nees/{centre}/{target}               NEES of the position / dimension, with .../bounds/low and high
/anees/{centre}/mean                  its mean over the targets, with bounds for their number
/counts/local/{source}  /counts/{centre}/{status}  /influence/{centre}/{source}
/counts/local/{source}/mass           expected number of objects, of an intensity
/counts/{centre}/by/{way}             tracks fused in this way, where not all are by the rule
/existence/{centre}/{track}           existence of each track, from when it is confirmed on
/track/{centre}/...                   with a `focus`: error, nees with bounds, existence, sigma (m) and
                                      influence/{source} of this one track

A colour means the same in all parts of a recording: it follows from the name, or the id.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fusion_service import metrics
from fusion_service.colours import (
    SCREEN_FUSED,
    SCREEN_NEUTRAL,
    SCREEN_TRUTH,
    SCREEN_WARNING,
    Colour,
    marker_of,
    series_colour,
    shade,
)
from fusion_service.recording.columns import ColumnWriter, Stamp, entity, import_rerun
from fusion_service.recording.drawing.errors import StepErrors
from fusion_service.recording.drawing.geometry import track_moments
from fusion_service.ways import fused_by
from schemas import STATUSES, GlobalTracks, LocalIntensity, LocalTracks
from schemas.messages import TENTATIVE

__all__ = ["Charts"]

LEGIBLE = 6
"""Series of a chart that has a legend."""
MAX_WAYS = 16
"""Ways of fusion of a centre that have a series."""
MAX_RUNNING = 100
MAX_SERIES = 1000
"""Series of existence of one centre: at a time (each takes Rerun memory as long as it runs), and in all; of targets
in all. A new part of the recording counts anew."""


class Charts:
    """Turns messages and errors into points of time series, each with its colour and name."""

    def __init__(self, columns: ColumnWriter, focus: int | None = None) -> None:
        self._rr = import_rerun()
        self._columns = columns
        self._focus = focus
        self._styles: dict[str, tuple[Colour, str, float]] = {}
        self._targets: set[int] = set()
        self._series: dict[str, set[int]] = {}
        self._ways: dict[str, list[str]] = {}

    @property
    def crowded(self) -> bool:
        """Whether a legend would hide more than it tells."""
        return max(len(self._targets), *(len(known) for known in self._series.values()), 0) > LEGIBLE

    @property
    def assessed(self) -> bool:
        """Whether anything was compared with a truth."""
        return bool(self._targets)

    def restart(self) -> None:
        """A new part of the recording begins: every series says its style again."""
        self._styles.clear()
        self._targets.clear()
        self._series.clear()

    def local(self, message: LocalTracks | LocalIntensity, colours: dict[str, Colour], stamp: Stamp) -> None:
        """How many tracks, or objects expected, a source has."""
        path, name = entity("counts", "local", message.source), message.source
        tone = colours.get(message.source, SCREEN_NEUTRAL)
        if isinstance(message, LocalTracks):
            self._add(path, stamp, len(message.ids), tone, name)
        else:
            self._add(f"{path}/mass", stamp, float(message.weights.sum()), tone, f"{name}: mass")

    def step(
        self,
        message: GlobalTracks,
        colours: dict[str, Colour],
        centres: dict[str, Colour],
        label: Callable[[int], str],
        stamp: Stamp,
    ) -> int:
        """Returns how many confirmed tracks have no series of existence, because there are enough."""
        centre, own = message.source, centres.get(message.source, SCREEN_FUSED)
        counts = np.bincount(message.status, minlength=len(STATUSES))
        tones = (SCREEN_TRUTH, own, SCREEN_WARNING)
        if own != SCREEN_FUSED:
            tones = (shade(own, 0.45), own, shade(own, 0.7))
        for name, count, tone in zip(STATUSES, counts.tolist(), tones, strict=True):
            self._add(entity("counts", centre, name), stamp, count, tone, f"{centre}: {name}", 2.0)
        self._fused_by(message, own, stamp)
        influence = message.contributor_influence
        index = message.contributor_source.astype(np.intp)[np.isfinite(influence)]
        number = np.bincount(index, minlength=len(message.sources))
        total = np.bincount(index, weights=influence[np.isfinite(influence)], minlength=len(message.sources))
        for name, n, part in zip(message.sources, number.tolist(), total.tolist(), strict=True):
            tone = colours.get(name, SCREEN_NEUTRAL)
            self._add(entity("influence", centre, name), stamp, part / n if n else np.nan, tone, name)
        if self._focus is not None:
            self._follow(message, self._focus, colours, own, stamp)
        return self._existence(message, label, stamp)

    def _fused_by(self, message: GlobalTracks, own: Colour, stamp: Stamp) -> None:
        """How many tracks with a source were fused in each way, once not all are by the rule."""
        names, which = fused_by(message)
        known = self._ways.setdefault(message.source, [])
        if message.rules is not None:
            known += [name for name in names if name not in known][: MAX_WAYS - len(known)]
        there = np.bincount(which[message.contributor_counts > 0], minlength=len(names)).tolist()
        counts = dict(zip(names, there, strict=True))
        for number, name in enumerate(known):
            path, tone = entity("counts", message.source, "by", name), shade(own, 0.85 - 0.15 * min(number, 4))
            self._add(path, stamp, counts.get(name, 0), tone, f"{message.source}: by {name}")

    def _existence(self, message: GlobalTracks, label: Callable[[int], str], stamp: Stamp) -> int:
        known = self._series.setdefault(message.source, set())
        ids = message.ids.tolist()
        begun = sum(track in known for track in ids)
        rest = message.ids[message.status != TENTATIVE].tolist()
        new = [track for track in rest if track not in known]
        room = max(min(MAX_RUNNING - begun, MAX_SERIES - len(known)), 0)
        known.update(new[:room])
        for track, value in zip(ids, message.existence.tolist(), strict=True):
            if track in known:
                name = label(track)
                path = entity("existence", message.source, name)
                self._add(path, stamp, value, _tone(track), f"track {name}")
        return max(len(new) - room, 0)

    def _follow(
        self,
        message: GlobalTracks,
        track: int,
        colours: dict[str, Colour],
        own: Colour,
        stamp: Stamp,
    ) -> None:
        centre = message.source
        for row in np.flatnonzero(message.ids == np.uint64(track)).tolist():
            self._add(entity("track", centre, "existence"), stamp, float(message.existence[row]), own, "existence", 2.0)
            index = [message.space.index(name) for name in "xyz" if name in message.space]
            spread = track_moments(message)[1][row][np.ix_(index, index)]
            self._add(
                entity("track", centre, "sigma"), stamp, float(np.sqrt(np.trace(spread))), SCREEN_NEUTRAL, "sigma"
            )
            first = int(message.contributor_counts[:row].sum())
            contributions = slice(first, first + int(message.contributor_counts[row]))
            which = message.contributor_source[contributions].tolist()
            shares = dict(zip(which, message.contributor_influence[contributions].tolist(), strict=True))
            for number, name in enumerate(message.sources):
                path, tone = entity("track", centre, "influence", name), colours.get(name, SCREEN_NEUTRAL)
                if number in shares or path in self._styles:
                    self._add(path, stamp, shares.get(number, np.nan), tone, name, 2.0)

    def errors(self, found: StepErrors, centres: dict[str, Colour]) -> int:
        """Returns how many targets have no series, because there are enough."""
        centre, stamp, left_out = found.centre, found.stamp, 0
        own = centres.get(centre, SCREEN_FUSED)
        for target, error, nees in zip(found.ids.tolist(), found.error.tolist(), found.nees.tolist(), strict=True):
            if target not in self._targets and len(self._targets) >= MAX_SERIES:
                left_out += 1
                continue
            self._targets.add(target)
            tone, name = _tone(target), f"target {target}"
            self._add(entity("error", centre, str(target)), stamp, error, tone, name)
            self._add(entity("nees", centre, str(target)), stamp, nees, tone, name)
        single = metrics.nees_bounds(found.dimension, 1)
        charts = [("nees", single), ("anees", found.bounds)]
        for path, (low, high) in charts:
            self._bounds(entity(path, centre, "bounds"), (low, high), stamp)
        mean = float(np.nanmean(found.nees)) if found.assigned else np.nan
        name = "mean NEES" if len(centres) < 2 else f"{centre}: mean NEES"
        self._add(entity("anees", centre, "mean"), stamp, mean, own, name, 2.5)
        if self._focus is not None:
            for row in np.flatnonzero(found.tracks == np.uint64(self._focus)).tolist():
                name = f"to target {int(found.ids[row])}"
                path = entity("track", centre, "error", str(int(found.ids[row])))
                self._add(path, stamp, float(found.error[row]), own, name, 2.0)
                self._add(entity("track", centre, "nees", "track"), stamp, float(found.nees[row]), own, "NEES", 2.0)
                self._bounds(entity("track", centre, "nees", "bounds"), single, stamp)
        return left_out

    def _bounds(self, path: str, limits: tuple[float, float], stamp: Stamp) -> None:
        for name, value in zip(("low", "high"), limits, strict=True):
            self._add(f"{path}/{name}", stamp, value, SCREEN_NEUTRAL, f"95 % {name}", 2.0)

    def _add(self, path: str, stamp: Stamp, value: float, colour: Colour, name: str, width: float = 1.25) -> None:
        style = (colour, name, width)
        if self._styles.get(path) != style:
            self._styles[path] = style
            self._columns.static(path, self._rr.SeriesLines(colors=[colour], names=[name], widths=[width]), keep=False)
            if (marker := marker_of(colour)) is not None:
                self._columns.static(path, self._rr.SeriesPoints(colors=[colour], markers=[marker]), keep=False)
        self._columns.scalar(path, stamp, value)


def _tone(number: int) -> Colour:
    """Of a track or target, by its counter."""
    return series_colour(number % (1 << 16))
