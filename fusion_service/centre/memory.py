"""What a centre remembers of its targets beside the picture, and which rows take part in it in which way.

With `memory = "tracklet"` a global track that two capable rows feed goes by the filter of the target (`tracklets`), and
with one of them alone it stays there; every other one goes by the rule of the config, from the rows of the step alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Floats, Ints, among, marked
from fusion_service.centre import kinship
from fusion_service.centre.association import by_size
from fusion_service.centre.correlation import AUTO, declared_correlation, declared_motions, sound_rows
from fusion_service.centre.derived import Derived, Followed
from fusion_service.centre.extents import off_centre
from fusion_service.centre.fusing import fuse_all, with_parts
from fusion_service.centre.increments import Increments, increments
from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.kept_weights import KeptWeights
from fusion_service.centre.lifecycle import WAYS, Picture
from fusion_service.centre.motions import Motions, States
from fusion_service.centre.partial import AXES, PLACED, Unknown
from fusion_service.centre.rows import Rows
from fusion_service.centre.shared_noise import shared_noise
from fusion_service.centre.tracklets import Filters, Operations, closed, run
from fusion_service.centre.versions import Versions, versions_of
from fusion_service.centre.watch import UNTRUE, WATCHED, Watch
from fusion_service.records import altered
from schemas import Entry

__all__ = ["Memory"]

BY_TRACKLETS = WAYS.index("tracklet")


class Memory:
    """The filters of targets, the motions they go by, and the watch over the sources that feed them."""

    def __init__(self, intake: Intake) -> None:
        self._intake = intake
        self._config = intake.config
        self.motions = Motions(intake)
        self.watch = Watch()
        self.weights = KeptWeights() if self._config.weights == "kept" else None
        self._begin()

    def _begin(self) -> None:
        """Nothing that is in the picture's frame is known."""
        self._frame = self._intake.frame
        self.filters = Filters.none(len(self._config.space))
        self.derived = Derived(len(self._config.space))

    def fuse(
        self, rows: Rows, names: tuple[str, ...], before: Picture, now: Picture, step: int, time: int, journal: Journal
    ) -> tuple[Picture, Floats]:
        """The picture of the step at `time`, ns, and the influence (M,) of each row, as `fusing.fuse_all`. before:
        the picture after the last step, `now` the same predicted to `time`."""
        fused = self._fuse(rows, names, before, now, step, time, journal)
        if self.weights is not None:
            self.weights.turn()
        return fused

    def _fuse(
        self, rows: Rows, names: tuple[str, ...], before: Picture, now: Picture, step: int, time: int, journal: Journal
    ) -> tuple[Picture, Floats]:
        if not self._config.follows:
            known = declared_correlation(self._intake, self._config, None, self.weights)
            picture, influence = fuse_all(rows, now, time, known, journal)
            return self._moving(rows, names, picture), influence
        if self._frame != self._intake.frame:
            self._begin()
        for event in self.watch.begin(self._intake, names):
            if self._config.by_tracklets:
                journal.event(event)
        versions = versions_of(self._intake, rows, time)
        found = increments(versions)
        at = np.where(rows.inside_mask(), now.find(rows.tracks.link), -1)
        capable = self._capable(rows, names)
        filtered = np.append(self._filtered(now, before, at, capable), False)
        followed = self._followed(rows, names, versions, ~filtered[at], time, journal)
        known = declared_correlation(self._intake, self._config, followed, self.weights)
        if not self._config.by_tracklets:
            picture, influence = fuse_all(rows, now, time, known, journal)
            none = np.zeros(len(versions.row), dtype=np.bool_)
            self._note(rows, names, versions.row, (at >= 0) & (rows.tracks.since < step), found, none)
            return self._moving(rows, names, picture), influence
        picture, influence = fuse_all(rows, now, time, known, journal, filtered[at])
        ruled = np.zeros(len(now.id) + 1, dtype=np.bool_)
        ruled[at[~filtered[at]]] = True
        picture = self._filter(
            rows, names, before, picture, influence, at, capable, filtered, ruled[:-1], step, time, versions, found
        )
        return self._moving(rows, names, picture), influence

    def _filtered(self, now: Picture, before: Picture, at: Ints, capable: Bools) -> Bools:
        """Which tracks (G,) go by a filter: that two capable rows feed, or one alone where there is a filter already.
        A filter of one row would only do again what its tracker has done."""
        fed, count = at >= 0, len(now.id)
        able = np.bincount(at[fed & capable], minlength=count)
        other = np.bincount(at[fed & ~capable], minlength=count)
        held = among(now.id, self.filters.id)
        begun = (before.time >= 0) & self._config.by_tracklets
        return np.asarray(((able > 1) | (held & (able > 0) & (other == 0))) & begun)

    def _moving(self, rows: Rows, names: tuple[str, ...], picture: Picture) -> Picture:
        """The picture, its tracks moving as the sources that feed them declare."""
        inside = rows.inside()
        sources = (self._intake.sources[name] for name in names)
        declared = [self._intake.motion_said(source) for source in sources]
        at = picture.find(rows.tracks.link[inside])
        return altered(picture, motion=self.motions.follow(picture, at, declared, rows.source[inside]))

    def _followed(
        self, rows: Rows, names: tuple[str, ...], versions: Versions, ruled: Bools, time: int, journal: Journal
    ) -> Followed | None:
        """What successive covariances tell of the correlation of rows that go by the rule, `ruled` (M,); by rule auto
        not of those whose own innovations speak against what they say."""
        if not self._config.by_derived:
            return None
        chosen = self._config.rule != AUTO
        trusted = [chosen or self.watch.records[name].reason not in UNTRUE for name in names]
        sound = ruled & sound_rows(rows) & kinship.alone(self._intake, rows) & ~off_centre(rows, self._config.space)
        sound &= np.array(trusted, dtype=np.bool_)[rows.source]
        noise = shared_noise(tuple(declared_motions(self._intake)), self._config.space)
        followed = self.derived.follow(rows, names, versions, noise, sound, time)
        if self.derived.beyond:
            journal.refuse(Entry("", 0, 0, 0, "too-many-pairs", self.derived.beyond))
        return followed

    def _capable(self, rows: Rows, names: tuple[str, ...]) -> Bools:
        """Rows (M,) whose versions may be taken as tracklets."""
        treatments = [self._intake.treatment(name) for name in names]
        able = (
            not (self.watch.records[name].reason or one.union or one.lasting)
            for name, one in zip(names, treatments, strict=True)
        )
        sources = np.array([*able], dtype=np.bool_)[rows.source] & ~off_centre(rows, self._config.space)
        return sources & sound_rows(rows) & ~self._unseen(rows, names) & kinship.alone(self._intake, rows)

    def _unseen(self, rows: Rows, names: tuple[str, ...]) -> Bools:
        """Rows (M,) of a place whose velocity is not known, as of a source that does not tell it (see `watch`)."""
        space, covariance = self._config.space, rows.tracks.covariance
        known = Unknown.of(space).known(covariance)
        unseen = np.zeros(len(rows.source), dtype=np.bool_)
        for place, speed in AXES:
            if place in space and speed in space:
                unseen |= known[space.index(place)] & ~known[space.index(speed)]
        said = (self._intake.declared(self._intake.sources[name]).motion.kind for name in names)
        return unseen & ~np.array([kind in PLACED for kind in said], dtype=np.bool_)[rows.source]

    def _filter(
        self, rows: Rows, names: tuple[str, ...], before: Picture, picture: Picture, influence: Floats, at: Ints,
        capable: Bools, filtered: Bools, ruled: Bools, step: int, time: int, versions: Versions, found: Increments,
    ) -> Picture:  # fmt: skip
        """Run the filters of the tracks `filtered`, and write the influences of their rows."""
        tracks = rows.tracks
        self.filters.rename(names)
        base = self.filters.bases(before)
        stays = (at >= 0) & (tracks.since < step)
        settled = filtered[at] & stays
        row = versions.row
        good = found.sound & (capable & settled)[row] & (versions.time >= np.append(base.time, 0)[at[row]])
        spoiled = np.zeros(len(at), dtype=np.bool_)
        spoiled[row[~good]] = True
        good &= ~spoiled[row]
        whole = filtered[at] & (tracks.time > tracks.used) & (spoiled | ~capable | ~settled)
        self._note(rows, names, row, stays, found, good)
        new = self._as_operations(rows, names, versions, found, marked(good))
        kept = among(self.filters.pending.track, picture.id[filtered[:-1]])
        operations = self.filters.pending.take(kept).join(new, _whole(rows, marked(whole), time))
        some = marked(filtered[:-1])
        which = np.searchsorted(picture.id[some], operations.track)
        cut = closed(self._cut(rows, names, at, len(picture.id), time)[some], which, operations.time)
        states, bases, share, beside = run(base.take(some), which, operations, cut, time, self.motions)
        fresh = operations.row >= 0
        np.add.at(influence, operations.row[fresh], share[fresh])
        told = fresh & self._as_said(names)[operations.source]
        self.watch.add_beside(names, operations.source[told], beside[:, told])
        tracks.used[filtered[at]] = tracks.time[filtered[at]]
        open_ = operations.take(operations.time > cut[which])
        self._keep(picture, bases, some, open_, ruled)
        mean, covariance, when = picture.mean.copy(), picture.covariance.copy(), picture.time.copy()
        mean[:, some], covariance[:, :, some], when[some] = states.mean, states.covariance, time
        lineage = picture.lineage.copy()
        fed = marked(filtered[at])
        for ids, groups in by_size(tracks.link[fed]):
            there = picture.find(ids)
            lineage[there] = kinship.inherited(rows, fed[groups], lineage[there], memory=True)
        way = np.where(filtered[:-1], BY_TRACKLETS, picture.way).astype(np.uint8)
        picture = altered(picture, mean=mean, covariance=covariance, time=when, lineage=lineage, way=way)
        return with_parts(picture, some, [])

    def _note(
        self, rows: Rows, names: tuple[str, ...], row: Ints, stays: Bools, found: Increments, taken: Bools
    ) -> None:
        """Let the watch see the versions that count: of sources that declare what it takes, Gaussian, and of rows that
        stay (M,) in their track: a jump out of it is an id that went over to another object."""
        watched = [self.watch.records[name].reason in WATCHED for name in names]
        mine = (np.array(watched, dtype=np.bool_)[rows.source] & stays & sound_rows(rows))[row]
        self.watch.add(names, rows.source[row][mine], found.take(mine), taken[mine])

    def _as_operations(
        self, rows: Rows, names: tuple[str, ...], versions: Versions, found: Increments, some: Ints
    ) -> Operations:
        inflation = np.array([self._inflation(name) for name in names])
        row = versions.row[some]
        scale = 1.0 / inflation[rows.source[row]]
        return Operations(
            rows.tracks.link[row], versions.time[some], rows.source[row].astype(np.int64), rows.tracks.id[row],
            np.zeros(len(some), dtype=np.bool_), versions.predicted_mean[:, some], found.vector[:, some] * scale,
            found.information[:, :, some] * scale, row,
        )  # fmt: skip

    def _as_said(self, names: tuple[str, ...]) -> Bools:
        """Of which sources the covariances are taken as they say: what is inflated agrees with anything."""
        return np.array([self._intake.treatment(name).inflation == (1.0, 1.0) for name in names], dtype=np.bool_)

    def _inflation(self, name: str) -> float:
        said = self._intake.declared(self._intake.sources[name])
        found = max(self.watch.records[name].inflation, *self._intake.treatment(name).inflation)
        return said.inflation * found

    def _cut(self, rows: Rows, names: tuple[str, ...], at: Ints, count: int, time: int) -> NDArray[np.int64]:
        """Up to when (G,) all is in that the sources of each track will send."""
        intake = self._intake
        lags = [max(intake.sources[name].lag + intake.treatment(name).clock, 0) for name in names]
        lag = np.array(lags, dtype=np.int64)
        late = np.zeros(count, dtype=np.int64)
        fed = at >= 0
        np.maximum.at(late, at[fed], lag[rows.source[fed]])
        return time - np.minimum(late, round(self._config.lateness * 1e9))

    def _keep(self, picture: Picture, bases: States, some: Ints, pending: Operations, ruled: Bools) -> None:
        """The filters of the next step: those that ran, and those that nothing was said of."""
        held = self.filters
        quiet = among(held.id, picture.id[~ruled]) & ~among(held.id, picture.id[some])
        ids = np.concatenate([picture.id[some], held.id[quiet]])
        order = np.argsort(ids, kind="stable")
        one, other = bases, held.base.take(quiet)
        base = States.of(
            np.concatenate([one.time, other.time])[order],
            np.concatenate([one.mean, other.mean], axis=-1)[..., order],
            np.concatenate([one.covariance, other.covariance], axis=-1)[..., order],
            np.concatenate([one.motion, other.motion])[order],
        )
        rest = held.pending.take(among(held.pending.track, held.id[quiet]))
        pending = altered(pending, row=np.full_like(pending.row, -1))
        self.filters = Filters(held.names, ids[order], base, pending.join(rest))

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns."""
        self.filters.rebase(time)
        self.derived = Derived(len(self._config.space))

    def packed(self) -> dict[str, Any]:
        """As plain values. What is in the picture's frame and space says which."""
        packed = {
            "frame": repr(self._intake.frame), "space": list(self._config.space), "motions": self.motions.packed(),
            "watch": self.watch.packed(), "filters": self.filters.packed(),
        }  # fmt: skip
        packed |= {"weights": self.weights.packed()} if self.weights is not None else {}
        return packed | ({"derived": self.derived.packed()} if len(self.derived) else {})

    def restore(self, packed: dict[str, Any]) -> None:
        """From what `packed` gave; without what is in another frame or space."""
        self.motions.restore(packed["motions"])
        self._frame = self._intake.frame
        if self.weights is not None:
            self.weights.restore(packed.get("weights", []))
        if self._config.follows:
            self.watch.restore(packed["watch"])
        if packed["frame"] != repr(self._intake.frame) or packed.get("space") != list(self._config.space):
            return
        if self._config.by_tracklets:
            self.filters = Filters.unpacked(packed["filters"], len(self._config.space))
        if "derived" in packed and self._config.by_derived:
            self.derived.restore(packed["derived"])


def _whole(rows: Rows, some: Ints, time: int) -> Operations:
    """The rows `some` as whole estimates at the step."""
    tracks, count = rows.tracks, len(some)
    mean = tracks.mean[:, some]
    return Operations(
        tracks.link[some], np.full(count, time, dtype=np.int64), rows.source[some].astype(np.int64), tracks.id[some],
        np.ones(count, dtype=np.bool_), mean, np.zeros_like(mean), tracks.covariance[:, :, some], some,
    )  # fmt: skip
