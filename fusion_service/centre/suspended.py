"""Global tracks that nobody has said are gone: every source that could say is silent as a whole.

A source whose network is cut, whose hub hangs or whose process stands still says nothing of its targets, and that is no
word about them. A confirmed track that would end by silence, and was fed by a source that has said nothing since the
report in it (but for what a report and a half takes), is suspended: it leaves the picture as it would, after `coast`,
but does not end. Kept are its density and the local tracks that fed it, by source, epoch and local id. When one of
these speaks again, of the same run, the track goes on under its id, if its target can be where that is:

    d2 of the report to the remembered density, predicted to it by the motion that the source declares, with a velocity
    of any direction added to the one it had (s^2 t^2 on each axis of place, s its speed, t the time since), within
    the gate that a standing link has.

What does not come within `remember` ends, and so does what cannot: the source has begun a new run, or its local id
means another object. Only sources whose token was ever seen are waited for: of others nobody knows whether they are
connected.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints, among, from_bytes, to_bytes
from fusion_service.centre.align import PARTS, predict_tracks
from fusion_service.centre.era import GLOBAL_TIMES, rebased
from fusion_service.centre.evidence import Tests
from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.lifecycle import Picture, empty_picture, newborn
from fusion_service.centre.lineage import NOBODY
from fusion_service.centre.motions import USUAL
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.sources import Source
from fusion_service.centre.tracks import no_parts, set_links
from fusion_service.records import altered, columns_of, names_of

__all__ = ["MOST_SUSPENDED", "Suspended"]

MOST_SUSPENDED = 20_000
"""Tracks that are kept; of more those end that were seen longest ago."""
MOST_TOLD = 1000
VELOCITY = {"x": "vx", "y": "vy", "z": "vz"}
_Ids = NDArray[np.uint64]


class Keys(NamedTuple):
    """The local tracks (K,) of one run of a source, sorted by id: each with the global track that it fed."""

    epoch: int
    id: _Ids
    link: _Ids

    def take(self, some: Bools | Ints) -> Keys:
        """Those given."""
        return Keys(self.epoch, self.id[some], self.link[some])


@dataclass(slots=True, eq=False)
class Suspended:
    """picture: the tracks, Gaussian, as they were when they left; keys: by source; frame: what the densities are in."""

    picture: Picture
    keys: dict[str, Keys]
    frame: str = ""

    @classmethod
    def nothing(cls, n: int) -> Suspended:
        """None, of n components."""
        return cls(empty_picture(n), {})

    def held(self, rows: Rows, names: tuple[str, ...], ids: _Ids, intake: Intake) -> Bools:
        """Which of the tracks `ids` (K,), that would end now by silence, are suspended; their local tracks are noted.
        Call `take` with these."""
        if not len(ids) or not intake.config.suspend:
            return np.zeros(len(ids), dtype=np.bool_)
        sources = [intake.sources[name] for name in names]
        inside = rows.inside()
        inside = inside[among(rows.tracks.link[inside], ids)]
        found: list[_Ids] = []
        for number, (name, source) in enumerate(zip(names, sources, strict=True)):
            if source.alive is None:
                continue
            mine = inside[rows.source[inside] == number]
            tracks, known = rows.tracks, source.remembered
            old = np.flatnonzero(among(known.link, ids))
            quiet = _unheard(source, tracks.time[mine], tracks.interval[mine])
            gone = _unheard(source, known.time[old], known.interval[old])
            id, link = tracks.id[mine[quiet]], tracks.link[mine[quiet]]
            old = old[gone & ~among(known.link[old], link)]
            if len(old):  # of several that are remembered of one track the newest
                old = old[np.lexsort((known.id[old], -known.time[old], known.link[old]))]
                old = old[np.append(True, known.link[old][1:] != known.link[old][:-1])]
                id, link = np.concatenate([id, known.id[old]]), np.concatenate([link, known.link[old]])
            if len(id):
                self._note(name, source.epoch, id, link)
                found.append(link)
        return among(ids, np.concatenate(found)) if found else np.zeros(len(ids), dtype=np.bool_)

    def _note(self, name: str, epoch: int, id: _Ids, link: _Ids) -> None:
        known = self.keys.get(name)
        if known is not None and known.epoch == epoch:
            stays = ~among(known.id, id)
            id, link = np.concatenate([known.id[stays], id]), np.concatenate([known.link[stays], link])
        order = np.argsort(id, kind="stable")
        self.keys[name] = Keys(epoch, id[order], link[order])

    def take(self, picture: Picture, intake: Intake, journal: Journal) -> None:
        """These tracks leave the picture, and are kept."""
        if not len(picture.id):
            return
        count = len(picture.id)
        parts = dict(zip(PARTS, no_parts(len(picture.mean), count), strict=True))
        picture = altered(picture, **parts, lineage=np.full(count, NOBODY, dtype=np.int32))
        picture = altered(picture, motion=np.full(count, -1, dtype=np.int32), extent=np.zeros((0, count)))
        journal.event({"kind": "suspended", "tracks": picture.id[:MOST_TOLD].tolist()})
        both = self.picture.join(picture)
        self.picture = both.take(np.argsort(both.id))
        self.frame = repr(intake.frame)
        if (more := len(self.picture.id) - MOST_SUSPENDED) > 0:
            oldest = np.lexsort((self.picture.id, self.picture.seen))[:more]
            self._end(self.picture.id[oldest], "lost", journal)

    def resume(
        self, rows: Rows, names: tuple[str, ...], picture: Picture, intake: Intake, step: int, time: int,
        tests: Tests, journal: Journal,
    ) -> Picture:  # fmt: skip
        """The picture with the tracks whose local tracks speak again in the step at `time`, ns: their rows are linked
        to them. What is not waited for any more ends."""
        if not len(self.picture.id):
            return picture
        if self.frame != repr(intake.frame):
            self._end(self.picture.id, "frame", journal)
            return picture
        back: list[Picture] = []
        start = 0
        for number, name in enumerate(names):
            part = slice(start, start + rows.kept.get(name, 0))
            start = part.stop
            if name in self.keys:
                back += self._back(rows, part, number, intake.sources[name], intake, step, time, tests)
        both = picture
        for one in back:
            both = both.join(one.take(~among(one.id, both.id)))
        ids = both.id[len(picture.id) :]
        self.drop(ids)
        self._forget(intake, time, journal)
        if not len(ids):
            return picture
        journal.event({"kind": "resumed", "tracks": np.sort(ids)[:MOST_TOLD].tolist()})
        order = both.order()
        return both if order is None else both.take(order)

    def _back(
        self, rows: Rows, part: slice, number: int, source: Source, intake: Intake, step: int, time: int, tests: Tests
    ) -> list[Picture]:
        """Of one source, whose rows are `part`: link the rows that speak again, and give the tracks that are back, as
        they may be now. A local track that is somewhere else is no key any more."""
        keys, tracks = self.keys[source.name], rows.tracks
        if keys.epoch != source.epoch:
            del self.keys[source.name]
            return []
        row = np.arange(part.start, part.stop)
        row = row[rows.fresh[row] & (tracks.link[row] == NO_TRACK) & among(tracks.id[row], keys.id)]
        if not len(row):
            return []
        link = keys.link[np.searchsorted(keys.id, tracks.id[row])]
        there = among(link, self.picture.id)
        row, link = row[there], link[there]
        first = np.unique(link, return_index=True)[1]
        row, link = row[first], link[first]
        self.keys[source.name] = keys.take(~among(keys.id, tracks.id[row]))
        motion = intake.motion_said(source) or intake.config.motion or USUAL
        was = self._now(self.picture.take(self.picture.find(link)), motion, intake, time)
        spread = was.covariance + tracks.covariance[:, :, row]
        size, _ = tests.unknown.common(spread)
        near = linalg.quadratic(spread, tracks.mean[:, row] - was.mean) <= tests.keep[size]
        row, link = row[near], link[near]
        set_links(tracks, row, link, step)
        tracks.seen[row], tracks.judged[row] = time, tracks.updated[row]
        return [was.take(near)] if near.any() else []

    def _now(self, was: Picture, motion: Any, intake: Intake, time: int) -> Picture:
        """Remembered tracks at `time`, ns, of any course by now."""
        config = intake.config
        dt = np.maximum(time - was.time, 0) / 1e9
        speed = _speed(was.mean, config.space, config.unknown_speed)
        age = np.maximum(was.time - was.seen, 0) / 1e9
        out = predict_tracks(was, motion, config.space, config.space, dt, intake.frame, config.unknown_speed, age)
        covariance = out.covariance.copy()
        for place, rate in VELOCITY.items():
            if place in config.space:
                k = config.space.index(place)
                covariance[k, k] += (speed * dt) ** 2
            if rate in config.space:
                k = config.space.index(rate)
                covariance[k, k] += speed**2
        return altered(out, covariance=covariance, time=np.full(len(dt), time))

    def _forget(self, intake: Intake, time: int, journal: Journal) -> None:
        """End what was seen too long ago, and what no source of this run can bring back."""
        for name, keys in list(self.keys.items()):
            source = intake.sources.get(name) or intake.resting.get(name)
            if source is None or source.epoch != keys.epoch or not len(keys.id):
                del self.keys[name]
        ids = self.picture.id
        over = time - self.picture.seen > intake.config.remember * 1e9
        over |= ~among(ids, np.concatenate([ids[:0], *(keys.link for keys in self.keys.values())]))
        self._end(ids[over], "lost", journal)

    def _end(self, ids: _Ids, reason: str, journal: Journal) -> None:
        for track in ids.tolist():
            journal.end(track, reason, None)
        self.drop(ids)

    def drop(self, ids: _Ids) -> int:
        """Do not wait for these; how many there were."""
        gone = among(self.picture.id, np.sort(ids))
        if not gone.any():
            return 0
        self.picture = self.picture.take(~gone)
        for name, keys in list(self.keys.items()):
            self.keys[name] = keys.take(among(keys.link, self.picture.id))
        return int(gone.sum())

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns."""
        self.picture = rebased(self.picture, GLOBAL_TIMES, time)

    def packed(self) -> dict[str, Any]:
        """As plain values."""
        columns = {name: to_bytes(column) for name, column in zip(_NAMES, columns_of(self.picture), strict=True)}
        keys = {name: [one.epoch, to_bytes(one.id), to_bytes(one.link)] for name, one in sorted(self.keys.items())}
        return {"frame": self.frame, "n": len(self.picture.mean), "columns": columns, "keys": keys}

    @classmethod
    def unpacked(cls, packed: Mapping[str, Any], n: int) -> Suspended:
        """From what `packed` gave; of another space only the ids, which end in the next step."""
        like = empty_picture(packed["n"])
        flat = {name: from_bytes(packed["columns"][name], getattr(like, name)) for name in _NAMES}
        count = len(flat["id"])
        if packed["n"] != n:
            return cls(newborn(flat["id"], n, 0), {}, "another")
        columns = (flat[name].reshape(*getattr(like, name).shape[:-1], count) for name in _NAMES)
        keys = {
            str(name): Keys(int(epoch), from_bytes(id, like.id), from_bytes(link, like.id))
            for name, (epoch, id, link) in packed["keys"].items()
        }
        return cls(Picture(*columns), keys, str(packed["frame"]))


_NAMES = names_of(Picture)


def _unheard(source: Source, time: NDArray[np.int64], interval: NDArray[np.int64]) -> Bools:
    """Whether a source has said nothing since the reports at `time` (K,), ns, of tracks of these intervals, but for as
    long as their next ones could take."""
    return np.asarray(time + interval + interval // 2 >= source.last)


def _speed(mean: Floats, space: tuple[str, ...], usual: float) -> Floats:
    """m/s (K,) of states (n, K); `usual` where they have no velocity."""
    rates = [space.index(rate) for rate in VELOCITY.values() if rate in space]
    return np.sqrt((mean[rates] ** 2).sum(axis=0)) if rates else np.full(mean.shape[1], usual)
