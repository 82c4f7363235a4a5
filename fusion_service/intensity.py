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

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from fusion_service import linalg
from fusion_service.association import candidate_pairs, cluster, pair_distance
from fusion_service.cells import Components, find_cells, fuse_cells, reduced
from fusion_service.centre import VERSION, StepResult
from fusion_service.checkpoint import pack_state, unpack_state
from fusion_service.config import CentreConfig, centre_config, config_hash
from fusion_service.coverage import covers
from fusion_service.densities import Mixture
from fusion_service.health import step_status
from fusion_service.intake import Event, Intake, Order
from fusion_service.journal import Journal, start_event
from fusion_service.lifecycle import Picture, empty_picture, newborn
from fusion_service.motion import predict
from fusion_service.publishing import Contributions, live_on, picture_message
from fusion_service.rows import Rows, usable_rows
from schemas import Entry, GlobalTracks
from schemas import messages as words

__all__ = ["IntensityCentre"]

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

SUPPORT = 0.5
"""What a source must have of the mean share in a component, of those that have any, to support its track."""
MOST_TRACKS = 20_000


class IntensityCentre:
    """Fuses the intensities of many sources into one, and reads tracks from it. Arguments as for `FusionCentre`."""

    def __init__(
        self,
        config: CentreConfig | Mapping[str, Any],
        checkpoint: bytes | None = None,
        *,
        generation: int | None = None,
        epoch: int = 0,
    ) -> None:
        self.config = replace(centre_config(config), kind="intensity")
        self.config_hash = config_hash(self.config)
        self.epoch = epoch
        space = self.config.space
        self._places = [space.index(axis) for axis in ("x", "y", "z") if axis in space]
        self._gate, self._keep_gate = chi2.ppf([self.config.gate, self.config.keep_gate], len(space)).tolist()
        self._intake = Intake(self.config)
        self._picture = empty_picture(len(space))
        self._fused = self._nothing(0)
        self._next_id = 1
        self._step = 0
        self._published = 0
        self._time = -1
        self._journal = Journal(self.config.name, self.config_hash, VERSION)
        if checkpoint is not None:
            state, self._picture = unpack_state(checkpoint, self._intake, space)
            self._step, self._time, self._next_id = state["step"], state["time"], state["next_id"]
        if generation is not None:
            self._next_id = (generation << 32) + 1
        self._journal.event(start_event(self.config, epoch, generation, checkpoint))

    @property
    def time(self) -> int:
        """Time of the newest step, ns; -1 before the first."""
        return self._time

    @property
    def intensity(self) -> Mixture | None:
        """The fused intensity after the last step of this run, heaviest component first; None where it is nought."""
        return self._fused.mixture()

    def handle(self, event: Event, received: int) -> None:
        """Queue a message or another event for the next step; `received` is when it came, ns."""
        self._intake.put(event, received)

    def step(self, time: int) -> StepResult:
        """Make the step at `time`, ns, which must be after the last. `ValueError` if it is not."""
        if time <= self._time:
            raise ValueError(f"a step at {time} is not after the last, at {self._time}")
        self._step += 1
        journal = self._journal
        self._obey(self._intake.admit(time, self._time, journal))
        self._time = time
        rows = usable_rows(self._intake, time, journal)
        names = self._intake.names()
        journal.name_sources(names)
        self._fused = self._fuse(rows, names, time)
        share = self._follow(names, time)
        tracks = self._publish(share, names)
        log = journal.write(self.epoch, self._published, self._step, time)
        self._published += 1
        kinds = Counter(self._picture.status.tolist())
        numbers = {name: kinds.get(code, 0) for code, name in enumerate(words.STATUSES)}
        numbers |= {"expected": round(self._fused.mass), "components": len(self._fused.weight)}
        return StepResult(tracks, log, step_status(self._intake, journal, log, numbers, self.refusals()))

    def refusals(self) -> dict[str, int]:
        """Refusals by reason since the start, those included that no step has told yet."""
        return dict(sorted((self._journal.refused + self._intake.waiting_refusals()).items()))

    def checkpoint(self) -> bytes:
        """The whole state but what is queued, as versioned MessagePack: a centre made from it goes on as this one."""
        state = {
            "space": list(self.config.space),
            "step": self._step,
            "time": self._time,
            "next_id": self._next_id,
            "agreeing": [],
        }
        return pack_state(self.config_hash, state, self._intake, self._picture)

    def _nothing(self, sources: int) -> Components:
        n = len(self.config.space)
        return Components(np.zeros(0), np.zeros((n, 0)), np.zeros((n, n, 0)), np.zeros((sources, 0)))

    def _obey(self, orders: list[Order]) -> None:
        doomed = {order.track for order in orders if order.what == "delete" and order.track is not None}
        gone = np.array([track in doomed for track in self._picture.id.tolist()], dtype=np.bool_)
        for track in self._picture.id[gone].tolist():
            self._journal.end(track, "ordered", None)
        self._picture = self._picture.take(~gone)

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
        ids = np.arange(self._next_id, self._next_id + len(free), dtype=np.uint64)
        self._next_id += len(free)
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
        picture, ended = live_on(picture, time, supporting.sum(axis=0), fresh, self.config, self._journal)
        return picture.take(~ended), ended

    def _publish(self, share: Floats, names: tuple[str, ...]) -> GlobalTracks:
        picture, sources = self._picture, self._intake.sources
        owner, source = np.nonzero(share.T > 0)
        epochs = np.array([max(sources[name].epoch, 0) for name in names], dtype=np.uint64)
        contributions = Contributions(
            counts=np.bincount(owner, minlength=len(picture.id)),
            source=source,
            epoch=epochs[source],
            id=np.zeros(len(source), dtype=np.uint64),
            influence=share.T[owner, source],
        )
        return picture_message(
            picture,
            self._intake,
            self._journal,
            contributions,
            epoch=self.epoch,
            seq=self._published,
            step=self._step,
            time=self._time,
            rule=self.config.intensity_rule,
        )
