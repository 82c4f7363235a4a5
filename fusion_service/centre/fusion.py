"""`FusionCentre`: associates and fuses the tracks of many sources into one picture."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import among, any_of, filled, marked, subset
from fusion_service.centre import kinship
from fusion_service.centre.align import write_back
from fusion_service.centre.blobs import Blobs, Shared
from fusion_service.centre.centre import Centre
from fusion_service.centre.existence import Entries, update_existence
from fusion_service.centre.extent_fusion import fused_extents
from fusion_service.centre.extents import shaped
from fusion_service.centre.lifecycle import Picture, Support
from fusion_service.centre.linking import Linker
from fusion_service.centre.meeting import Meeting
from fusion_service.centre.memory import Memory
from fusion_service.centre.publishing import Contributions, live_on
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.supervision import Supervisor
from fusion_service.centre.suspended import Suspended
from fusion_service.centre.tracks import relinked
from fusion_service.centre.whereabouts import Whereabouts
from fusion_service.config import CentreConfig
from fusion_service.records import altered

__all__ = ["FusionCentre"]

NOTHING: NDArray[np.uint64] = np.zeros(0, dtype=np.uint64)


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
        before: Linker | None = getattr(self, "_linker", None)
        self._linker = Linker(self.config, self._ids, before.beside if before is not None else None)
        self._entries = Entries()
        self._blobs = Blobs(self.config)
        self._memory = Memory(self._intake)
        self._supervisor = Supervisor(self._intake)
        self._suspended = Suspended.nothing(len(self.config.space))
        self._last = -1

    def _kept(self) -> dict[str, Any]:
        return {
            **self._linker.packed(),
            "entries": self._entries.packed(),
            "memory": self._memory.packed(),
            "supervision": self._supervisor.packed(),
            "blobs": self._blobs.packed(),
            "suspended": self._suspended.packed(),
        }

    def _restore(self, state: dict[str, Any]) -> None:
        self._linker.restore(state)
        self._entries = Entries.unpacked(state["entries"])
        if "blobs" in state:
            self._blobs.restore(state["blobs"])
        if "memory" in state:
            self._memory.restore(state["memory"])
        learned = state.get("supervision", {})
        self._supervisor.restore(learned if "look" in learned else {})  # of before 0.6.0: sources are learned anew
        if "suspended" in state:
            self._suspended = Suspended.unpacked(state["suspended"], len(self.config.space))
        self._note_waiting()
        self._last = self._time

    def _rebase(self, time: int) -> None:
        self._linker.merges.rebase(time)
        self._blobs.rebase(time)
        self._linker.copies.rebase(time)
        self._memory.rebase(time)
        self._supervisor.rebase(time)
        self._suspended.rebase(time)
        self._last = min(self._last, time)

    def _renamed(self, new: dict[int, int]) -> None:
        self._relink(new)

    def _advance(self, rows: Rows, names: tuple[str, ...], time: int) -> Contributions:
        if gap := self._intake.spared.gap:
            self._picture = altered(self._picture, due=self._picture.due + gap)
        self._picture = self._suspended.resume(
            rows, names, self._picture, self._intake, self._step, time, self._linker.tests, self._journal
        )
        if self._ids.promised:
            self._ids.promised.look = lambda where: self._looked(where, names, time)
        now = self._associate(rows, names, time)
        self._supervisor.observe(rows, names, now, self._step, time, self._journal, self._own())
        shared = self._blobs.follow(rows, names, now, time, self._intake.frame)
        rows = shared.widened()
        self._picture, influence = self._memory.fuse(rows, names, self._picture, now, self._step, time, self._journal)
        self._picture = fused_extents(rows, self._picture, (time - self._last) / 1e9 if self._last >= 0 else 0.0)
        self._live(rows, shared, time)
        self._supervisor.conduct.judge_existence(rows, self._picture, self._entries, time, self._journal)
        write_back(rows, self._intake)
        return self._contributions(rows, influence)

    def _looked(self, where: Whereabouts, names: tuple[str, ...], time: int) -> Whereabouts | None:
        """Where promised tracks are at `time`, ns, as the sources say that targets move; None where it is not known."""
        declared = [self._intake.motion_said(self._intake.sources[name]) for name in names]
        return where.now(time, self._intake.frame, self._memory.motions, declared)

    def _own(self) -> dict[str, tuple[float, float]]:
        """What is known of the sources' own innovations, by name: mean normalised square, and freedom."""
        records = self._memory.watch.records.items()
        return {name: (one.ratio, one.freedom) for name, one in records if one.freedom > 0}

    def _watched(self) -> dict[str, dict[str, Any]]:
        watch, wanted = self._memory.watch, self.config.by_tracklets
        copies = self._linker.copies.sentences()
        return {
            name: {key: value for key, value in watch.health(name).items() if wanted or "tracklets" not in key}
            | self._supervisor.health(name)
            | ({"copies": copies[name]} if name in copies else {})
            for name in self._intake.names()
        }

    def _forget(self, tracks: Iterable[int]) -> None:
        self._relink(dict.fromkeys(tracks, 0))

    def _note_waiting(self) -> None:
        self._ids.waiting = self._suspended.picture.id
        self._intake.spared.awaited = frozenset(self._suspended.keys)

    def _stop_waiting(self, tracks: NDArray[np.uint64]) -> int:
        count = self._suspended.drop(tracks)
        self._note_waiting()
        return count

    def _relink(self, new: dict[int, int]) -> None:
        """Change the links of all tables: {old global id: new one, or 0}. A source has one track in a global one: of a
        source that is not heard now the others are linked to none."""
        if not new:
            return
        old = np.array(sorted(new), dtype=np.uint64)
        to = np.array([new[track] for track in old.tolist()], dtype=np.uint64)
        for source in self._intake.sources.values():
            at = marked(among(source.tracks.link, old))
            if len(at):
                link = to[np.searchsorted(old, source.tracks.link[at])]
                double = among(link, np.delete(source.tracks.link, at))
                double |= ~among(np.arange(len(at)), np.unique(link, return_index=True)[1])
                link = np.where(double, NO_TRACK, link)
                source.tracks = relinked(source.tracks, at, link, self._step)

    def _associate(self, rows: Rows, names: tuple[str, ...], time: int) -> Picture:
        """Decide the links of the step; the picture that comes of it, predicted to `time`."""
        now = self._memory.motions.predicted(self._picture, time)
        count = len(now.id)
        meeting = Meeting(self._intake, self._labels, rows, now.id, names, self._blobs.unmerged)
        seen = shaped(rows, now, self.config.space, self._intake.frame)
        self._picture, merged = self._linker.link(
            seen[0], self._picture, seen[1], meeting, self._step, time, self._journal
        )
        self._relink(merged)
        if merged:
            gone = among(self._picture.id, np.array(list(merged), dtype=np.uint64))
            self._picture, now = self._picture.take(~gone), now.take(~gone[:count])
            count = len(now.id)
        if len(self._picture.id) > count:
            now = now.join(self._picture.take(slice(count, None)))
        if (order := now.order()) is not None:  # a step made again gives ids that are known
            self._picture, now = self._picture.take(order), now.take(order)
        return now

    def _live(self, rows: Rows, shared: Shared, time: int) -> None:
        tracks, picture, inside = rows.tracks, self._picture, rows.inside()
        at = picture.find(subset(tracks.link, inside))
        rows = kinship.new_only(rows, picture.updated, at, inside)
        updated, newest = picture.updated.copy(), filled(len(picture.id), -1, np.int64)
        np.maximum.at(updated, at, subset(tracks.updated, inside))
        np.maximum.at(newest, at, subset(tracks.time, inside))
        seen = np.maximum(picture.seen, newest)
        picture = altered(picture, updated=updated, seen=seen)
        picture = update_existence(rows, picture, self._intake, self._entries, time, self._last, shared)
        support = self._support(rows, shared, inside, at, len(picture.id), time)
        self._last = time
        picture, ended, held = live_on(
            picture, time, support, self.config, self._journal,
            lambda ids: self._suspended.held(rows, self._intake.names(), ids, self._intake),
        )  # fmt: skip
        if any_of(held):
            self._suspended.take(picture.take(held), self._intake, self._journal)
        self._note_waiting()
        if any_of(ended):
            self._relink(dict.fromkeys(picture.id[ended].tolist(), 0))
            tracks.link[among(tracks.link, picture.id[ended])] = NO_TRACK
            picture = picture.take(~ended)
        self._picture = picture

    def _support(
        self, rows: Rows, shared: Shared, inside: NDArray[np.intp], at: NDArray[np.intp], count: int, time: int
    ) -> Support:
        """What feeds each global track. A report is overdue by half of its interval, or a step, whichever is longer;
        where the source's token is gone, by nothing; where data of it were dropped, it is not."""
        interval = subset(rows.interval, inside)
        slack = np.maximum(interval // 2, round(self.config.period * 1e9))
        expected = subset(rows.tracks.seen, inside) + interval + np.where(subset(rows.lost, inside), 0, slack)
        expected = self._intake.spared.after_waking(expected, subset(rows.tracks.time, inside), interval + slack)
        spared = self._intake.spared.of(self._intake.names())
        if spared.any():
            expected = np.where(spared[subset(rows.source, inside)], np.maximum(expected, time), expected)
        due, slowest = filled(count, -1, np.int64), np.zeros(count, dtype=np.int64)
        np.maximum.at(due, at, expected)
        np.maximum.at(slowest, at, interval)
        counted = kinship.separate(rows, inside)
        sources = np.bincount(at[(expected >= time) & counted], minlength=count)
        hit = np.bincount(at[subset(rows.fresh, inside)], minlength=count) > 0
        linked = np.bincount(self._picture.find(rows.tracks.link[rows.linked()]), minlength=count)
        whole = filled(len(rows.source), -1, np.int64)
        whole[inside] = expected
        left = shared.support(due, whole, linked == 0)
        unlisted = [links for source in self._intake.sources.values() for links in source.dropped if len(links)]
        dropped = left & among(self._picture.id, np.concatenate([NOTHING, *unlisted]))
        before = self._last + self._intake.spared.gap  # while the centre was not there no time went by
        return Support(sources, hit, due, slowest, left, dropped, before)

    def _contributions(self, rows: Rows, influence: NDArray[np.float64]) -> Contributions:
        picture, tracks, inside = self._picture, rows.tracks, rows.inside()
        inside = inside[np.argsort(subset(tracks.link, inside), kind="stable")]
        counts = np.bincount(picture.find(tracks.link[inside]), minlength=len(picture.id))
        return Contributions(counts, rows.source[inside], rows.epoch[inside], tracks.id[inside], influence[inside])
