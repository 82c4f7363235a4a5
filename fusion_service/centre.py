"""`FusionCentre`: the whole job with no clock, no thread, no socket.

Everything that changes a result enters by `handle`; `step(time)` takes what is queued with a time up to then,
predicts, links, fuses and returns the global tracks, a log that is enough to make the step again, and status.
Within a step inputs are sorted by (source, epoch, seq) before anything is computed, so the order of arrival
does not matter, and no operation's bits depend on the size of its batch: the same events give the same bytes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib import metadata
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from fusion_service import linalg
from fusion_service.association import by_size, candidate_pairs, cluster, leave_one_out, pair_distance, uniform_ci
from fusion_service.checkpoint import pack_state, unpack_state
from fusion_service.config import CentreConfig, centre_config, config_hash
from fusion_service.intake import Event, Intake, Order, Refused, SourceFound, SourceLost
from fusion_service.journal import Journal
from fusion_service.lifecycle import advance, empty_picture, newborn
from fusion_service.motion import predict
from fusion_service.rules import Fused, fuse_last
from fusion_service.sources import Source, Tracks
from schemas import ORIGINS, Entry, GlobalTracks, Local, Status, StepLog
from schemas import messages as words

__all__ = ["FusionCentre", "Order", "Refused", "SourceFound", "SourceLost", "StepResult"]

VERSION = metadata.version("track-fusion-centre")
NO_TRACK = np.uint64(0)


@dataclass(frozen=True, slots=True)
class StepResult:
    """What one step gives."""

    tracks: GlobalTracks
    log: StepLog
    status: Status


class Rows(NamedTuple):
    """The M usable local tracks of all sources at the time of the step, in canonical order.

    source: index into the sorted names; the columns of `Tracks`, with mean (n, M) and covariance (n, n, M)
    predicted and marginalised to the centre's space; kept: for each source the rows of its table used.
    """

    source: NDArray[np.intp]
    epoch: NDArray[np.uint64]
    tracks: Tracks
    may_start: NDArray[np.bool_]
    kept: dict[str, NDArray[np.intp]]


class FusionCentre:
    """Associates and fuses the tracks of many sources into one picture.

    config: a `CentreConfig`, or a dict of the same shape ({} gives the defaults; `ConfigError` says all that
    is wrong). checkpoint: what `checkpoint()` gave before. generation: the upper half of the ids given from
    now on; a new one for every start keeps ids from ever being used again (a checkpoint alone goes on in its
    own generation). epoch: start of this run, ns, for the header of what it publishes.
    """

    def __init__(
        self,
        config: CentreConfig | Mapping[str, Any],
        checkpoint: bytes | None = None,
        *,
        generation: int | None = None,
        epoch: int = 0,
    ) -> None:
        self.config = centre_config(config)
        self.config_hash = config_hash(self.config)
        self.epoch = epoch
        self._n = len(self.config.space)
        self._intake = Intake(self.config)
        self._picture = empty_picture(self._n)
        self._agreeing: dict[tuple[int, int], int] = {}
        self._step = 0
        self._published = 0
        self._time = -1
        self._next_id = 1
        self._journal = Journal(self.config.name, self.config_hash, VERSION)
        start: dict[str, Any] = {"kind": "start", "epoch": epoch}
        if checkpoint is not None:
            self._restore(checkpoint)
            start["checkpoint"] = checkpoint
        if generation is not None:
            self._next_id = (generation << 32) + 1
            start["generation"] = generation
        self._journal.event(start)
        gates = chi2.ppf([self.config.gate, self.config.keep_gate], self._n)
        self._gate, self._keep_gate = float(gates[0]), float(gates[1])

    @property
    def time(self) -> int:
        """Time of the newest step, ns; -1 before the first."""
        return self._time

    def handle(self, event: Event, received: int) -> None:
        """Queue a message or another event for the next step; `received` is when it came, ns. Never raises
        for what a message contains: it is checked, and refused with a reason, in the step."""
        self._intake.put(event, received)

    def step(self, time: int) -> StepResult:
        """Make the step at `time`, ns, which must be after the last. `ValueError` if it is not."""
        if time <= self._time:
            raise ValueError(f"a step at {time} is not after the last, at {self._time}")
        self._step += 1
        journal = self._journal
        orders = self._intake.admit(time, self._time, journal)
        self._obey(orders)
        self._time = time
        rows = self._rows(time)
        names = self._intake.names()
        journal.name_sources(names)
        self._check_links(rows)
        pairs = self._link(rows, time)
        self._merge(rows, pairs)
        contributions = self._fuse(rows, time)
        self._live(rows, contributions, time)
        self._write_back(rows)
        tracks = self._publish(rows, contributions, names)
        log = journal.write(self.epoch, self._published, self._step, time)
        self._published += 1
        return StepResult(tracks, log, self._status(time))

    def checkpoint(self) -> bytes:
        """The whole state but what is queued, as versioned MessagePack: a centre made from it goes on as this one."""
        return pack_state(
            self.config_hash,
            {
                "space": list(self.config.space),
                "step": self._step,
                "time": self._time,
                "next_id": self._next_id,
                "agreeing": [[a, b, count] for (a, b), count in sorted(self._agreeing.items())],
            },
            self._intake,
            self._picture,
        )

    def _restore(self, blob: bytes) -> None:
        state, picture = unpack_state(blob, self._intake, self.config.space)
        self._step, self._time, self._next_id = state["step"], state["time"], state["next_id"]
        self._agreeing = {(a, b): count for a, b, count in state["agreeing"]}
        self._picture = picture

    def _obey(self, orders: list[Order]) -> None:
        doomed = [order.track for order in orders if order.what == "delete" and order.track is not None]
        if doomed:
            gone = np.isin(self._picture.id, np.array(doomed, dtype=np.uint64))
            for track in self._picture.id[gone].tolist():
                self._journal.end(track, "ordered", None)
            self._unlink(self._picture.id[gone])
            self._picture = self._picture.take(~gone)

    def _unlink(self, ids: NDArray[np.uint64]) -> None:
        for source in self._intake.sources.values():
            gone = np.isin(source.tracks.link, ids)
            if gone.any():
                source.tracks = replace(source.tracks, link=np.where(gone, NO_TRACK, source.tracks.link))

    # One step, in order

    def _rows(self, time: int) -> Rows:
        parts: list[Tracks] = []
        source_index: list[NDArray[np.intp]] = []
        epochs: list[NDArray[np.uint64]] = []
        starts: list[NDArray[np.bool_]] = []
        kept: dict[str, NDArray[np.intp]] = {}
        for index, (name, source) in enumerate(sorted(self._intake.sources.items())):
            said = self._intake.declared(source)
            oldest = time - round(self.config.stale_periods * said.period * 1e9)
            table = source.tracks
            source.tracks = table = table.take(table.time >= oldest)
            if source.muted or not self._intake.ready(source):
                continue
            dt = (time - table.time) / 1e9
            mean, covariance = predict(said.motion, source.space, table.mean, table.covariance, dt)
            at = [source.space.index(component) for component in self.config.space]
            mean, covariance = mean[at], covariance[np.ix_(at, at)]
            sound = np.flatnonzero(linalg.is_positive_definite(covariance) & np.isfinite(mean).all(axis=0))
            kept[name] = sound
            parts.append(replace(table, mean=mean, covariance=covariance).take(sound))
            source_index.append(np.full(len(sound), index, dtype=np.intp))
            epochs.append(np.full(len(sound), source.epoch, dtype=np.uint64))
            starts.append(np.full(len(sound), said.may_start, dtype=np.bool_))
        if not parts:
            nothing = self._intake.nothing()
            zero = np.zeros(0, dtype=np.intp)
            return Rows(zero, nothing.id, nothing, zero.astype(np.bool_), kept)
        columns = (np.concatenate([getattr(part, name) for part in parts], axis=-1) for name in Tracks.__slots__)
        return Rows(
            np.concatenate(source_index), np.concatenate(epochs), Tracks(*columns), np.concatenate(starts), kept
        )

    def _check_links(self, rows: Rows) -> None:
        """Keep a standing link while its track agrees with the fusion of the others; break it on evidence."""
        tracks = rows.tracks
        linked = np.flatnonzero(tracks.link != NO_TRACK)
        if not len(linked):
            return
        links = tracks.link[linked]
        distance = leave_one_out(links, tracks.mean[:, linked], tracks.covariance[:, :, linked])
        failed = distance > self._keep_gate
        tracks.fails[linked] = np.where(failed, tracks.fails[linked] + 1, 0)
        self._journal.decide(words.GATE_FAILED, rows, linked[failed], links[failed], distance[failed])
        ripe = np.flatnonzero(tracks.fails[linked] >= self.config.break_after)
        if len(ripe):
            # of one global track only the worst leaves at a time: farthest, then youngest, then last in order
            order = np.lexsort((-ripe, -tracks.since[linked[ripe]], -distance[ripe], links[ripe]))
            first = np.append(True, links[ripe][order][1:] != links[ripe][order][:-1])
            worst = ripe[order][first]
            self._journal.decide(words.BROKEN, rows, linked[worst], links[worst], distance[worst])
            self._journal.broken = {int(row): int(link) for row, link in zip(linked[worst], links[worst], strict=True)}
            tracks.link[linked[worst]] = NO_TRACK
            tracks.fails[linked] = np.where(np.isin(links, links[worst]), 0, tracks.fails[linked])
        stays = tracks.link[linked] != NO_TRACK
        self._journal.decide(
            words.KEPT, rows, linked[stays & ~failed], links[stays & ~failed], distance[stays & ~failed]
        )

    def _link(self, rows: Rows, time: int) -> list[tuple[int, int, float]]:
        """Link free tracks to global tracks or to each other; return the pairs of global tracks that agree."""
        tracks, picture = rows.tracks, self._picture
        mean, covariance = self._predicted(time)
        linked = np.flatnonzero(tracks.link != NO_TRACK)
        bits = np.left_shift(1, rows.source) if rows.source.max(initial=0) < 62 else _wide_bits(rows.source)
        masks = np.zeros(len(picture.id), dtype=bits.dtype)
        for ids, members in by_size(tracks.link[linked]):
            at, chosen = picture.find(ids), linked[members]
            fused = uniform_ci(
                np.moveaxis(tracks.mean[:, chosen], 2, 0), np.moveaxis(tracks.covariance[:, :, chosen], 3, 0)
            )
            mean[:, at], covariance[:, :, at] = fused
            masks[at] = np.bitwise_or.reduce(bits[chosen], axis=1)
        free = np.flatnonzero(tracks.link == NO_TRACK)
        known = np.flatnonzero(picture.time >= 0)
        count = len(known)
        mean = np.concatenate([mean[:, known], tracks.mean[:, free]], axis=1)
        covariance = np.concatenate([covariance[:, :, known], tracks.covariance[:, :, free]], axis=2)
        masks = np.concatenate([masks[known], bits[free]])
        places = [self.config.space.index(axis) for axis in ("x", "y", "z") if axis in self.config.space]
        sigma = np.sqrt(sum(covariance[place, place] for place in places))
        i, j = candidate_pairs(mean[places], sigma, float(np.sqrt(self._gate)))
        disjoint = (masks[i] & masks[j]) == 0
        i, j = i[disjoint], j[disjoint]
        distance, spread = pair_distance(mean, covariance, i, j)
        near = distance <= self._gate
        i, j, distance, spread = i[near], j[near], distance[near], spread[near]
        both = j < count
        agreeing = [
            (int(picture.id[known[a]]), int(picture.id[known[b]]), float(d))
            for a, b, d in zip(i[both], j[both], distance[both], strict=True)
        ]
        if len(free):
            whole = [k < count for k in range(mean.shape[1])]
            root, _ = cluster(i[~both], j[~both], (distance + spread)[~both], masks.tolist(), whole)
            best = dict(zip(zip(i.tolist(), j.tolist(), strict=True), distance.tolist(), strict=True))
            self._settle(rows, free, known, np.array(root, dtype=np.intp), best, time)
        return agreeing

    def _settle(
        self,
        rows: Rows,
        free: NDArray[np.intp],
        known: NDArray[np.intp],
        root: NDArray[np.intp],
        distance: dict[tuple[int, int], float],
        time: int,
    ) -> None:
        """Give every free track of a cluster its global track, a new one where the cluster has none."""
        tracks, count = rows.tracks, len(known)
        roots = root[count:]
        starting = np.unique(roots[(roots >= count) & rows.may_start[free]])
        new_ids = np.arange(self._next_id, self._next_id + len(starting), dtype=np.uint64)
        self._next_id += len(starting)
        ids = np.zeros(len(root), dtype=np.uint64)
        ids[:count] = self._picture.id[known]
        ids[starting] = new_ids
        given = ids[roots]
        takes = given != NO_TRACK
        tracks.link[free] = given
        tracks.since[free[takes]] = self._step
        tracks.fails[free[takes]] = 0
        tracks.used[free[takes]] = -1
        values = np.array([distance.get((int(r), count + k), np.nan) for k, r in enumerate(roots)])
        self._journal.decide(words.LINKED, rows, free[takes], given[takes], values[takes])
        self._journal.birth(new_ids)
        born = set(new_ids.tolist())
        for row, old in self._journal.broken.items():
            link = int(tracks.link[row])
            if link in born:
                self._journal.split(link, old)
        self._picture = self._picture.join(newborn(new_ids, self._n, time))

    def _merge(self, rows: Rows, pairs: list[tuple[int, int, float]]) -> None:
        """Join global tracks that have agreed for several steps in a row: the older one lives on."""
        self._agreeing = {(a, b): self._agreeing.get((a, b), 0) + 1 for a, b, _ in pairs}
        ripe = [(a, b, d) for a, b, d in pairs if self._agreeing[a, b] >= self.config.merge_after]
        taken: set[int] = set()
        for a, b, distance in sorted(ripe, key=lambda pair: (pair[2], pair[0], pair[1])):
            if taken & {a, b}:
                continue
            taken |= {a, b}
            old, new = np.uint64(a), np.uint64(b)
            self._journal.merge(a, b, distance)
            moved = rows.tracks.link == new
            rows.tracks.link[moved] = old
            rows.tracks.since[moved] = self._step
            self._move_links(new, old)
            self._picture = self._picture.take(self._picture.id != new)
        self._agreeing = {pair: count for pair, count in self._agreeing.items() if not taken & set(pair)}

    def _move_links(self, old: np.uint64, new: np.uint64) -> None:
        for source in self._intake.sources.values():
            link = source.tracks.link
            source.tracks = replace(source.tracks, link=np.where(link == old, new, link))

    def _predicted(self, time: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        picture = self._picture
        dt = np.where(picture.time >= 0, time - picture.time, 0) / 1e9
        return predict(self.config.motion, self.config.space, picture.mean, picture.covariance, dt)

    def _fuse(self, rows: Rows, time: int) -> NDArray[np.float64]:
        """Fuse the tracks of every global track at once; influence (M,) of each row, NaN where it has no link."""
        tracks, picture, config = rows.tracks, self._picture, self.config
        influence = np.full(len(tracks.id), np.nan)
        linked = tracks.link != NO_TRACK
        influence[linked] = 0.0
        mean, covariance = self._predicted(time)
        state_time = np.where(picture.time >= 0, time, -1)
        used = linked if config.memory == "restart" else linked & (tracks.time > tracks.used)
        chosen = np.flatnonzero(used)
        for ids, groups in by_size(tracks.link[chosen]):
            at, members = picture.find(ids), chosen[groups]
            means = np.ascontiguousarray(np.moveaxis(tracks.mean[:, members], 2, 0))
            covariances = np.ascontiguousarray(np.moveaxis(tracks.covariance[:, :, members], 3, 0))
            fused = fuse_last(config.rule, means, covariances, influence=True, **config.rule_options)
            one, spread, gains = fused.mean, fused.covariance, _influence(fused)
            old = np.flatnonzero(picture.time[at] >= 0) if config.memory == "recursive" else at[:0]
            if len(old):
                again = fuse_last(
                    "bci",
                    np.stack([one[:, old], mean[:, at[old]]]),
                    np.stack([spread[:, :, old], covariance[:, :, at[old]]]),
                    influence=True,
                    max_correlation=config.memory_correlation,
                )
                one[:, old], spread[:, :, old] = again.mean, again.covariance
                gains[:, old] *= _influence(again)[0]
            bad = ~(linalg.is_positive_definite(spread) & np.isfinite(one).all(axis=0))
            if bad.any():
                one[:, bad], spread[:, :, bad] = uniform_ci(means[:, :, bad], covariances[:, :, :, bad])
                self._journal.refuse(Entry("", 0, 0, 0, "fusion", int(bad.sum())))
            mean[:, at], covariance[:, :, at], state_time[at] = one, spread, time
            influence[members] = gains.T
        tracks.used[chosen] = tracks.time[chosen]
        self._picture = replace(picture, mean=mean, covariance=covariance, time=state_time)
        return influence

    def _live(self, rows: Rows, influence: NDArray[np.float64], time: int) -> None:
        tracks, picture = rows.tracks, self._picture
        linked = np.flatnonzero(tracks.link != NO_TRACK)
        at = picture.find(tracks.link[linked])
        support = np.bincount(at, minlength=len(picture.id))
        updated = picture.updated.copy()
        np.maximum.at(updated, at, tracks.updated[linked])
        newest = np.full(len(picture.id), -1, dtype=np.int64)
        np.maximum.at(newest, at, tracks.time[linked])
        fresh = newest > picture.seen
        said = np.isfinite(tracks.existence[linked])
        total = np.zeros(len(picture.id))
        np.add.at(total, at[said], tracks.existence[linked][said])
        votes = np.bincount(at[said], minlength=len(picture.id))
        existence = np.where(votes > 0, total / np.maximum(votes, 1), picture.existence)
        before = picture.status
        seen = np.maximum(picture.seen, newest)
        picture = replace(picture, updated=updated, existence=existence, seen=seen)
        picture, ended = advance(picture, time, support, fresh, self.config)
        for track in picture.id[ended].tolist():
            self._journal.end(track, "lost", None)
        for status, decision in ((words.CONFIRMED, words.CONFIRMED_NOW), (words.COASTING, words.COASTING_NOW)):
            self._journal.tracks(decision, picture.id[(picture.status == status) & (before != status) & ~ended])
        self._unlink(picture.id[ended])
        self._picture = picture.take(~ended)

    def _write_back(self, rows: Rows) -> None:
        start = 0
        for name, kept in rows.kept.items():
            source, end = self._intake.sources[name], start + len(kept)
            columns = {}
            for column in ("link", "since", "fails", "used"):
                columns[column] = getattr(source.tracks, column).copy()
                columns[column][kept] = getattr(rows.tracks, column)[start:end]
            source.tracks = replace(source.tracks, **columns)
            start = end

    def _publish(self, rows: Rows, influence: NDArray[np.float64], names: tuple[str, ...]) -> GlobalTracks:
        picture, tracks = self._picture, rows.tracks
        linked = np.flatnonzero(tracks.link != NO_TRACK)
        linked = linked[np.argsort(tracks.link[linked], kind="stable")]
        counts = np.bincount(picture.find(tracks.link[linked]), minlength=len(picture.id))
        origins = {source.origin for source in self._intake.sources.values() if source.messages}
        return GlobalTracks(
            source=self.config.name,
            epoch=self.epoch,
            seq=self._published,
            sent=self._time,
            origin=max(origins, key=ORIGINS.index, default="live"),
            lineage=(*(name for name in names if name != self.config.name), self.config.name),
            time=self._time,
            step=self._step,
            rule=self.config.rule,
            space=self.config.space,
            frame=self._intake.frame or Local("none"),
            ids=picture.id,
            status=picture.status,
            existence=picture.existence,
            means=np.ascontiguousarray(picture.mean.T),
            covariances=np.ascontiguousarray(np.moveaxis(picture.covariance, 2, 0)),
            updated=picture.updated,
            sources=names,
            contributor_counts=counts.astype(np.uint16),
            contributor_source=rows.source[linked].astype(np.uint16),
            contributor_epoch=rows.epoch[linked],
            contributor_id=tracks.id[linked],
            contributor_influence=influence[linked],
            ended=self._journal.ended(),
            split_from=self._journal.splits(),
        )

    def _status(self, time: int) -> Status:
        kinds = Counter(self._picture.status.tolist())
        return Status(
            source=self.config.name,
            epoch=self.epoch,
            seq=self._published - 1,
            sent=time,
            time=time,
            step=self._step,
            uptime=0.0,
            rates={},
            queue={"pending": self._intake.pending()},
            refused=dict(sorted(self._journal.refused.items())),
            dropped=dict(sorted(self._journal.dropped.items())),
            sources={name: self._health(source, time) for name, source in sorted(self._intake.sources.items())},
            tracks={name: kinds.get(code, 0) for code, name in enumerate(words.STATUSES)},
            step_time={},
        )

    def _health(self, source: Source, time: int) -> dict[str, Any]:
        period = self._intake.declared(source).period
        return {
            "epoch": max(source.epoch, 0),
            "alive": source.alive,
            "stale": source.last < 0 or time - source.last > self.config.stale_periods * period * 1e9,
            "muted": source.muted,
            "last": source.last,
            "offset": source.offset / 1e9,
            "messages": source.messages,
            "repeats": source.repeats,
            "gaps": source.gaps,
            "reordered": source.reordered,
            "tracks": len(source.tracks.id),
        }


def _influence(fused: Fused) -> NDArray[np.float64]:
    assert fused.influence is not None
    return fused.influence


def _wide_bits(source: NDArray[np.intp]) -> NDArray[Any]:
    bits = np.empty(len(source), dtype=object)
    bits[:] = [1 << int(index) for index in source]
    return bits
