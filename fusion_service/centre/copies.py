"""`Copies`: local tracks that say they are what a global track is already, and trail or miss it by what a clock or a
registration error explains.

An aircraft heard directly, and again from a rebroadcast that stamps it 3 s late, has one identity and two places, each
outside the gate of the other. A second track of it would be a ghost. So a loose row whose trusted identity is that of a
global track that other sources feed now, and its own does not, begins no track of its own, if

    dx' S^-1 dx <= gate,   S = P_row + P_track + sigma_c^2 v v' + sigma_t^2 I + A(sigma_c)

dx being the difference of the states, v the velocity of the track, sigma_c and sigma_t what is configured of how far
clocks and places may be off (`clock_sigma`, `translation_sigma`: with the defaults, some 3.7 s along its course and 370
m across it), A what an unannounced manoeuvre (`manoeuvre`) makes in sigma_c seconds. It is held, not linked: what it
says is a rival place for the same object, not one more measurement of it. What came first, or has more sources, stays.
Once it fits, it joins as any other. Two global tracks that are so are made one after `FEW` new data of the younger.

What no offset explains stands in two places: a track of its own, and an alarm (`alarms.Twice`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from fusion_service.arrays import Bools, Floats, Ints, marked
from fusion_service.centre.candidates import Candidates
from fusion_service.centre.evidence import Tests
from fusion_service.centre.gating import manoeuvred
from fusion_service.centre.journal import Journal
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.meeting import Meeting
from fusion_service.centre.partial import apart
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.tracks import set_links
from fusion_service.centre.words import NONE
from fusion_service.config import CentreConfig

__all__ = ["MOST", "Copies", "Copy"]

FEW = 3
"""New data in a row that decide: beyond the gate that a copy is none any more, within it that a track is one."""
MOST = 1000
"""Copies that are held at a time, and pairs of tracks that are looked at in a step."""
TOLD = 3
"""Sentences of one source in the status."""
AXES = (("x", "vx"), ("y", "vy"), ("z", "vz"))
SLOW = 1.0
"""m/s, below which a place says nothing of a clock."""


class Copy(NamedTuple):
    """A row that is held for `track`, of `identity`: how many new data in a row did not fit; metres that it is away,
    behind (along the course of the track, ahead is negative) and the seconds that would explain that, NaN where the
    track hardly moves."""

    track: int
    identity: str
    misses: int
    away: float
    behind: float
    delay: float


class Copies:
    """The copies that are held: {(source, epoch, local id): Copy}; and of pairs of global tracks (stays, goes) how
    many new data of the second have fitted in a row, and the newest of them."""

    def __init__(self, config: CentreConfig) -> None:
        self.held: dict[tuple[str, int, int], Copy] = {}
        self.pairs: dict[tuple[int, int], tuple[int, int]] = {}
        self._config = config
        self._tests = Tests.of(config)

    def hold(
        self, rows: Rows, now: Picture, near: Candidates, meeting: Meeting, free: Ints, time: int, journal: Journal
    ) -> Bools:
        """Which of the loose rows `free` (F,) are held as copies, in the step at `time`, ns."""
        held = np.zeros(len(free), dtype=np.bool_)
        row, at, said = meeting.namesakes(free)
        if not len(row) and not self.held:
            return held
        fits = _fed_by_others(rows, now, row, at, time, self._config)
        row, at, said = row[fits], at[fits], said[fits]
        velocity, offset, distance, size = self._apart(
            near.mean[:, at], near.covariance[:, :, at], rows.tracks.mean[:, row], rows.tracks.covariance[:, :, row]
        )
        fits, keeps = distance <= self._tests.gate[size], distance <= self._tests.keep[size]
        new: dict[tuple[str, int, int], Copy] = {}
        texts = meeting.identity_texts(said)
        order = np.lexsort((at, distance, row))
        for k in order.tolist():
            key = meeting.key_of(int(row[k]))
            old, track = self.held.get(key), int(now.id[at[k]])
            standing = old is not None and old.track == track
            misses = 0 if (keeps if standing else fits)[k] else (old.misses + 1 if old is not None else FEW)
            if key in new or misses >= FEW or (not standing and len(self.held) + len(new) >= MOST):
                continue
            new[key] = Copy(track, texts[k], misses, *_told(offset[:, k], velocity[:, k]))
        kept = {meeting.key_of(int(free[n])): n for n in marked(rows.tracks.identity[free] != NONE).tolist()}
        for key in new:
            held[kept[key]] = True
        self._follow(rows, now, meeting, new, set(kept), journal)
        return held

    def _follow(
        self, rows: Rows, now: Picture, meeting: Meeting, new: dict[tuple[str, int, int], Copy],
        asked: set[tuple[str, int, int]], journal: Journal,
    ) -> None:  # fmt: skip
        """Tell what begins and what is over. asked: the rows that were free in this step; of the others those stay
        that are there, without a link, and their track is."""
        say = marked((rows.tracks.link == NO_TRACK) & (rows.tracks.identity != NONE))
        loose = {meeting.key_of(one) for one in say.tolist()} if self.held else set()
        there = set(now.id.tolist()) if self.held else set()
        quiet = {
            key: copy for key, copy in self.held.items() if key not in asked and key in loose and copy.track in there
        }
        for key, copy in sorted(self.held.items()):
            if key not in quiet and (key not in new or new[key].track != copy.track):
                journal.event({"kind": "copy_over", "source": key[0], "id": key[2], "track": copy.track})
        for key, copy in sorted(new.items()):
            if key not in self.held or self.held[key].track != copy.track:
                event = {"kind": "copy", "source": key[0], "id": key[2], "track": copy.track, "identity": copy.identity}
                event |= {"away": copy.away, "behind": copy.behind, "delay": copy.delay}
                journal.event(event | {"why": _sentence(key[2], copy)})
        self.held = dict(sorted((quiet | new).items()))

    def _apart(self, mean: Floats, covariance: Floats, x: Floats, P: Floats) -> tuple[Floats, Floats, Floats, Ints]:
        """Of pairs (K,) of a track, `mean` and `covariance`, and another state, x and P: velocity (3, K) of the track,
        offset (3, K) of the other, d2 and over how many components."""
        config, unknown = self._config, self._tests.unknown
        space, count = config.space, mean.shape[1]
        known = unknown.known(covariance)
        velocity, offset = np.zeros((3, count)), np.zeros((3, count))
        moved = np.zeros_like(mean)
        spread = covariance + P + manoeuvred(space, config.manoeuvre, np.full(count, config.clock_sigma))
        both = unknown.known(covariance + P)
        for axis, (place, speed) in enumerate(AXES):
            if place not in space:
                continue
            k = space.index(place)
            spread[k, k] += np.where(both[k], config.translation_sigma**2, 0.0)
            offset[axis] = np.where(both[k], x[k] - mean[k], 0.0)
            if speed in space:
                there = known[space.index(speed)] & both[k]
                velocity[axis] = np.where(there, mean[space.index(speed)], 0.0)
                moved[k] = config.clock_sigma * velocity[axis]
        spread += moved[:, None] * moved[None]
        distance, _, size = apart(spread, x - mean, unknown)
        return velocity, offset, np.where(np.isnan(distance), np.inf, distance), size

    def joined(
        self, rows: Rows, now: Picture, near: Candidates, meeting: Meeting, step: int, time: int, journal: Journal
    ) -> dict[int, int]:
        """Global tracks that are copies of others, {goes: stays}; their rows have no link any more."""
        first, second = meeting.namesake_tracks(MOST)
        if not len(first):
            self.pairs = {}
            return {}
        fed = _sources(rows, now, time, self._config)
        _, _, distance, size = self._apart(
            near.mean[:, first], near.covariance[:, :, first], near.mean[:, second], near.covariance[:, :, second]
        )
        fits = (distance <= self._tests.gate[size]) & (now.time[first] >= 0) & (now.time[second] >= 0)
        pairs: dict[tuple[int, int], tuple[int, int]] = {}
        gone: dict[int, int] = {}
        for k in marked(fits).tolist():
            mine, its = fed.get(int(first[k]), set()), fed.get(int(second[k]), set())
            if not mine or not its or mine & its:
                continue
            stays, goes = (second[k], first[k]) if len(its) > len(mine) else (first[k], second[k])
            key, newest = (int(now.id[stays]), int(now.id[goes])), int(now.seen[goes])
            seen, last = self.pairs.get(key, (0, -1))
            seen += newest > last
            pairs[key] = seen, newest
            if seen > FEW and not (gone.keys() | set(gone.values())) & set(key):
                gone[key[1]] = key[0]
                journal.merge(key[0], key[1], float(distance[k]))
                moved = marked(rows.tracks.link == np.uint64(key[1]))
                journal.broke(rows, moved, rows.tracks.link[moved], np.full(len(moved), np.nan))
                set_links(rows.tracks, moved, NO_TRACK, step)
        self.pairs = {key: one for key, one in pairs.items() if not gone.keys() & set(key)}
        return gone

    def sentences(self) -> dict[str, list[str]]:
        """What the status says, by source."""
        told: dict[str, list[str]] = {}
        for (source, _, number), copy in self.held.items():
            mine = told.setdefault(source, [])
            if len(mine) < TOLD:
                mine.append(_sentence(number, copy))
        return told

    def packed(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "held": [[*key, *copy] for key, copy in sorted(self.held.items())],
            "pairs": [[*key, *one] for key, one in sorted(self.pairs.items())],
        }

    def restore(self, packed: Mapping[str, Any]) -> None:
        """From what `packed` gave."""
        self.held = {(str(a), int(b), int(c)): Copy(*rest) for a, b, c, *rest in packed.get("held", [])}
        self.pairs = {(int(a), int(b)): (int(c), int(d)) for a, b, c, d in packed.get("pairs", [])}

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns: nothing was seen later."""
        self.pairs = {key: (seen, min(last, time)) for key, (seen, last) in self.pairs.items()}


