"""`IntensityCentre`: what `FusionCentre` is for tracks, for intensities (PHDs): no clock, no thread, no socket.

Every source's newest intensity is predicted to the step with its declared motion, fused place by place with those of
the other sources that have a say there (`cells`), reduced, and read for states: components above a threshold, or the
round(mass) heaviest; a component of weight 2 is two states (`following`). States go on as the global tracks near which
they are, one each, cheapest pair first; a track without a state coasts. The existence of a track is its part of the
weight of its component, that of a coasting one the weight which the fused intensity still has near it.

The guarantees are those of `FusionCentre`: the same events give the same bytes, in whatever order they came within a
step; nothing that a message contains raises; all is bounded.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.centre.association import candidate_pairs, pair_distance
from fusion_service.centre.cells import Components, Stated, cells_and_reach, fuse_cells, reduced
from fusion_service.centre.centre import Centre
from fusion_service.centre.following import HOLD, Memory, assign, carried, live, next_number, ranked
from fusion_service.centre.lifecycle import Picture, newborn
from fusion_service.centre.motions import USUAL
from fusion_service.centre.naming import Places
from fusion_service.centre.publishing import Contributions
from fusion_service.centre.rows import Rows
from fusion_service.centre.stated_registration import stated_registration
from fusion_service.config import CentreConfig
from fusion_service.coverage import covers
from fusion_service.densities import Mixture
from fusion_service.metrics import chi2_quantile
from fusion_service.motion import predict
from schemas import Entry, messages

__all__ = ["IntensityCentre"]


SUPPORT = 0.5
"""What a source must have of the mean share in a component, of those that have any, to support its track."""
MOST_TRACKS = 20_000
MOST_AT_ONE = 20
"""Tracks that one component carries: with more targets in one place, another track says nothing."""


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
        config, space = self.config, self.config.space
        self._places = [space.index(axis) for axis in ("x", "y", "z") if axis in space]
        self._gate, self._keep_gate = (chi2_quantile(p, len(space)) for p in (config.gate, config.keep_gate))
        self._near_gate = chi2_quantile(config.keep_gate, max(len(self._places), 1))
        self._fused = self._nothing(0)
        self._memory = Memory.blank(self._picture.id, 0)
        self._heard: dict[str, tuple[int, int]] = {}
        self._total, self._total_lean = -1, 0.0

    def _kept(self) -> dict[str, Any]:
        """The intensity is fused anew in every step; what tracks go by is not."""
        return {
            "memory": self._memory.of(self._picture.id, max(self.time, 0)).pack(),
            "heard": {name: list(key) for name, key in sorted(self._heard.items())},
            "total": self._total,
            "total_lean": self._total_lean,
        }

    def _restore(self, state: dict[str, Any]) -> None:
        self._memory = Memory.unpack(state["memory"])
        self._heard = {str(name): (int(epoch), int(last)) for name, (epoch, last) in state["heard"].items()}
        self._total, self._total_lean = int(state["total"]), float(state["total_lean"])

    def _forget(self, tracks: Iterable[int]) -> None:
        """What is remembered goes by the ids in the picture."""

    def _rebase(self, time: int) -> None:
        self._memory = replace(self._memory, supported=np.minimum(self._memory.supported, time))

    def _renamed(self, new: dict[int, int]) -> None:
        ids = np.array([new.get(one, one) for one in self._memory.id.tolist()], dtype=np.uint64)
        order = np.argsort(ids)
        columns = {one.name: getattr(self._memory, one.name)[order] for one in fields(self._memory)}
        self._memory = Memory(**(columns | {"id": ids[order]}))

    def _advance(self, rows: Rows, names: tuple[str, ...], time: int) -> Contributions:
        new = self._news(names)
        self._fused = self._fuse(rows, names, time)
        return self._contributions(self._follow(names, new, time), names)

    def _news(self, names: tuple[str, ...]) -> Bools:
        """Which sources (N,) have brought data that no step has used."""
        sources = self._intake.sources
        heard = {name: (sources[name].epoch, sources[name].last) for name in names}
        new = [key[1] >= 0 and key != self._heard.get(name) for name, key in heard.items()]
        self._heard = heard
        return np.array(new, dtype=np.bool_)

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
        stated = self._stated(names)

        def covering(mean: Floats) -> Bools:
            return np.asarray(self._covering(names, mean) & active[:, None])

        cell, reached = cells_and_reach(parts, source, self._places, self._gate, stated.registration)
        rule = config.intensity_rule, config.intensity_cardinality
        fused = fuse_cells(*rule, parts, source, cell, covering, stated, reached)
        return self._sound(reduced(self._sound(fused), *limits, config.intensity_components))

    def _covering(self, names: tuple[str, ...], mean: Floats) -> Bools:
        """Which sources declare a coverage that holds the means (n, M): (N, M)."""
        cover, frame = np.zeros((len(names), mean.shape[1]), dtype=np.bool_), self._intake.frame
        for index, name in enumerate(names):
            info = self._intake.sensor(self._intake.sources[name])
            if info is not None and info.coverage is not None and frame is not None:
                cover[index] = covers(info, mean[self._places], frame)
        return cover

    def _stated(self, names: tuple[str, ...]) -> Stated:
        infos = [self._intake.sensor(self._intake.sources[name]) for name in names]
        declared = np.array([info is not None and info.coverage is not None for info in infos], dtype=np.bool_)
        chances = [None if info is None else info.detection_probability for info in infos]
        miss = np.array([0.0 if p is None else 1.0 - p for p in chances])
        return Stated(declared, miss, stated_registration(self._intake, names))

    def _sound(self, parts: Components) -> Components:
        """Without what rounding has spoiled, which is counted."""
        sound = parts.sound()
        if not sound.all():
            self._journal.refuse(Entry("", 0, 0, 0, "fusion", int((~sound).sum())))
        return parts.take(sound)

    def _candidates(self, memory: Memory, news: bool) -> Bools:
        """Which components (C,) may be states, and for extraction by rank how many states there are in all."""
        config, weight = self.config, np.minimum(self._fused.weight, MOST_AT_ONE)
        if config.intensity_extract == "threshold":
            return weight > config.intensity_threshold
        mass = np.array([self._fused.mass])
        if self._total < 0:
            self._total = int(np.floor(mass[0] + 0.5))
        elif news:
            was = np.array([self._total], dtype=np.intp), np.array([self._total_lean])
            number, lean = next_number(*was, mass, config.intensity_count_error)
            self._total, self._total_lean = int(number[0]), float(lean[0])
        first = ranked(weight, np.zeros(len(weight), dtype=np.intp), self._total)
        if not first.any():
            return first > 0
        least = (weight - first + 1)[first > 0].min() - HOLD * bool(memory.shared.any())
        return np.asarray(weight >= least)

    def _states(self, memory: Memory, picture: Picture, new: Bools) -> tuple[Ints, Ints, Floats, Floats]:
        """The component (G,) of each track, -1 for none; how many each component (C,) carries, and the evidence for
        more (C,); and the weight (G,) near each track that no state has."""
        fused, count, error = self._fused, len(picture.id), self.config.intensity_count_error
        weight = np.minimum(fused.weight, MOST_AT_ONE)
        i, j, cost = self._near(picture)
        candidate = self._candidates(memory, bool(new.any()))
        may = candidate[j]
        place = assign(i[may], j[may], cost[may], memory, weight)
        standing = np.flatnonzero((place >= 0) & memory.held)
        held = np.bincount(place[standing], minlength=len(candidate))
        where, first = np.unique(place[standing], return_index=True)
        lean = np.zeros(len(candidate))
        lean[where] = memory.lean[standing[first]]
        fresh = (fused.share[new] > 0).any(axis=0)
        if self.config.intensity_extract == "rank":
            number = ranked(np.where(candidate, weight, 0.0), held, self._total)
        else:
            moved, leaned = next_number(held, lean, weight, error)
            lean = np.where(fresh & (moved >= 1), leaned, np.where(fresh, 0.0, lean))
            first_number = np.floor(weight + 0.5).astype(np.intp)
            number = np.where(held > 0, np.where(fresh, moved, held), first_number)
            number = np.where(candidate, np.maximum(number, 1), 0)
        lean = np.where((held > 0) & (number > 0), lean, 0.0)
        nearby = np.bincount(i, np.maximum(weight - number, 0.0)[j], count)
        return carried(place, number, memory), number, lean, np.minimum(nearby, 1.0)

    def _near(self, picture: Picture) -> tuple[Ints, Ints, Floats]:
        """Pairs (track, component) within `keep_gate`, and d2 + log det of the sum of the covariances of each."""
        fused, count = self._fused, len(picture.id)
        means = np.concatenate([picture.mean, fused.mean], axis=1)
        covariances = np.concatenate([picture.covariance, fused.spread], axis=2)
        sigma = np.sqrt(linalg.total(np.stack([covariances[place, place] for place in self._places])))
        kind = np.arange(means.shape[1]) >= count
        i, j = candidate_pairs(means[self._places], sigma, float(np.sqrt(self._keep_gate)), kind.astype(np.intp))
        distance, spread = pair_distance(means, covariances, i, j)
        near = distance <= self._keep_gate
        return i[near], j[near] - count, (distance + spread)[near]

    def _born(self, place: Ints, number: Ints, names: tuple[str, ...]) -> Ints:
        """The component of each new track: what components carry beyond the tracks that are there, as far as some
        source may start a track there and there is room."""
        declared = [self._intake.declared(self._intake.sources[name]) for name in names]
        may_start = np.array([one.may_start for one in declared], dtype=np.bool_)
        wanted = number - np.bincount(place[place >= 0], minlength=len(number))
        wanted = np.where((self._fused.share[may_start] > 0).any(axis=0), wanted, 0)
        birth = np.repeat(np.arange(len(number)), wanted)
        room = max(0, MOST_TRACKS - len(place))
        if len(birth) > room:
            self._journal.refuse(Entry("", 0, 0, 0, "too-many-tracks", len(birth) - room))
        return birth[:room]

    def _follow(self, names: tuple[str, ...], new: Bools, time: int) -> Floats:
        """Bring the picture to `time` with the states as its tracks; share (N, G) of each source in each track."""
        fused, picture, config = self._fused, self._picture, self.config
        dt = np.where(picture.time >= 0, time - picture.time, 0) / 1e9
        mean, covariance = predict(
            config.motion or USUAL, config.space, picture.mean, picture.covariance, dt, self._intake.frame
        )
        picture = replace(picture, mean=mean, covariance=covariance)
        memory = self._memory.of(picture.id, time)
        place, number, lean, nearby = self._states(memory, picture, new)
        picture = replace(picture, existence=np.minimum(picture.existence, nearby))
        birth = self._born(place, number, names)
        where = Places(fused.mean[self._places][:, birth], self._spread(birth), self._near_gate)
        ids = self._ids.allot(len(birth), lambda: where)
        self._journal.birth(ids)
        picture = picture.join(newborn(ids, len(config.space), time))
        place = np.concatenate([place, birth])
        if (order := picture.order()) is not None:  # a step made again gives ids that are known
            picture, place = picture.take(order), place[order]
        memory = memory.of(picture.id, time)
        at = np.flatnonzero(place >= 0)
        state = place[at]
        share, count = np.zeros((len(names), len(picture.id))), np.bincount(state, minlength=len(number))
        share[:, at] = fused.share[:, state]
        mean, covariance, existence = picture.mean.copy(), picture.covariance.copy(), picture.existence.copy()
        mean[:, at], covariance[:, :, at] = fused.mean[:, state], fused.spread[:, :, state]
        existence[at] = np.minimum(fused.weight[state] / count[state], 1.0)
        now = np.full(len(picture.id), time)
        picture = replace(picture, mean=mean, covariance=covariance, existence=existence, time=now)
        stands, shared, leans = np.zeros(len(place), np.bool_), np.zeros(len(place), np.bool_), np.zeros(len(place))
        stands[at], shared[at], leans[at] = True, count[state] > 1, lean[state]
        memory = replace(memory, held=stands, shared=shared, lean=leans)
        supporting = (share > 0) & (share * (share > 0).sum(axis=0) >= SUPPORT)
        return share[:, ~self._lived(picture, memory, supporting, new, names, time)]

    def _spread(self, at: Ints) -> Floats:
        """Covariances (p, p, B) of the places of some components."""
        return self._fused.spread[np.ix_(self._places, self._places)][:, :, at]

    def _lived(
        self, picture: Picture, memory: Memory, supporting: Bools, new: Bools, names: tuple[str, ...], time: int
    ) -> Bools:
        """Take the picture and the memory after one step of life, without what ended; which did (G,). supporting
        (N, G), new (N,)."""
        sources, journal = self._intake.sources, self._journal
        last = np.array([sources[name].last for name in names], dtype=np.int64)
        newest = np.max(np.where(supporting, last[:, None], -1), axis=0, initial=-1)
        declared = self._stated(names).declared
        may_speak = self._covering(names, picture.mean) | ~declared[:, None]
        before = picture.status
        status, memory, ended = live(before, picture.existence, memory, supporting, may_speak, new, time, self.config)
        for track in picture.id[ended].tolist():
            journal.end(track, "lost", None)
        for code, decision in (
            (messages.CONFIRMED, messages.CONFIRMED_NOW),
            (messages.COASTING, messages.COASTING_NOW),
        ):
            journal.tracks(decision, picture.id[(status == code) & (before != code) & ~ended])
        seen, updated = np.maximum(picture.seen, newest), np.maximum(picture.updated, newest)
        self._picture = replace(picture, status=status, seen=seen, updated=updated).take(~ended)
        self._memory = memory.of(self._picture.id, time)
        return ended

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
