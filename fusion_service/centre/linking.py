"""Which local track belongs to which global track: judge, exchange, join, begin and merge, on evidence.

A standing link is a prior, not a lock. In every step the rows with new data are judged against the prediction and the
other sources (`gating`); then, source by source, the rows that have lost their place, are new, or have a rival link
that has gathered evidence are given to the global tracks by the optimal assignment within each connected cluster, at
most one of a source to a track; what is left begins tracks of its own, or is held as the shadow of a track that its
source already follows; and global tracks that no source tells apart are merged when the evidence says that they are
one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fusion_service import linalg
from fusion_service.arrays import Bools, Floats, Ints, among, marked
from fusion_service.centre.births import group, locals_of
from fusion_service.centre.candidates import Candidates, find_candidates
from fusion_service.centre.copies import Copies
from fusion_service.centre.emptied import emptied
from fusion_service.centre.evidence import LOW, PairEvidence, RivalLinks, Tests
from fusion_service.centre.gating import Judgement, Settings, judge
from fusion_service.centre.ids import Ids
from fusion_service.centre.journal import Journal
from fusion_service.centre.lifecycle import Picture, newborn
from fusion_service.centre.meeting import Meeting
from fusion_service.centre.neighbours import Neighbours
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.tracks import set_links
from fusion_service.centre.whereabouts import founders
from fusion_service.config import CentreConfig
from fusion_service.metrics import assign_near
from fusion_service.records import altered
from schemas import Entry, messages

__all__ = ["Linker"]

MOST_BYTES = 12_000_000
"""Global tracks are not started beyond what one message can carry with room to spare."""
STANDING = 1000.0
"""What a row that is believed in its track is worth there: nothing but an exchange can take it away."""
MOST_RIVAL = 50.0
MEMORY = 0.75
"""Of the sum of a rival, kept at each new datum: a filter's newest state holds most of what its earlier ones said."""


