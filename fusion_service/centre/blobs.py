"""Rows that stand for two objects for a while: a lidar that sees two boats side by side as one.

A source that had a row in each of two global tracks at a time, and now has one in the first only, has perhaps lost
the second, or its one row now stands for both (not if it has both rows still, in other tracks). The latter is believed
where that row still covers the second track: d2 in the plane within the gate, shapes and reference points allowed for.
For as long as it does (`HOLD` at most, or while another source has a row in each of the two: that one tells them
apart), the row supports both tracks:

* the second is not counted as missed by that source, nor as dropped: where nobody else follows it, it coasts;
* where the source says that its rows may be blobs (`reference`), it is supported as long as they cover it;
* the two are not merged;
* the row may be off the first track's object by as much as it is off the second's, which is added to its covariance as
  an error that is the same from report to report, where the source has not allowed for it itself.

A track that a source never followed is not missed by it either, where a row of it covers the track and another source
tells the two apart.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fusion_service import linalg
from fusion_service.arrays import Bools, Ints, filled, from_bytes, marked, same_ids, to_bytes
from fusion_service.centre.extents import BLOB, shaped, widened
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.rows import Rows
from fusion_service.centre.tracks import EXTENT_ROWS
from fusion_service.config import CentreConfig
from fusion_service.metrics import chi2_quantile
from schemas import Ecef, Frame

__all__ = ["Blobs", "Shared"]

HOLD = 60.0
"""Seconds for which a source that has seen two objects is believed that there are two."""
NEIGHBOURS = 4
"""Tracks near one that is missed whose rows may cover it, the nearest."""
MOST = 200_000
"""Links remembered."""
CHAIN = 3
"""Rows in turn that take each other's places at most."""
TRIFLE = 1e-12
"""By which what a row may be off is larger: its own error may be less than what is lost in rounding."""

Ids = NDArray[np.uint64]


