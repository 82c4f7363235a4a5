"""How far each source is trusted, and how it is shifted beside the others, as its centre says.

/consistency/{centre}/{source}            mean normalised square beside the others, 1 is right; .../bounds/low and high
/clock/{centre}/{source}                  offset of its clock, s, with .../{source}/low and high, two sigma
/registration/{centre}/{source}           a cross where its place is off (east, north, m), its arms two sigma long
/registration/{centre}/zero               where a source without an error would be
"""

from __future__ import annotations

import numpy as np

from fusion_service.colours import SCREEN_NEUTRAL, Colour, marker_of, shade
from fusion_service.recording.columns import ColumnWriter, Lines, Points, Stamp, entity, import_rerun
from fusion_service.source_words import MOST_SIGMAS, Bias, biases, consistency
from schemas import Status

__all__ = ["SourceCharts"]

MAX_SOURCES = 100
"""Sources of one centre that are drawn."""
FAINT = 0.5


class SourceCharts:
    """Turns statuses into series and crosses. `seen`: whether there was anything to show."""

    def __init__(self, columns: ColumnWriter) -> None:
        self._rr = import_rerun()
        self._columns = columns
        self._styles: dict[str, tuple[Colour, str]] = {}
        self.seen = False

    def restart(self) -> None:
        """A new part of the recording begins: every series says its style again."""
        self._styles.clear()

    def status(self, message: Status, colours: dict[str, Colour], stamp: Stamp) -> None:
        """Add what a status says of its sources."""
        centre = message.source
        limits: list[tuple[float, float]] = []
        for name, said in list(message.sources.items())[:MAX_SOURCES]:
            tone = colours.get(name, SCREEN_NEUTRAL)
            if (found := consistency(said)) is not None:
                self._series(entity("consistency", centre, name), stamp, found[0], tone, name)
                limits.append(found[1:])
            parts = {one.key: one for one in biases(said) if one.observable}
            if "clock" in parts:
                self._clock(centre, name, parts["clock"], tone, stamp)
            if "x" in parts and "y" in parts:
                self._cross(centre, name, parts, tone, stamp)
        if limits:
            low, high = min(one[0] for one in limits), max(one[1] for one in limits)
            for end, value in (("low", low), ("high", high)):
                path = entity("consistency", centre, "bounds", end)
                self._series(path, stamp, value, SCREEN_NEUTRAL, f"bound, {end}")

    def _clock(self, centre: str, name: str, one: Bias, tone: Colour, stamp: Stamp) -> None:
        path = entity("clock", centre, name)
        self._series(path, stamp, one.value, tone, name)
        for end, side in (("low", -MOST_SIGMAS), ("high", MOST_SIGMAS)):
            self._series(f"{path}/{end}", stamp, one.value + side * one.sigma, shade(tone, FAINT), f"{name}, {end}")

    def _cross(self, centre: str, name: str, parts: dict[str, Bias], tone: Colour, stamp: Stamp) -> None:
        """East right and north up, as in the picture."""
        x, y = parts["x"], parts["y"]
        at = np.array([x.value, -y.value])
        ends = MOST_SIGMAS * np.array([[-x.sigma, 0.0], [x.sigma, 0.0], [0.0, -y.sigma], [0.0, y.sigma]])
        path = entity("registration", centre, name)
        if self._style(path, tone, name):
            colour = self._rr.LineStrips2D.from_fields(colors=[tone], radii=[-1.5])
            self._columns.static(path, colour)
            self._columns.static(f"{path}/place", self._rr.Points2D.from_fields(colors=[tone], radii=[-4.0]))
        self._columns.lines(path, stamp, Lines(at + ends, None, np.array([2, 2])))
        self._columns.points(f"{path}/place", stamp, Points(at[None], None, [f"{name}: {x}, {y}"]))
        zero = entity("registration", centre, "zero")
        if self._style(zero, SCREEN_NEUTRAL, "zero"):
            self._columns.static(
                zero, self._rr.Points2D([[0.0, 0.0]], colors=[SCREEN_NEUTRAL], radii=[-3.0], labels=["no error"])
            )

    def _style(self, path: str, tone: Colour, name: str) -> bool:
        """Whether the entity has to say how it looks."""
        self.seen = True
        new = self._styles.get(path) != (tone, name)
        self._styles[path] = tone, name
        return new

    def _series(self, path: str, stamp: Stamp, value: float, tone: Colour, name: str) -> None:
        if self._style(path, tone, name):
            self._columns.static(path, self._rr.SeriesLines(colors=[tone], names=[name], widths=[1.5]), keep=False)
            if (marker := marker_of(tone)) is not None:
                self._columns.static(path, self._rr.SeriesPoints(colors=[tone], markers=[marker]), keep=False)
        self._columns.scalar(path, stamp, value)
