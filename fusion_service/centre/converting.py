"""A step's messages made tables: small ones in a row that are alike are made together, and are the same as alone.

Many sources that say little cost what they are, not what a call is for each of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from fusion_service.centre import notes
from fusion_service.centre.batches import Checked
from fusion_service.centre.extents import tells_extent
from fusion_service.centre.frames import name_frame
from fusion_service.centre.heights import with_height
from fusion_service.centre.scans import message_tracks
from fusion_service.centre.tracks import Tracks, empty_tracks
from fusion_service.geodesy import FrameError
from fusion_service.records import columns_of, made
from schemas import Frame, Height, LocalTracks

if TYPE_CHECKING:
    from fusion_service.centre.intake import Intake

__all__ = ["Conversion"]

SMALL = 64
"""Tracks of a message up to which it is made a table together with others: beyond, copies cost more than calls."""
_Key = tuple[tuple[str, ...], Frame, Height]


class Conversion:
    """The tables of `runs`: messages that are taken together, each of one source, space, frame and height. They are to
    be asked for in order, which is that in which texts and lineages get their codes."""

    def __init__(self, runs: Sequence[list[Checked]], intake: Intake) -> None:
        self._runs, self._intake = runs, intake
        self._keys: list[_Key | None] = [None] * len(runs) if intake.frame is None else [*map(self._key, runs)]
        self._ready: dict[int, Tracks] = {}

    def of(self, place: int) -> tuple[list[LocalTracks], Tracks]:
        """The messages of a run, with their height, and their sound tracks. Raises `FrameError`."""
        (source, first, _), _ = self._runs[place][0]
        frame, space = self._intake.frame, self._intake.config.space
        if frame is None:
            raise FrameError(notes.unfit(name_frame(first.frame), space))
        if self._keys[place] is not None:
            if place not in self._ready:
                self._together(place)
            if place in self._ready:
                return [message for (_, message, _), _ in self._runs[place]], self._ready.pop(place)
        said = self._intake.declared(source)
        messages = [with_height(one, said.height, frame, space) for (_, one, _), _ in self._runs[place]]
        sound = [faults == 0 for _, faults in self._runs[place]]
        words = self._intake.said, self._intake.lineages
        most = self._intake.config.max_components
        return messages, message_tracks(messages, sound, frame, said.height, most, *words)

    def _key(self, run: list[Checked]) -> _Key | None:
        """What runs that are made tables together have in common; None of one that stands alone."""
        (source, first, _), _ = run[0]
        frame, height = self._intake.frame, self._intake.declared(source).height
        assert frame is not None
        for (_, message, _), _ in run:
            if len(message.ids) > SMALL or message.counts is not None or tells_extent(message):
                return None
        try:
            if with_height(first, height, frame, self._intake.config.space) is not first:
                return None
        except FrameError:
            return None
        return first.space, first.frame, first.height or height

    def _together(self, place: int) -> None:
        """Make the tables from `place` on that are alike, where there are several."""
        end = place + 1
        while end < len(self._runs) and self._keys[end] == self._keys[place]:
            end += 1
        if end == place + 1:
            return
        items = [item for run in self._runs[place:end] for item in run]
        (source, _, _), _ = items[0]
        frame = self._intake.frame
        assert frame is not None
        sound, most = [faults == 0 for _, faults in items], self._intake.config.max_components
        try:
            whole = message_tracks(
                [message for (_, message, _), _ in items], sound, frame, self._intake.declared(source).height, most,
                self._intake.said, self._intake.lineages,
            )  # fmt: skip
        except FrameError:  # each says so for itself
            self._keys[place:end] = [None] * (end - place)
            return
        sizes = [sum(int(np.count_nonzero(rows == 0)) for _, rows in run) for run in self._runs[place:end]]
        self._ready = dict(zip(range(place, end), _apart(whole, sizes), strict=True))


def _apart(tracks: Tracks, sizes: Sequence[int]) -> Iterator[Tracks]:
    """The tables that were made one, of so many tracks each."""
    nothing = empty_tracks(len(tracks.mean))
    columns, start = columns_of(tracks), 0
    for size in sizes:
        end = start + size
        parts = [np.ascontiguousarray(column[..., start:end]) for column in columns] if size else columns_of(nothing)
        yield made(Tracks, parts)
        start = end