class Linker:
    """The decisions about links, and the evidence gathered over steps: `merges` and `rivals`. beside: who was near whom
    in an earlier step, from which nothing follows but how long it takes to find who is now."""

    def __init__(self, config: CentreConfig, ids: Ids, beside: Neighbours | None = None) -> None:
        self.config = config
        self.tests = Tests.of(config)
        self.merges = PairEvidence()
        self.rivals = RivalLinks()
        self.copies = Copies(config)
        self.beside = beside or Neighbours()
        self._ids = ids
        self._settings = Settings(self.tests, config.space, config.manoeuvre)
        n = len(config.space)
        self._most = MOST_BYTES // (8 * (n + n * (n + 1) // 2) + 200)
        self._places = [config.space.index(axis) for axis in ("x", "y", "z") if axis in config.space]

    def link(
        self, rows: Rows, picture: Picture, now: Picture, meeting: Meeting, step: int, time: int, journal: Journal
    ) -> tuple[Picture, dict[int, int]]:
        """Decide all links of the step, writing the rows' columns. now: the picture predicted to `time`, ns; meeting:
        who may meet whom in it.

        Returns the picture with its new tracks, and the merges: {id that ends: older id that goes on}.
        """
        meeting.settle(step, journal)
        judged = judge(rows, now, meeting.forced_row, time, self._settings, journal)
        near = find_candidates(rows, now, meeting, judged, self.tests, self._places, self.beside)
        near = _without_broken(near, rows, now, judged)
        before, believed = rows.tracks.link.copy(), rows.inside_mask()
        joined = self._assign(rows, now, _vacant(near, meeting), step, journal)
        merged = self._merge(rows, now, near, emptied(rows, before, believed, now, near.tracks), step, journal)
        if not merged:
            merged = self.copies.joined(rows, now, near, meeting, step, time, journal)
        if not len(near.loose) and not self.copies.held:
            rows.tracks.seen[joined], rows.tracks.judged[joined] = time, rows.tracks.updated[joined]
            return picture, merged
        free = near.loose[rows.tracks.link[near.loose] == NO_TRACK]
        free = free[~self.copies.hold(rows, now, near, meeting, free, time, journal)]
        starting = self._shadow(rows, now, near, meeting, free)
        picture = self._begin(rows, picture, near, free, starting, step, time, journal)
        newly = np.concatenate([joined, free[rows.tracks.link[free] != NO_TRACK]])
        rows.tracks.seen[newly], rows.tracks.judged[newly] = time, rows.tracks.updated[newly]
        waiting = rows.tracks.link[near.loose] == NO_TRACK
        rows.tracks.judged[near.loose[waiting]] = rows.tracks.updated[near.loose[waiting]]
        return picture, merged

    def _assign(self, rows: Rows, now: Picture, near: Candidates, step: int, journal: Journal) -> Ints:
        """Exchange links and let loose rows join, source by source; a track that takes part in an exchange of
        one source is left alone by the others until the next step. Returns the rows that joined a track."""
        if not (len(near.joins.first) or len(near.rivals.first) or self.rivals.by_source):
            return np.zeros(0, dtype=np.intp)
        sums = self._rival_sums(rows, now, near)
        touched = np.zeros(len(now.id), dtype=np.bool_)
        joined: list[Ints] = [np.zeros(0, dtype=np.intp)]
        active = near.joins.first, near.rivals.first[sums > self.tests.weight(rows.tracks.data[near.rivals.first])]
        for name in np.unique(rows.source[np.concatenate(active)]).tolist():
            row, track, value, stays = self._options(rows, now, near, sums, name, touched)
            if not len(row):
                continue
            order = np.lexsort((track, row))
            row, track, value, stays = row[order], track[order], value[order], stays[order]
            kept = assign_near(row, track, value, (len(rows.source), len(now.id)))
            mine = np.unique(row)
            given = np.full(len(rows.source), -1, dtype=np.intp)
            given[row[kept]] = track[kept]
            taken = kept[~stays[kept]]
            lost = mine[(given[mine] < 0) & (rows.tracks.link[mine] != NO_TRACK)]
            exchanged = rows.tracks.link[row[taken]] != NO_TRACK
            touched[track[taken[exchanged]]] = True
            touched[now.find(rows.tracks.link[row[taken[exchanged]]])] = True
            self._apply(rows, now, near, row[taken], track[taken], lost, step, journal)
            joined.append(row[taken])
        whole = np.concatenate(joined)
        self._keep_rivals(rows, now, near, sums, whole)
        return whole

    def _rival_sums(self, rows: Rows, now: Picture, near: Candidates) -> Floats:
        """The sum of every rival pair, this datum's share in it."""
        rivals = near.rivals
        if not len(rivals.first):
            return np.zeros(0)
        more = 0.5 * (near.own[rivals.first] - (rivals.distance + rivals.spread))
        more = np.where(np.isfinite(more), more, 0.0)
        before = self.rivals.sums(rows, now, rivals.first, rivals.second)
        return np.clip(MEMORY * before + more, -LOW, MOST_RIVAL)

    def _options(
        self, rows: Rows, now: Picture, near: Candidates, sums: Floats, name: int, touched: Bools
    ) -> tuple[Ints, Ints, Floats, Bools]:
        """Of one source: the possible pairs (row, track), what each is worth, and which of them are as they stand.
        Only clusters in which something can change."""
        tracks = rows.tracks
        some = rows.source[near.joins.first] == name
        joins = near.joins.take(some)
        top = joins.spread.max(initial=-np.inf)
        worth = 1.0 + 0.5 * (joins.gate - joins.distance) + 0.5 * (top - joins.spread)
        mine = rows.source[near.rivals.first] == name
        rivals, sums = near.rivals.take(mine), sums[mine]
        believed = np.unique(rivals.first)
        loose = np.unique(joins.first)
        holders = _holders(rows, now, np.concatenate([joins.second, rivals.second]), name)
        standing = np.unique(np.concatenate([believed, loose[tracks.link[loose] != NO_TRACK], holders]))
        at = now.find(tracks.link[standing])
        stay = np.where(tracks.outside[standing], 0.5, STANDING + self.tests.weight(tracks.data[standing]))
        row = np.concatenate([joins.first, rivals.first, standing])
        track = np.concatenate([joins.second, rivals.second, at])
        value = np.concatenate([worth, STANDING + sums, stay])
        stays = np.arange(len(row)) >= len(row) - len(standing)
        free = ~touched[track] | stays
        held = among(row, standing[touched[at]])
        free &= ~held & (value > 0)
        own = tracks.link[row] == now.id[track]
        free &= stays | ~own
        row, track, value, stays = row[free], track[free], value[free], stays[free]
        reason = np.concatenate([loose, rivals.first[sums > self.tests.weight(tracks.data[rivals.first])]])
        inside = _in_clusters(row, track, reason, len(rows.source), len(now.id))
        return row[inside], track[inside], value[inside], stays[inside]

    def _apply(
        self, rows: Rows, now: Picture, near: Candidates, row: Ints, track: Ints, lost: Ints, step: int,
        journal: Journal,
    ) -> None:  # fmt: skip
        tracks = rows.tracks
        if len(lost):
            journal.broke(rows, lost, tracks.link[lost], np.full(len(lost), np.nan))
            set_links(tracks, lost, NO_TRACK, step)
        if not len(row):
            return
        before, after = tracks.link[row], now.id[track]
        distance = _distance_of(near, row, track)
        changed = before != NO_TRACK
        journal.decide(messages.EXCHANGED, rows, row[changed], after[changed], distance[changed], before[changed])
        journal.decide(messages.LINKED, rows, row[~changed], after[~changed], distance[~changed])
        set_links(tracks, row, after, step)

    def _keep_rivals(self, rows: Rows, now: Picture, near: Candidates, sums: Floats, moved: Ints) -> None:
        """The sums for the next step; those of a row that has moved are from now on beside its new link."""
        rivals = near.rivals
        row, track, value = rivals.first, rivals.second, sums
        if len(moved) and len(row):
            link = rows.tracks.link[row]
            chosen = now.id[track] == link
            gained = np.zeros(len(rows.source))
            gained[row[chosen]] = value[chosen]
            value = np.clip(np.where(among(row, moved), value - gained[row], value), -LOW, MOST_RIVAL)
            row, track, value = row[~chosen], track[~chosen], value[~chosen]
        # rows without a new datum keep what they had
        old_row, old_track, old = self.rivals.known(rows, now)
        quiet = ~rows.fresh[old_row] & (rows.tracks.link[old_row] != NO_TRACK)
        row = np.concatenate([row, old_row[quiet]])
        track = np.concatenate([track, old_track[quiet]])
        value = np.concatenate([value, old[quiet]])
        order = np.lexsort((track, row))
        self.rivals.keep(rows, now, row[order], track[order], value[order])

    def _shadow(self, rows: Rows, now: Picture, near: Candidates, meeting: Meeting, free: Ints) -> Bools:
        """Hold loose rows whose source already follows the track that they are near; (F,) which may begin one."""
        tracks, tests = rows.tracks, self.tests
        if not len(free):
            return np.zeros(0, dtype=np.bool_)
        joins = near.joins.take(among(near.joins.first, free))
        holds = _held(rows, now, joins.first, joins.second)
        joins = joins.take(holds)
        order = np.lexsort((joins.distance + joins.spread, joins.first))
        first = np.append(True, np.diff(joins.first[order]) != 0) if len(order) else np.zeros(0, dtype=np.bool_)
        best = joins.take(order[first])
        nearest = np.full(len(rows.source), -1, dtype=np.intp)
        nearest[best.first] = best.second
        at = now.find(tracks.shadow[free]) if len(now.id) else np.zeros(len(free), dtype=np.intp)
        at = np.minimum(at, max(len(now.id) - 1, 0))
        old = (tracks.shadow[free] != NO_TRACK) & (len(now.id) > 0)
        if old.any():
            old &= now.id[at] == tracks.shadow[free]
            old &= _held(rows, now, free, at) & ~meeting.with_tracks(free, at).forbidden
            spread = tracks.covariance[:, :, free] + near.covariance[:, :, at]
            distance = linalg.quadratic(spread, tracks.mean[:, free] - near.mean[:, at])
            size, _ = tests.unknown.common(spread)
            more = np.where(old, -np.nan_to_num(tests.sameness(distance, size), nan=-tests.bound / 2), 0.0)
            tracks.apart[free] = np.clip(tracks.apart[free] + more, -tests.bound, tests.bound)
        new = ~old & (nearest[free] >= 0)
        tracks.shadow[free[~old]] = NO_TRACK
        tracks.apart[free[~old]] = 0.0
        if new.any():
            tracks.shadow[free[new]] = now.id[nearest[free[new]]]
        return np.asarray((tracks.shadow[free] == NO_TRACK) | (tracks.apart[free] >= tests.bound - 1e-9))

    def _begin(
        self, rows: Rows, picture: Picture, near: Candidates, free: Ints, starting: Bools,
        step: int, time: int, journal: Journal,
    ) -> Picture:  # fmt: skip
        """New tracks for the groups of free rows in which one may start and is nobody's shadow, or two sources agree
        that there is one more."""
        tracks = rows.tracks
        if not len(free):
            return picture
        groups = group(free, rows.source, near.births)
        count = int(groups.max(initial=-1)) + 1
        size = np.bincount(groups, minlength=count)
        may = np.bincount(groups, rows.may_start[free], minlength=count) > 0
        may &= (np.bincount(groups, starting & rows.may_start[free], minlength=count) > 0) | (size > 1)
        chosen = marked(may)
        room = max(0, self._most - len(picture.id))
        if len(chosen) > room:
            journal.refuse(Entry("", 0, 0, 0, "too-many-tracks", len(chosen) - room))
            chosen = chosen[:room]
        new = self._ids.allot(
            len(chosen),
            lambda: locals_of(rows, journal.sources, free, groups, chosen),
            lambda: founders(rows, free, groups, chosen, self.tests.unknown),
        )
        given = np.zeros(count, dtype=np.uint64)
        given[chosen] = new
        takes = given[groups] != NO_TRACK
        set_links(tracks, free[takes], given[groups[takes]], step)
        journal.decide(messages.LINKED, rows, free[takes], given[groups[takes]], np.full(int(takes.sum()), np.nan))
        journal.birth(new)
        born = set(new.tolist())
        for row, old in journal.broken.items():
            link = int(tracks.link[row])
            if link in born:
                journal.split(link, old)
                self.merges.part(min(old, link), max(old, link), self.tests.bound)
        return picture.join(newborn(new, len(self.config.space), time))

    def _merge(
        self, rows: Rows, now: Picture, near: Candidates, left: list[tuple[int, int]], step: int, journal: Journal
    ) -> dict[int, int]:
        """Join global tracks that share no source and that the evidence says are one: {newer id: older id}. left: pairs
        of which one was emptied into the other, which are one unless the evidence says that they are two."""
        pairs = near.tracks
        if not (left or len(pairs.first) or len(self.merges.sums.older)):
            return {}
        if len(pairs.first):
            masks = _masks(rows, now)
            pairs = pairs.take((masks[pairs.first] & masks[pairs.second]) == 0)
        same = self.tests.sameness(pairs.distance, pairs.size)
        self.merges.add(pairs.first, pairs.second, same, now, self.tests.bound)
        ripe = self.merges.ripe(self.tests.bound) + self.merges.open(left)
        far: dict[tuple[int, int], float] = {}
        if ripe:
            ids = zip(now.id[pairs.first].tolist(), now.id[pairs.second].tolist(), strict=True)
            far = dict(zip(ids, pairs.distance.tolist(), strict=True))
        merged: dict[int, int] = {}
        taken: set[int] = set()
        for old, new in ripe:
            if not taken & {old, new}:
                taken |= {old, new}
                merged[new] = old
                journal.merge(old, new, far[old, new])
                moved = marked(rows.tracks.link == np.uint64(new))
                outside = rows.tracks.outside[moved]
                set_links(rows.tracks, moved, np.uint64(old), step)
                rows.tracks.outside[moved] = outside
        self.merges.forget(taken)
        return merged

    def packed(self) -> dict[str, Any]:
        """The evidence as plain values."""
        packed = {"merges": self.merges.packed(), "rivals": self.rivals.packed()}
        return packed | {"copies": self.copies.packed()}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on with what `packed` gave."""
        self.merges, self.rivals = PairEvidence.unpacked(state["merges"]), RivalLinks.unpacked(state["rivals"])
        self.copies.restore(state.get("copies", {}))


def _vacant(near: Candidates, meeting: Meeting) -> Candidates:
    """Without the pairs whose place another row has by order."""
    if not len(meeting.forced_row):
        return near
    joins, rivals = (pairs.take(~meeting.taken(pairs.first, pairs.second)) for pairs in (near.joins, near.rivals))
    return altered(near, joins=joins, rivals=rivals)


def _without_broken(near: Candidates, rows: Rows, now: Picture, judged: Judgement) -> Candidates:
    """A row does not join again what it was just broken from."""
    if not len(judged.broken) or not len(near.joins.first):
        return near
    was = np.zeros(len(rows.source), dtype=np.uint64)
    was[judged.broken] = judged.was
    joins = near.joins.take(was[near.joins.first] != now.id[near.joins.second])
    return altered(near, joins=joins)


def _held(rows: Rows, now: Picture, row: Ints, track: Ints) -> Bools:
    """Which of the pairs (row, track): the row's source has another, believed row in the track."""
    if not len(row):
        return np.zeros(0, dtype=np.bool_)
    inside = rows.inside()
    width = max(len(now.id), 1)
    keys = np.unique(rows.source[inside] * width + now.find(rows.tracks.link[inside]))
    return among(rows.source[row] * width + track, keys)


