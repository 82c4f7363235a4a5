"""`FusionCentre`: associates and fuses the tracks of many sources into one picture."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre.align import predict_tracks, write_back
from fusion_service.centre.centre import Centre
from fusion_service.centre.existence import existence_now
from fusion_service.centre.fusing import fuse_all
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.linking import Linker
from fusion_service.centre.meeting import Meeting
from fusion_service.centre.publishing import Contributions, live_on
from fusion_service.centre.rows import Rows
from fusion_service.config import CentreConfig

__all__ = ["FusionCentre"]


class FusionCentre(Centre):
    """Links local tracks to global ones and fuses, in every step, those of each global track. Arguments as for
    `Centre`."""

    @staticmethod
    def _own_kind(config: CentreConfig) -> CentreConfig:
        return config

    @property
    def _rule(self) -> str:
        return self.config.rule

    def _begin(self) -> None:
        self._linker = Linker(self.config, self._ids)

    def _kept(self) -> dict[str, Any]:
        return {"agreeing": [[a, b, count] for (a, b), count in sorted(self._linker.agreeing.items())]}

    def _restore(self, state: dict[str, Any]) -> None:
        self._linker.agreeing = state["agreeing"]

    def _advance(self, rows: Rows, names: tuple[str, ...], time: int) -> Contributions:
        self._associate(rows, names, time)
        self._picture, influence = fuse_all(rows, self._predicted(time), time, self.config, self._journal)
        self._live(rows, time)
        write_back(rows, self._intake)
        return self._contributions(rows, influence)

    def _forget(self, tracks: Iterable[int]) -> None:
        self._relink(dict.fromkeys(tracks, 0))

    def _relink(self, new: dict[int, int]) -> None:
        """Change the links of all tables: {old global id: new one, or 0}."""
        if not new:
            return
        old = np.array(sorted(new), dtype=np.uint64)
        to = np.array([new[track] for track in old.tolist()], dtype=np.uint64)
        for source in self._intake.sources.values():
            link = source.tracks.link
            at = np.minimum(np.searchsorted(old, link), len(old) - 1)
            source.tracks = replace(source.tracks, link=np.where(old[at] == link, to[at], link))

    def _associate(self, rows: Rows, names: tuple[str, ...], time: int) -> None:
        linker, journal = self._linker, self._journal
        meeting = Meeting(self._intake, self._labels, rows, self._picture.id, names)
        rows.tracks.link[meeting.forced_row] = meeting.forced_track
        linker.check(rows, journal)
        now = self._predicted(time)
        self._picture, agreements = linker.link(rows, self._picture, now, meeting, self._step, time, journal)
        merged = linker.merge(rows, agreements, self._step, journal)
        self._relink(merged)
        if merged:
            gone = np.isin(self._picture.id, np.array(list(merged), dtype=np.uint64))
            self._picture = self._picture.take(~gone)

    def _predicted(self, time: int) -> Picture:
        picture, config = self._picture, self.config
        dt = np.where(picture.time >= 0, time - picture.time, 0) / 1e9
        return predict_tracks(picture, config.motion, config.space, config.space, dt)

    def _live(self, rows: Rows, time: int) -> None:
        tracks, picture, linked = rows.tracks, self._picture, rows.linked()
        at = picture.find(tracks.link[linked])
        support = np.bincount(at, minlength=len(picture.id))
        updated = picture.updated.copy()
        np.maximum.at(updated, at, tracks.updated[linked])
        newest = np.full(len(picture.id), -1, dtype=np.int64)
        np.maximum.at(newest, at, tracks.time[linked])
        fresh = newest > picture.seen
        existence = existence_now(rows, picture, fresh, self._intake, time)
        seen = np.maximum(picture.seen, newest)
        picture = replace(picture, updated=updated, existence=existence, seen=seen)
        picture, ended = live_on(picture, time, support, fresh, self.config, self._journal)
        self._relink(dict.fromkeys(picture.id[ended].tolist(), 0))
        self._picture = picture.take(~ended)

    def _contributions(self, rows: Rows, influence: NDArray[np.float64]) -> Contributions:
        picture, tracks, linked = self._picture, rows.tracks, rows.linked()
        linked = linked[np.argsort(tracks.link[linked], kind="stable")]
        counts = np.bincount(picture.find(tracks.link[linked]), minlength=len(picture.id))
        return Contributions(counts, rows.source[linked], rows.epoch[linked], tracks.id[linked], influence[linked])
