"""How entities look: what is static of each, on the plane and on the map, in the colour of its source or centre.

A colour can change when another source comes, so it is never in a row: rows say a class of opacity, and the classes'
colours are static. Sizes are in points of the screen.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fusion_service.colours import SCREEN_NEUTRAL, Colour, packed
from fusion_service.recording.columns import ColumnWriter, entity, import_rerun
from fusion_service.recording.drawing.links import links_path
from fusion_service.recording.drawing.tables import LEVELS

__all__ = ["Styles"]

FAINTEST = 40
"""Opacity of what hardly exists, of 255."""
LINK = 200
"""Opacity of the lines from local tracks to global ones."""


class Styles:
    """Writes what is static of entities into `columns`, when it is new or changes."""

    def __init__(self, columns: ColumnWriter) -> None:
        self._rr = import_rerun()
        self._columns = columns
        self._tones: dict[str, Colour] = {}
        self._mixed: set[str] = set()
        self._hulled: set[str] = set()

    def has(self, path: str, colour: Colour) -> bool:
        """Whether the tracks at `path` are drawn in `colour` already."""
        return self._tones.get(path) == colour

    def tracks(
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
        """What all rows of tracks, their ellipses and their trail share."""
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
        if path in self._hulled:
            self._hull(path)
        for part in self._mixed.intersection((f"{path}/components", f"{path}/intensity")):
            self._components(part)

    def components(self, path: str) -> None:
        """The components of the tracks above `path` are drawn there from now on: under the tracks, in their colour."""
        if path not in self._mixed:
            self._mixed.add(path)
            self._components(path)

    def hulls(self, path: str) -> None:
        """The tracks at `path` have hulls from now on: solid, in their colour."""
        if path not in self._hulled:
            self._hulled.add(path)
            self._hull(path)

    def _hull(self, path: str) -> None:
        if (colour := self._tones.get(path)) is not None:
            self._columns.static(f"{path}/hull", *_both(self._rr, "Lines", colors=[packed(colour)], radii=[-1.0]))

    def sensor(self, name: str, colour: Colour) -> None:
        """A sensor and the edges of its field of view."""
        path = entity("picture", "sensors", name)
        self._columns.static(path, *_both(self._rr, "Points", colors=[packed(colour)], radii=[-6.0]))
        edge = _both(self._rr, "Lines", colors=[packed(colour, 110)], radii=[-0.75])
        self._columns.static(f"{path}/coverage", *edge)

    def links(self, centre: str, source: str, colour: Colour = SCREEN_NEUTRAL) -> None:
        """Thin, under the tracks."""
        path, tone = links_path(centre, source), packed(colour, LINK)
        self._columns.static(path, *_both(self._rr, "Lines", colors=[tone], radii=[-0.5]))
        self._columns.static(path, self._rr.LineStrips2D.from_fields(draw_order=10.0))

    def _components(self, path: str) -> None:
        """Once their tracks have a colour."""
        rr, static = self._rr, self._columns.static
        if (colour := self._tones.get(path.rpartition("/")[0])) is None:
            return
        static(path, *_both(rr, "Points", radii=[-2.0]))
        static(path, rr.Points2D.from_fields(show_labels=False, draw_order=12.0))
        static(f"{path}/ellipses", rr.GeoLineStrings.from_fields(colors=[packed(colour)]))
        static(f"{path}/ellipses", rr.LineStrips2D.from_fields(draw_order=11.0))


def _both(rr: Any, kind: str, **fields: Any) -> tuple[Any, ...]:
    plane, geo = {"Points": (rr.Points2D, rr.GeoPoints), "Lines": (rr.LineStrips2D, rr.GeoLineStrings)}[kind]
    return plane.from_fields(**fields), geo.from_fields(**fields)
