"""`IntensityCentre`: what `FusionCentre` is for tracks, for intensities (PHDs): no clock, no thread, no socket.

Every source's newest intensity is predicted to the step with its declared motion, fused place by place with those of
the other sources that cover the place (`cells`), reduced, and read for states: components above a threshold, or the
round(mass) heaviest. States go on as the global tracks near which they are, one each, cheapest pair first; a track
without a state coasts. The existence of a track is the weight of its component, that of a coasting one the weight
which the fused intensity still has near it.

The guarantees are those of `FusionCentre`: the same events give the same bytes, in whatever order they came within a
step; nothing that a message contains raises; all is bounded.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from fusion_service import linalg
from fusion_service.centre.association import candidate_pairs, cluster, pair_distance
from fusion_service.centre.cells import Components, find_cells, fuse_cells, reduced
from fusion_service.centre.centre import Centre
from fusion_service.centre.lifecycle import Picture, Support, newborn
from fusion_service.centre.publishing import Contributions, live_on
from fusion_service.centre.rows import Rows
from fusion_service.config import CentreConfig
from fusion_service.coverage import covers
from fusion_service.densities import Mixture
from fusion_service.motion import predict
from schemas import Entry

__all__ = ["IntensityCentre"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

SUPPORT = 0.5
"""What a source must have of the mean share in a component, of those that have any, to support its track."""
MOST_TRACKS = 20_000


class IntensityCentre(Centre):
    """Fuses the intensities of many sources into one, and reads tracks from it. Arguments as for `Centre`."""

    @staticmethod
    def _own_kind(config: CentreConfig) -> CentreConfig:
        return replace(config, kind="intensity")

    @property
    def intensity(self) -> Mixture | None:
        """The fused intensity after the last step of this run, heaviest component first; None where it is nought."""
        return self._fused.mixture()

    @property
    def _rule(self) -> str:
        return self.config.intensity_rule

    def _begin(self) -> None:
        space = self.config.space
        self._places = [space.index(axis) for axis in ("x", "y", "z") if axis in space]
        self._gate, self._keep_gate = chi2.ppf([self.config.gate, self.config.keep_gate], len(space)).tolist()
        self._fused = self._nothing(0)

    def _kept(self) -> dict[str, Any]:
        return {"merges": [], "rivals": [], "entries": []}

    def _restore(self, state: dict[str, Any]) -> None:
        """The intensity is fused anew in every step."""

    def _forget(self, tracks: Iterable[int]) -> None:
        """Nothing else refers to a track."""

    def _advance(self, rows: Rows, names: tuple[str, ...], time: int) -> Contributions:
        self._fused = self._fuse(rows, names, time)
        return self._contributions(self._follow(names, time), names)

    def _numbers(self) -> dict[str, int]:
        return super()._numbers() | {"expected": round(self._fused.mass), "components": len(self._fused.weight)}

    def _nothing(self, sources: int) -> Components:
        n = len(self.config.space)
        return Components(np.zeros(0), np.zeros((n, 0)), np.zeros((n, n, 0)), np.zeros((sources, 0)))

    def _fuse(self, rows: Rows, names: tuple[str, ...], time: int) -> Components:
        """The fused intensity at `time`: every source reduced, components matched, fused, and reduced again."""
        config, tracks = self.config, rows.tracks
        sources = self._intake.sources
        active = np.array([name in rows.kept and not self._intake.is_stale(sources[name], time) for name in names])
        limits = config.intensity_prune, config.intensity_merge
        most = max(1, 4 * config.intensity_components // max(int(active.sum()), 1))
        own = []
        for index in np.unique(rows.source).tolist():
            at = np.flatnonzero(rows.source == index)
            share = np.zeros((len(names), len(at)))
            share[index] = 1.0
            whole = Components(tracks.existence[at], tracks.mean[:, at], tracks.covariance[:, :, at], share)
            own.append(reduced(whole, *limits, most))
        if not sum(len(part.weight) for part in own):
            return self._nothing(len(names))
        columns = ("weight", "mean", "covariance", "share")
        parts = Components(*(np.concatenate([getattr(part, name) for part in own], axis=-1) for name in columns))
        source = np.repeat(np.unique(rows.source), [len(part.weight) for part in own])
        frame = self._intake.frame

        def covering(mean: Floats) -> NDArray[np.bool_]:
            cover = np.repeat(active[:, None], mean.shape[1], axis=1)
            for index, name in enumerate(names):
                info = sources[name].info
                if active[index] and info is not None and info.coverage is not None and frame is not None:
                    cover[index] = covers(info, mean[self._places], frame)
            return cover

        cell = find_cells(parts, source, self._places, self._gate)
        fused = fuse_cells(config.intensity_rule, config.intensity_cardinality, parts, source, cell, covering)
        return self._sound(reduced(self._sound(fused), *limits, config.intensity_components))

    def _sound(self, parts: Components) -> Components:
        """Without what rounding has spoiled, which is counted."""
        sound = parts.sound()
        if not sound.all():
            self._journal.refuse(Entry("", 0, 0, 0, "fusion", int((~sound).sum())))
        return parts.take(sound)

    def _extracted(self) -> int:
        """How many of the components, which come heaviest first, are states."""
        if self.config.intensity_extract == "rank":
            return min(int(np.floor(self._fused.mass + 0.5)), len(self._fused.weight))
        return int((self._fused.weight > self.config.intensity_threshold).sum())

    def _follow(self, names: tuple[str, ...], time: int) -> Floats:
        """Bring the picture to `time` with the states as its tracks; share (N, G) of each source in each track."""
        fused, picture, config, count = self._fused, self._picture, self.config, len(self._picture.id)
        dt = np.where(picture.time >= 0, time - picture.time, 0) / 1e9
        mean, covariance = predict(config.motion, config.space, picture.mean, picture.covariance, dt)
        states = self._extracted()
        track, nearby = self._assign(mean, covariance, states)
        declared = [self._intake.declared(self._intake.sources[name]) for name in names]
        may_start = np.array([one.may_start for one in declared], dtype=np.bool_)
        free = np.flatnonzero(track < 0)
        free = free[(fused.share[:, free] * may_start[:, None] > 0).any(axis=0)] if len(names) else free
        room = max(0, MOST_TRACKS - count)
        if len(free) > room:
            self._journal.refuse(Entry("", 0, 0, 0, "too-many-tracks", len(free) - room))
            free = free[:room]
        ids = self._ids.allot(len(free))
        self._journal.birth(ids)
        track[free] = count + np.arange(len(free))
        picture = replace(picture, mean=mean, covariance=covariance, existence=np.minimum(picture.existence, nearby))
        picture = picture.join(newborn(ids, len(config.space), time))
        state = np.flatnonzero(track >= 0)
        at = track[state]
        share = np.zeros((len(names), len(picture.id)))
        share[:, at] = fused.share[:, state]
        mean, covariance = picture.mean.copy(), picture.covariance.copy()
        existence, at_time = picture.existence.copy(), np.full(len(picture.id), time)
        mean[:, at], covariance[:, :, at] = fused.mean[:, state], fused.covariance[:, :, state]
        existence[at] = np.minimum(fused.weight[state], 1.0)
        picture = replace(picture, mean=mean, covariance=covariance, existence=existence, time=at_time)
        supporting = (share > 0) & (share * (share > 0).sum(axis=0) >= SUPPORT)
        self._picture, ended = self._lived(picture, supporting, names, time)
        return share[:, ~ended]

    def _assign(self, mean: Floats, covariance: Floats, states: int) -> tuple[Ints, Floats]:
        """The track of each state, -1 for none, and the weight (G,) near each track that is in no state.

        Pairs within `keep_gate` are taken in the order of d2 + log det of the sum of the covariances.
        """
        fused, count = self._fused, mean.shape[1]
        means = np.concatenate([mean, fused.mean], axis=1)
        covariances = np.concatenate([covariance, fused.covariance], axis=2)
        sigma = np.sqrt(linalg.total(np.stack([covariances[place, place] for place in self._places])))
        kind = np.arange(means.shape[1]) >= count
        i, j = candidate_pairs(means[self._places], sigma, float(np.sqrt(self._keep_gate)), kind.astype(np.intp))
        distance, spread = pair_distance(means, covariances, i, j)
        near = distance <= self._keep_gate
        i, j, cost = i[near], j[near], (distance + spread)[near]
        light = j >= count + states
        nearby = np.bincount(i[light], fused.weight[j[light] - count], count)
        state = kind[: count + states]
        root, _ = cluster(i[~light], j[~light], cost[~light], state.astype(np.int64), ~state)
        track = np.array(root[count:], dtype=np.intp)
        return np.where(track < count, track, -1), np.minimum(nearby, 1.0)

    def _lived(
        self, picture: Picture, supporting: NDArray[np.bool_], names: tuple[str, ...], time: int
    ) -> tuple[Picture, NDArray[np.bool_]]:
        """The picture after one step of life, without what ended, and which did. supporting (N, G)."""
        last = np.array([self._intake.sources[name].last for name in names], dtype=np.int64)
        newest = np.max(np.where(supporting, last[:, None], -1), axis=0, initial=-1)
        fresh = newest > picture.seen
        seen, updated = np.maximum(picture.seen, newest), np.maximum(picture.updated, newest)
        picture = replace(picture, seen=seen, updated=updated)
        period = np.array(
            [round(self._intake.declared(self._intake.sources[name]).period * 1e9) for name in names], dtype=np.int64
        )
        slowest = np.max(np.where(supporting, period[:, None], 0), axis=0, initial=0)
        due = np.where(supporting.any(axis=0), time + slowest + np.maximum(slowest // 2, 10**9), -1)
        support = Support(supporting.sum(axis=0), fresh, due, slowest, np.asarray(~supporting.any(axis=0)))
        picture, ended = live_on(picture, time, support, self.config, self._journal)
        return picture.take(~ended), ended

    def _contributions(self, share: Floats, names: tuple[str, ...]) -> Contributions:
        sources = self._intake.sources
        owner, source = np.nonzero(share.T > 0)
        epochs = np.array([max(sources[name].epoch, 0) for name in names], dtype=np.uint64)
        return Contributions(
            counts=np.bincount(owner, minlength=len(self._picture.id)),
            source=source,
            epoch=epochs[source],
            id=np.zeros(len(source), dtype=np.uint64),
            influence=share.T[owner, source],
        )
