"""Time series beside the picture: errors, NEES, counts and influence.

/error/{centre}/{target}              distance to the track assigned to each true object, m
/nees/{centre}/{target}               NEES of the position / dimension, with .../bounds/low and high
/anees/{centre}/mean                  its mean over the targets, with bounds for their number
/counts/local/{source}  /counts/{centre}/{status}  /influence/{centre}/{source}
/counts/local/{source}/mass           expected number of objects, of an intensity
/existence/{centre}/{track}           existence of each track, from when it is confirmed on
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fusion_service import metrics
from fusion_service.recording import palette
from fusion_service.recording.assessment import Score
from fusion_service.recording.columns import Columns, Stamp, entity, import_rerun
from schemas import STATUSES, GlobalTracks, LocalIntensity, LocalTracks
from schemas.messages import TENTATIVE

__all__ = ["Charts"]

MAX_RUNNING = 100
MAX_SERIES = 1000
"""Series of existence of one centre: at a time (each takes Rerun memory as long as it runs), and in all."""


class Charts:
    """Turns messages and scores into points of time series, each with its colour and name."""

    def __init__(self, columns: Columns) -> None:
        self._rr = import_rerun()
        self._columns = columns
        self._styles: dict[str, tuple[palette.Colour, str, float]] = {}
        self._targets: dict[int, int] = {}
        self._series: dict[str, dict[int, int]] = {}

    def local(self, message: LocalTracks | LocalIntensity, colours: dict[str, palette.Colour], stamp: Stamp) -> None:
        path, name = entity("counts", "local", message.source), message.source
        tone = colours.get(message.source, palette.NEUTRAL)
        if isinstance(message, LocalTracks):
            self._add(path, stamp, len(message.ids), tone, name)
        else:
            self._add(f"{path}/mass", stamp, float(message.weights.sum()), tone, f"{name}: mass")

    def step(self, message: GlobalTracks, colours: dict[str, palette.Colour], stamp: Stamp) -> None:
        centre = message.source
        counts = np.bincount(message.status, minlength=len(STATUSES))
        tones = (palette.TRUTH, palette.FUSED, palette.WARNING)
        for name, count, tone in zip(STATUSES, counts.tolist(), tones, strict=True):
            self._add(entity("counts", centre, name), stamp, count, tone, f"{centre}: {name}", 2.0)
        influence = message.contributor_influence
        index = message.contributor_source.astype(np.intp)[np.isfinite(influence)]
        number = np.bincount(index, minlength=len(message.sources))
        total = np.bincount(index, weights=influence[np.isfinite(influence)], minlength=len(message.sources))
        for name, n, part in zip(message.sources, number.tolist(), total.tolist(), strict=True):
            tone = colours.get(name, palette.NEUTRAL)
            self._add(entity("influence", centre, name), stamp, part / n if n else np.nan, tone, name)

    def existence(self, message: GlobalTracks, label: Callable[[int], str], stamp: Stamp) -> int:
        """Returns how many confirmed tracks have no series, because there are enough."""
        known = self._series.setdefault(message.source, {})
        ids = message.ids.tolist()
        begun = [track for track in ids if track in known]
        rest = message.ids[message.status != TENTATIVE].tolist()
        new = [track for track in rest if track not in known]
        room = max(min(MAX_RUNNING - len(begun), MAX_SERIES - len(known)), 0)
        known.update((track, len(known) + k) for k, track in enumerate(new[:room]))
        for track, value in zip(ids, message.existence.tolist(), strict=True):
            if (number := known.get(track)) is not None:
                name = label(track)
                path = entity("existence", message.source, name)
                self._add(path, stamp, value, palette.series_colour(number), f"track {name}")
        return max(len(new) - room, 0)

    def score(self, score: Score) -> None:
        centre, stamp = score.centre, score.stamp
        for target, error, nees in zip(score.ids.tolist(), score.error.tolist(), score.nees.tolist(), strict=True):
            tone = palette.series_colour(self._targets.setdefault(target, len(self._targets)))
            name = f"target {target}"
            self._add(entity("error", centre, str(target)), stamp, error, tone, name)
            self._add(entity("nees", centre, str(target)), stamp, nees, tone, name)
        single = metrics.nees_bounds(score.dimension, 1)
        for chart, (low, high) in (("nees", single), ("anees", score.bounds)):
            for name, value in (("low", low), ("high", high)):
                self._add(entity(chart, centre, "bounds", name), stamp, value, palette.NEUTRAL, f"95 % {name}", 2.0)
        mean = float(np.nanmean(score.nees)) if score.assigned else np.nan
        self._add(entity("anees", centre, "mean"), stamp, mean, palette.FUSED, "mean NEES", 2.5)

    def _add(
        self, path: str, stamp: Stamp, value: float, colour: palette.Colour, name: str, width: float = 1.25
    ) -> None:
        style = (colour, name, width)
        if self._styles.get(path) != style:
            self._styles[path] = style
            self._columns.static(path, self._rr.SeriesLines(colors=[colour], names=[name], widths=[width]))
        self._columns.scalar(path, stamp, value)