def _live(rows: Rows, time: int, config: CentreConfig) -> Ints:
    """The rows that feed a track and whose next report is not overdue."""
    inside = rows.inside()
    slack = np.maximum(rows.interval[inside] // 2, round(config.period * 1e9))
    return inside[rows.tracks.seen[inside] + rows.interval[inside] + slack >= time]


def _fed_by_others(rows: Rows, now: Picture, row: Ints, at: Ints, time: int, config: CentreConfig) -> Bools:
    """Of pairs of a row and a track (K,): a source feeds the track now, and the row's own does not."""
    live = _live(rows, time, config)
    if not len(live) or not len(row):
        return np.zeros(len(row), dtype=np.bool_)
    track, width = now.find(rows.tracks.link[live]), max(len(now.id), 1)
    own = np.isin(rows.source[row] * width + at, rows.source[live] * width + track)
    return np.asarray(np.isin(at, track) & ~own & (now.time[at] >= 0))


def _sources(rows: Rows, now: Picture, time: int, config: CentreConfig) -> dict[int, set[int]]:
    """The sources that feed each track now."""
    fed: dict[int, set[int]] = {}
    live = _live(rows, time, config)
    for track, source in zip(now.find(rows.tracks.link[live]).tolist(), rows.source[live].tolist(), strict=True):
        fed.setdefault(track, set()).add(source)
    return fed


def _told(offset: Floats, velocity: Floats) -> tuple[float, float, float]:
    away, speed = (float(np.sqrt(one[0] ** 2 + one[1] ** 2 + one[2] ** 2)) for one in (offset, velocity))
    if speed < SLOW:
        return away, float("nan"), float("nan")
    behind = -float(offset[0] * velocity[0] + offset[1] * velocity[1] + offset[2] * velocity[2]) / speed
    return away, behind, behind / speed


def _sentence(number: int, copy: Copy) -> str:
    begin = f"its track {number} says it is {copy.identity}, which track {copy.track} is, "
    if abs(copy.behind) > 0.8 * copy.away:
        side, late = ("behind", "late") if copy.behind > 0 else ("ahead", "early")
        return begin + f"{abs(copy.behind):.0f} m {side} along its course: {abs(copy.delay):.1f} s {late}?"
    return begin + f"{copy.away:.3g} m away: is it turned or shifted, or is one of the two false?"