class Shared:
    """The rows of one step, and which of them stand for a second track besides their own.

    row (K,), track (K,): a row, and the place in the picture of its second track.
    """

    def __init__(self, rows: Rows, now: Picture, config: CentreConfig, frame: Frame | None) -> None:
        self._rows, self._now, self._frame = rows, now, frame
        self._space = config.space
        level = ("x", "y", "z") if isinstance(frame, Ecef) else ("x", "y")
        self._places = [config.space.index(axis) for axis in level]
        self._gate = chi2_quantile(config.gate, len(level))
        self._width = max(len(now.id), 1)
        self.row = self.track = np.zeros(0, dtype=np.intp)

    @cached_property
    def at(self) -> Ints:
        """(M,): the place in the picture of each row's own track, -1 without one."""
        at, linked = np.full(len(self._rows.source), -1, dtype=np.intp), self._rows.linked()
        at[linked] = self._now.find(self._rows.tracks.link[linked])
        return at

    @cached_property
    def _held(self) -> tuple[Ints, Ints]:
        """(source, track) of every linked row as one number, sorted, and the row."""
        linked = self._rows.linked()
        keys = self._rows.source[linked] * self._width + self.at[linked]
        order = np.argsort(keys, kind="stable")
        return keys[order], linked[order]

    def holds(self, source: Ints, track: Ints) -> tuple[Bools, Ints]:
        """Of K pairs of a source and a track: whether it has a row in it, and which."""
        keys, row = self._held
        if not len(keys):
            return np.zeros(len(source), dtype=np.bool_), np.zeros(len(source), dtype=np.intp)
        wanted = source * self._width + track
        found = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        return keys[found] == wanted, row[found]

    def covered(self, source: Ints, track: Ints) -> tuple[Ints, Ints]:
        """Of K pairs of a source and a track that it has no row in: which of them a row of it covers, and that row: of
        several that of the nearest track."""
        beside = self._neighbours[track]
        pair, column = np.nonzero(beside >= 0)
        there, row = self.holds(source[pair], beside[pair, column])
        pair, row = pair[there], row[there]
        good = self._rows.inside_mask()[row] & self._covers(row, track[pair])
        which, first = np.unique(pair[good], return_index=True)
        return which, row[good][first]

    def told_apart(self, row: Ints, track: Ints) -> Bools:
        """Of K pairs of a row and a track that is not its own: another source has a row in each of the two."""
        keys = self._held[0]
        masks = np.zeros((int(self._rows.source.max(initial=0)) + 1, self._width), dtype=np.bool_)
        masks[keys // self._width, keys % self._width] = True
        both = masks[:, self.at[row]] & masks[:, track]
        both[self._rows.source[row], np.arange(len(row))] = False
        return np.asarray(both.any(axis=0))

    def still_missed(self, source: int, missed: Bools) -> Bools:
        """`missed` (G,), the tracks that a source has not seen, without those that a row of it stands for."""
        if not missed.any() or len(self._now.id) < 2:
            return missed
        missed = missed.copy()
        missed[self.track[self._rows.source[self.row] == source]] = False
        track = marked(missed)
        which, row = self.covered(np.full(len(track), source), track)
        missed[track[which[self.told_apart(row, track[which])]]] = False
        return missed

    def support(self, due: NDArray[np.int64], expected: NDArray[np.int64], dropped: Bools) -> Bools:
        """Raise `due` (G,), when the next report of each track is overdue, to when that of the rows is `expected` (M,)
        whose source says that they may be blobs; which tracks are `dropped` (G,) then."""
        if not len(self.row):
            return dropped
        code = self._rows.tracks.extent[7, self.row] if len(self._rows.tracks.extent) else np.zeros(len(self.row))
        some = code == BLOB
        np.maximum.at(due, self.track[some], expected[self.row[some]])
        dropped = dropped.copy()
        dropped[self.track] = False
        return dropped

    def pairs(self) -> Ids:
        """Ids (K, 2) of the two tracks of each such row, the lower first."""
        ids = np.stack([self._now.id[self.at[self.row]], self._now.id[self.track]], axis=1)
        return np.sort(ids, axis=1)

    def widened(self) -> Rows:
        """The rows; those that stand for two, and do not say how far they may be off, as vague as these are apart."""
        rows, column = self._rows, self._rows.tracks.extent
        if not len(self.row) or isinstance(self._frame, Ecef):
            return rows
        if not len(column):
            column = np.full((EXTENT_ROWS, len(rows.source)), np.nan)
        some = np.isnan(column[8, self.row])
        row, track = self.row[some], self.track[some]
        x, y = self._now.mean[self._places][:, track] - rows.tracks.mean[self._places][:, row]
        more = np.zeros((3, len(rows.source)))
        for part, product in zip(more, (x * x, x * y, y * y), strict=True):
            np.add.at(part, row, product)
        more[[0, 2]] *= 1.0 + TRIFLE
        column = column.copy()
        column[8:11, row] = more[:, row]
        tracks = widened(replace(rows.tracks, extent=column), more, self._space, self._frame)
        return replace(rows, tracks=tracks)

    @cached_property
    def _neighbours(self) -> Ints:
        """(G, `NEIGHBOURS`): places of the nearest other tracks, the nearest first, -1 where there are no more."""
        near = np.full((len(self._now.id), NEIGHBOURS + 1), -1, dtype=np.intp)
        known = marked(self._now.time >= 0)
        if len(known):
            point = np.nan_to_num(self._now.mean[self._places][:, known].T)
            _, index = cKDTree(point).query(point, k=NEIGHBOURS + 1)
            index = np.where(index == np.arange(len(known))[:, None], len(known), index)
            near[known] = np.append(known, -1)[index]
        return near

    @cached_property
    def _shapes(self) -> tuple[Rows, Picture]:
        return shaped(self._rows, self._now, self._space, self._frame)

    def _covers(self, row: Ints, track: Ints) -> Bools:
        """Whether the rows cover the tracks (K,) in the plane, as wide as both are."""
        rows, now = self._shapes
        square = np.ix_(self._places, self._places)
        spread = rows.tracks.covariance[square][:, :, row] + now.covariance[square][:, :, track]
        offset = rows.tracks.mean[self._places][:, row] - now.mean[self._places][:, track]
        return np.asarray(linalg.quadratic(spread, offset) <= self._gate)


class _Links(NamedTuple):
    """K links of a source (its place in the sorted names) to a track, by the row with the id `local` (once it is lost:
    the row that went, which is another one if that took this one's place), and when each began and was last there, ns.
    """

    source: Ints
    track: Ids
    local: Ids
    since: NDArray[np.int64]
    time: NDArray[np.int64]

    def take(self, some: Any) -> _Links:
        return _Links(*(column[some] for column in self))


WHOLE = np.zeros(0, dtype=np.int64)
NO_LINKS = _Links(np.zeros(0, dtype=np.intp), *2 * (np.zeros(0, dtype=np.uint64),), WHOLE, WHOLE)


class Blobs:
    """What every source followed in the last step, and what it has lost since and may have merged."""

    def __init__(self, config: CentreConfig) -> None:
        self._config = config
        self._names: tuple[str, ...] = ()
        self._followed = self._lost = NO_LINKS
        self.unmerged: Ids = np.zeros((0, 2), dtype=np.uint64)
        """Ids (K, 2) of tracks that were told apart and that one row stands for now."""

    def follow(self, rows: Rows, names: tuple[str, ...], now: Picture, time: int, frame: Frame | None) -> Shared:
        """What rows stand for in the step at `time`, ns, when links are decided. now: the picture predicted to it."""
        shared = Shared(rows, now, self._config, frame)
        linked, was, lost = rows.linked(), self._followed, self._lost
        source, track, local = rows.source[linked], rows.tracks.link[linked], rows.tracks.id[linked]
        times = filled(len(linked), time, np.int64)
        same = self._names == names and same_ids(was.track, track) and same_ids(was.source, source)
        if same:
            links = _Links(source, track, local, was.since, times)
        else:
            lost = _renamed(lost, _vanished(was, self._names, names, source, track, local), self._names, names)
            links = _Links(source, track, local, _begun(source, track, lost, times), times)
        self._names, self._followed, self._lost, self.unmerged = names, links, NO_LINKS, self.unmerged[:0]
        if len(lost.track) and len(now.id) > 1:
            self._share(shared, lost, now, time)
        return shared

    def _share(self, shared: Shared, lost: _Links, now: Picture, time: int) -> None:
        """Find the rows that stand for what was lost, and keep of that what may be found yet."""
        at = np.minimum(now.find(lost.track), len(now.id) - 1)
        there = (now.id[at] == lost.track) & (lost.source >= 0) & (now.time[at] >= 0)
        there[there] = ~shared.holds(lost.source[there], at[there])[0]
        lost, at = lost.take(there), at[there]
        if not len(at):
            return
        which, row = shared.covered(lost.source, at)
        begun = np.empty(len(shared.at), dtype=np.int64)
        begun[shared.at >= 0] = self._followed.since
        both = (begun[row] <= lost.time[which]) & ~self._alive(lost.take(which))
        which, row = which[both], row[both]
        young = time - lost.time <= round(HOLD * 1e9)
        apart = np.zeros(len(at), dtype=np.bool_)
        apart[which] = shared.told_apart(row, at[which])
        good = (young | apart)[which]
        shared.row, shared.track = row[good], at[which[good]]
        self.unmerged = shared.pairs()
        kept = marked(young | apart)
        self._lost = lost.take(kept[np.argsort(-lost.time[kept], kind="stable")][:MOST])

    def _alive(self, lost: _Links) -> Bools:
        """Whether the source of these links (K,) has the row still that went when they were lost."""
        return _found(lost.source, lost.local, self._followed.source, self._followed.local)[0]

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns: nothing is later."""
        self._followed, self._lost = (
            links._replace(since=np.minimum(links.since, time), time=np.minimum(links.time, time))
            for links in (self._followed, self._lost)
        )

    def packed(self) -> list[Any]:
        """As plain values."""
        links = [
            [to_bytes(column) for column in one._replace(source=one.source.astype(np.int64))] for one in self._both()
        ]
        return [list(self._names), *links, to_bytes(self.unmerged)]

    def _both(self) -> tuple[_Links, _Links]:
        return self._followed, self._lost

    def restore(self, packed: list[Any]) -> None:
        """Go on with what `packed` gave."""
        names, *links, pairs = packed
        kinds = NO_LINKS._replace(source=WHOLE)
        if any(len(one) != len(kinds) for one in links):  # of 0.5.0: which objects share a row is learned anew
            return
        self._names = tuple(names)
        self._followed, self._lost = (
            _Links(*(from_bytes(column, kind) for column, kind in zip(one, kinds, strict=True))) for one in links
        )
        self.unmerged = from_bytes(pairs, NO_LINKS.track).reshape(-1, 2)


def _renamed(lost: _Links, was: _Links, before: tuple[str, ...], names: tuple[str, ...]) -> _Links:
    """All that was lost or followed, by the places of its sources among the names of now; -1: gone."""
    place = {name: number for number, name in enumerate(names)}
    here = np.array([*(place.get(name, -1) for name in before), -1], dtype=np.intp)
    both = _Links(*(np.concatenate(pair) for pair in zip(lost, was, strict=True)))
    return both._replace(source=here[both.source])


def _vanished(
    was: _Links, before: tuple[str, ...], names: tuple[str, ...], source: Ints, track: Ids, local: Ids
) -> _Links:
    """What was followed, by the rows that went: where a row goes on in a track that another one had, that other one.
    source, track, local (L,): the links of now."""
    place = {name: number for number, name in enumerate(names)}
    mine = np.array([*(place.get(name, -1) for name in before), -1], dtype=np.intp)[was.source]
    went = was.local
    for _ in range(CHAIN):
        goes_on, at = _found(mine, went, source, local)
        had, whose = _found(mine[goes_on], track[at[goes_on]], mine, was.track)
        some = marked(goes_on)[had]
        went = went.copy()
        went[some] = was.local[whose[had]]
    return was._replace(local=went)


def _found(source: Ints, key: Ids, sources: Ints, keys: Ids) -> tuple[Bools, Ints]:
    """Which of the pairs (source, key) (K,) are among (sources, keys) (L,), and where."""
    if not len(keys):
        return np.zeros(len(key), dtype=np.bool_), np.zeros(len(key), dtype=np.intp)
    ids, number = np.unique(np.concatenate([keys, key]), return_inverse=True)
    had = (sources + 1) * len(ids) + number[: len(keys)]
    order = np.argsort(had, kind="stable")
    wanted = (source + 1) * len(ids) + number[len(keys) :]
    at = order[np.minimum(np.searchsorted(had[order], wanted), len(had) - 1)]
    return had[at] == wanted, at


def _begun(source: Ints, track: Ids, known: _Links, times: NDArray[np.int64]) -> NDArray[np.int64]:
    """When each of these links began: as far back as it is known, else now."""
    known = known.take(np.lexsort((known.since, known.track, known.source)))
    there, at = _found(source, track, known.source, known.track)
    return np.where(there, known.since[at], times) if len(known.since) else times