def _holders(rows: Rows, now: Picture, wanted: Ints, name: int) -> Ints:
    """The rows of the source that stand in a track that another row of it may join or exchange its own for."""
    ids = np.unique(now.id[wanted])
    mine = marked((rows.source == name) & (rows.tracks.link != NO_TRACK))
    return mine[among(rows.tracks.link[mine], ids)]


def _in_clusters(row: Ints, track: Ints, reason: Ints, rows: int, tracks: int) -> Bools:
    """Which pairs lie in a connected cluster that holds one of the rows `reason`."""
    if not len(row):
        return np.zeros(0, dtype=np.bool_)
    graph = coo_array((np.ones(len(row), dtype=np.int8), (row, rows + track)), (rows + tracks, rows + tracks))
    part = connected_components(graph, directed=False)[1]
    return among(part[row], part[reason])


def _distance_of(near: Candidates, row: Ints, track: Ints) -> Floats:
    """d2 (K,) of pairs among the joins and the rivals."""
    first = np.concatenate([near.joins.first, near.rivals.first])
    second = np.concatenate([near.joins.second, near.rivals.second])
    distance = np.concatenate([near.joins.distance, near.rivals.distance])
    width = int(second.max(initial=0)) + 1
    keys = first * width + second
    order = np.argsort(keys, kind="stable")
    at = np.minimum(np.searchsorted(keys[order], row * width + track), len(keys) - 1)
    return distance[order[at]]


def _masks(rows: Rows, now: Picture) -> NDArray[Any]:
    """The sources in every global track as bits: int64 while they fit, Python integers beyond."""
    linked = rows.linked()
    source, at = rows.source[linked], now.find(rows.tracks.link[linked])
    there = (
        (at < len(now.id)) & (now.id[np.minimum(at, max(len(now.id) - 1, 0))] == rows.tracks.link[linked])
        if len(now.id)
        else np.zeros(len(linked), dtype=np.bool_)
    )
    source, at = source[there], at[there]
    wide = bool(source.max(initial=0) >= 62)
    masks = np.zeros(len(now.id), dtype=object if wide else np.int64)
    bits = np.array([1 << int(one) for one in source.tolist()], dtype=object) if wide else np.left_shift(1, source)
    np.bitwise_or.at(masks, at, bits)
    return masks
