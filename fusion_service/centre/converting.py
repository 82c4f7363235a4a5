"""A step's messages made tables: small ones in a row that are alike are made together, and are the same as alone.

Many sources that say little cost what they are, not what a call is for each of them. Of those that tell of the same
tracks as before, which nearly all do, the next tables are made with them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from fusion_service.centre import notes
from fusion_service.centre.ahead import Ahead, Asked
from fusion_service.centre.batches import Checked
from fusion_service.centre.declared import loosened
from fusion_service.centre.extents import tells_extent
from fusion_service.centre.frames import name_frame
from fusion_service.centre.heights import with_height
from fusion_service.centre.intervals import Pace, next_interval
from fusion_service.centre.lineage import Lineages
from fusion_service.centre.scans import message_tracks
from fusion_service.centre.sources import Source
from fusion_service.centre.tracks import LINKS, Step, Tracks, empty_tracks, join_tracks
from fusion_service.centre.words import Lexicon
from fusion_service.config import CentreConfig, SourceConfig
from fusion_service.geodesy import FrameError
from fusion_service.records import altered, columns_of, made
from schemas import Frame, Height, LocalTracks

__all__ = ["Border", "Conversion", "Table"]

SMALL = 64
"""Tracks of a message up to which it is made a table together with others: beyond, copies cost more than calls."""
NOTHING_KNOWN: dict[int, Step] = {}
_Key = tuple[tuple[str, ...], Frame, Height]


class Table(NamedTuple):
    """Messages of a run, with their height, their sound tracks, the pace of these, and, where it is known already, the
    step from the source's table to the next."""

    messages: list[LocalTracks]
    tracks: Tracks
    pace: Pace
    step: Step | None = None


class Border(Protocol):
    """What of the intake is asked here (see there)."""

    @property
    def ahead(self) -> Ahead: ...
    @property
    def config(self) -> CentreConfig: ...
    @property
    def frame(self) -> Frame | None: ...
    @property
    def said(self) -> Lexicon: ...
    @property
    def lineages(self) -> Lineages: ...
    def declared(self, source: Source) -> SourceConfig: ...
    def pace(self, source: Source, complete: bool) -> Pace: ...


class Conversion:
    """The tables of `runs`: messages that are taken together, each of one source, space, frame and height. They are to
    be asked for in order, which is that in which texts and lineages get their codes."""

    def __init__(self, runs: Sequence[list[Checked]], intake: Border) -> None:
        self._runs, self._intake = runs, intake
        self._keys: list[_Key | None] = [None] * len(runs) if intake.frame is None else [*map(self._key, runs)]
        self._ready: dict[int, Table] = {}

    def of(self, place: int) -> Table:
        """What a run comes to. Raises `FrameError`."""
        (source, first, _), _ = self._runs[place][0]
        frame, space = self._intake.frame, self._intake.config.space
        if frame is None:
            raise FrameError(notes.unfit(name_frame(first.frame), space))
        if self._keys[place] is not None:
            if place not in self._ready:
                self._together(place)
            if place in self._ready:
                table = self._ready.pop(place)
                if table.step is None:  # the pace of a source that said something before in this step is another now
                    table = table._replace(pace=self._intake.pace(source, first.complete))
                return table
        said = self._intake.declared(source)
        messages = [with_height(one, said.height, frame, space) for (_, one, _), _ in self._runs[place]]
        sound = [faults == 0 for _, faults in self._runs[place]]
        words = self._intake.said, self._intake.lineages
        most = self._intake.config.max_components
        asked = Asked(frame, said.height, most)
        tracks = self._intake.ahead.table(messages[0], asked) if len(messages) == 1 else None
        tracks = tracks or message_tracks(messages, sound, frame, said.height, most, *words)
        return Table(messages, loosened(tracks, messages[0].space, said), self._intake.pace(source, first.complete))

    def _key(self, run: list[Checked]) -> _Key | None:
        """What runs that are made tables together have in common; None of one that stands alone."""
        (source, first, _), _ = run[0]
        frame, said = self._intake.frame, self._intake.declared(source)
        height = said.height
        if frame is None or said.inflation != 1.0 or said.covariance_floor != 0.0:
            return None
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
        paces = [self._intake.pace(run[0][0][0], run[0][0][1].complete) for run in self._runs[place:end]]
        steps = self._steps(place, whole, sizes, paces)
        for k, (tracks, pace) in enumerate(zip(_apart(whole, sizes, steps), paces, strict=True)):
            messages = [message for (_, message, _), _ in self._runs[place + k]]
            self._ready[place + k] = Table(messages, tracks, pace, steps.get(k))

    def _steps(self, place: int, whole: Tracks, sizes: list[int], paces: list[Pace]) -> dict[int, Step]:
        """The steps of the sources from `place` on that tell of the tracks of before, once and no older, by their place
        among these: what `Source.apply` makes of the tracks alone. whole: the tracks of all, of `sizes`."""
        runs = self._runs[place : place + len(sizes)]
        sources = [run[0][0][0] for run in runs]
        often = Counter(source.name for source in sources)
        space = runs[0][0][0][1].space
        some = [
            k
            for k, (source, size) in enumerate(zip(sources, sizes, strict=True))
            if size and len(runs[k]) == often[source.name] == 1 and _may_go_on(source, space, size)
        ]
        if not some:
            return {}
        counts, spread = np.array(sizes), np.zeros(len(sizes), dtype=np.bool_)
        spread[some] = True
        new, old = whole.take(np.repeat(spread, counts)), join_tracks([sources[k].tracks for k in some])
        counts = counts[some]
        starts = np.cumsum(counts) - counts
        floor, cap, complete = (
            np.repeat(np.array(values, dtype=np.int64), counts)
            for values in zip(*((paces[k].floor, paces[k].cap, sources[k].complete) for k in some), strict=True)
        )
        usual = (old.id == new.id) & (old.time <= new.time) & (new.time >= complete)
        usual = np.logical_and.reduceat(usual, starts)
        same = old.origin == new.origin
        kept = {name: getattr(old, name) for name in LINKS}
        if not same.all():
            kept = {name: np.where(same, column, getattr(new, name)) for name, column in kept.items()}
        later = same & (new.updated > old.updated)
        new = altered(new, interval=next_interval(old.interval, old.time, new.time, floor, cap), **kept)
        steps: dict[int, Step] = {}
        for k, fits, start, tracks in zip(
            some, usual.tolist(), starts.tolist(), _apart(new, counts.tolist()), strict=True
        ):
            if fits:
                newer, pair = later[start : start + len(tracks.id)], None
                if self._intake.config.follows and newer.any():
                    pair = sources[k].tracks.take(newer), tracks.take(newer)
                steps[k] = Step(tracks, np.zeros(len(tracks.id), dtype=np.bool_), pair)
        return steps


def _may_go_on(source: Source, space: tuple[str, ...], size: int) -> bool:
    """Whether a scan of `size` tracks may be one of the tracks that there are, all Gaussian and without extents."""
    tracks = source.tracks
    plain = not len(tracks.log_weight) and not len(tracks.extent) and not len(source.remembered.id)
    return plain and len(tracks.id) == size and source.space == space


def _apart(tracks: Tracks, sizes: Sequence[int], known: Mapping[int, Step] = NOTHING_KNOWN) -> Iterator[Tracks]:
    """The tables that were made one, of so many tracks each: copies, which keep nothing of the others. known: those
    that are there already."""
    nothing: Tracks | None = None
    columns, start = columns_of(tracks), 0
    for place, size in enumerate(sizes):
        end = start + size
        if place in known:
            yield known[place].new
        elif size:
            yield made(Tracks, [column[..., start:end].copy() for column in columns])
        else:
            nothing = empty_tracks(len(tracks.mean)) if nothing is None else nothing
            yield nothing
        start = end
