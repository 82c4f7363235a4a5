"""How each kind of requirement is counted, target by target.

A stay is an unbroken run of scored times at which a target exists and is in the area. An update is a shown track of the
target with a newer measurement than the last one had (`counts = "measured"`), or any shown track of it ("shown").
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.review.profiles.observing import Observed

__all__ = ["COUNTING", "Counted", "Scene"]

HOUR = 3600.0
EDGE = 1e-6
"""Of an interval, s: rounding of times is no gap."""


class Counted(NamedTuple):
    """Sums (T,) and numbers of samples (T,) by target, or (1,) where there is none: good samples, squares, or events in
    so many hours; why: there is none, if it is known."""

    sums: Floats
    samples: Floats
    what: str
    by_target: bool = True
    why: str = ""


class Scene(NamedTuple):
    """What is counted in one area: inside (K, T), and which of the rest's tracks, and of the pairs', are in it (by the
    track's own place for `shown`, by the target's for `held`)."""

    seen: Observed
    inside: Bools
    rest: Bools
    shown: Bools
    identities: Mapping[int, str]

    @property
    def held(self) -> Bools:
        pairs = self.seen.pairs
        return np.asarray(self.inside[pairs.k, pairs.t])

    def by_target(self, rows: Ints, values: Any = None) -> Floats:
        """Sum of values (R,), or the number, of pairs' rows by target (T,)."""
        weights = None if values is None else np.asarray(values, dtype=np.float64)
        found: Floats = np.bincount(self.seen.pairs.t[rows], weights, len(self.seen.targets)).astype(np.float64)
        return found

    def stays(self) -> Iterator[tuple[int, int, int]]:
        """(target, first, last) scored times."""
        for t in range(self.inside.shape[1]):
            edges = np.diff(np.concatenate([[0], self.inside[:, t].astype(np.int8), [0]]))
            yield from (
                (t, int(a), int(b) - 1) for a, b in zip(*map(np.flatnonzero, (edges == 1, edges == -1)), strict=True)
            )

    def of_target(self) -> list[Ints]:
        """The rows of the pairs of each target, in time."""
        by = np.argsort(self.seen.pairs.t, kind="stable")
        ends = np.cumsum(np.bincount(self.seen.pairs.t, minlength=len(self.seen.targets)))
        return np.split(by, ends[:-1]) if len(ends) else []


def _detection(scene: Scene, need: Mapping[str, Any]) -> Counted:
    rows = np.flatnonzero(scene.held)
    return Counted(scene.by_target(rows), scene.inside.sum(axis=0).astype(np.float64), "share")


def _updates(scene: Scene, counts: str) -> Iterator[tuple[int, float, float, Floats]]:
    """(target, begin, end of the stay, times of updates in it), s."""
    seen, rows_of = scene.seen, scene.of_target()
    seconds = (seen.times - seen.times[0]) / 1e9
    for t, first, last in scene.stays():
        rows = rows_of[t]
        rows = rows[(seen.pairs.k[rows] >= first) & (seen.pairs.k[rows] <= last)]
        if counts == "measured" and len(rows):
            newest = np.maximum.accumulate(seen.pairs.updated[rows])
            rows = rows[np.concatenate([[True], newest[1:] > newest[:-1]])]
        yield t, float(seconds[first]), float(seconds[last]), seconds[seen.pairs.k[rows]]


def _update(scene: Scene, need: Mapping[str, Any]) -> Counted:
    good, total = np.zeros((2, len(scene.seen.targets)))
    length = need["interval_s"]
    for t, begin, end, at in _updates(scene, need["counts"]):
        count = int((end - begin + EDGE) // length)
        window = np.maximum(np.ceil((at - begin - EDGE) / length).astype(int) - 1, 0)
        good[t] += len(np.unique(window[window < count]))
        total[t] += count
    return Counted(good, total, "share", why="no target stayed for one such interval")


def _update_interval(scene: Scene, need: Mapping[str, Any]) -> Counted:
    good, total = np.zeros((2, len(scene.seen.targets)))
    for t, _, _, at in _updates(scene, need["counts"]):
        good[t] += int((np.diff(at) <= need["within_s"] + EDGE).sum())
        total[t] += max(len(at) - 1, 0)
    return Counted(good, total, "share")


def _gap(scene: Scene, need: Mapping[str, Any]) -> Counted:
    """Of a silence d longer than the limit, from the begin of the stay and to its end too, ceil(d / interval) - 1
    expected updates are missing; of a stay of length D floor(D / interval) are expected, and all of them missing where
    there was no update at all."""
    missing, total = np.zeros((2, len(scene.seen.targets)))
    length = need["interval_s"]
    for t, begin, end, at in _updates(scene, need["counts"]):
        expected = int((end - begin + EDGE) // length)
        silent = np.diff(np.concatenate([[begin], at, [end]]))
        silent = silent[silent > need["longer_than_s"] + EDGE]
        lacking = float(np.maximum(np.ceil((silent - EDGE) / length) - 1, 1).sum())
        missing[t] += min(lacking, expected) if len(at) or not len(silent) else expected
        total[t] += expected
    return Counted(missing, total, "share", why="no target stayed for one expected interval")


def _directed(vectors: Floats, along: Floats, direction: str, least: float) -> tuple[Floats, Bools]:
    """Errors (R,) of vectors (R, 2 or 3) in a direction by the target's velocity (R, 2), and which there are."""
    if direction == "height":
        return vectors[:, 2], np.isfinite(vectors[:, 2])
    if direction == "horizontal":
        size = np.hypot(vectors[:, 0], vectors[:, 1])
        return size, np.isfinite(size)
    speed = np.hypot(along[:, 0], along[:, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        unit = along / speed[:, None]
        ahead = vectors[:, 0] * unit[:, 0] + vectors[:, 1] * unit[:, 1]
        aside = vectors[:, 1] * unit[:, 0] - vectors[:, 0] * unit[:, 1]
    found = ahead if direction == "along" else aside
    return found, np.isfinite(found) & (speed >= least)


def _errors(scene: Scene, rows: Ints, errors: Floats, within: float | None, why: str) -> Counted:
    if within is not None:
        return Counted(scene.by_target(rows, np.abs(errors) <= within), scene.by_target(rows), "share", why=why)
    return Counted(scene.by_target(rows, errors**2), scene.by_target(rows), "rms", why=why)


def _vectors(scene: Scene, need: Mapping[str, Any], vectors: Floats, within: float | None) -> Counted:
    rows = np.flatnonzero(scene.held)
    pairs = scene.seen.pairs
    along = scene.seen.velocity[pairs.k[rows], pairs.t[rows]]
    errors, known = _directed(vectors[rows], along, need["direction"], need["min_speed_m_per_s"])
    why = "no track had a target" if not len(rows) else f"{need['direction']} is not known: no velocity, or no z"
    return _errors(scene, rows[known], errors[known], within, why)


def _position_error(scene: Scene, need: Mapping[str, Any]) -> Counted:
    return _vectors(scene, need, scene.seen.pairs.offset, need["within_m"])


def _velocity_error(scene: Scene, need: Mapping[str, Any]) -> Counted:
    return _vectors(scene, need, scene.seen.pairs.error, need["within_m_per_s"])


def _false_tracks(scene: Scene, need: Mapping[str, Any]) -> Counted:
    """Those with a target of their own too: where the cut-off is larger than what counts as far."""
    least = need["farther_than_m"] or scene.seen.c
    far = (scene.seen.rest.apart > least)[scene.rest].sum() + (scene.seen.pairs.apart > least)[scene.shown].sum()
    shown = float(scene.rest.sum() + scene.shown.sum())
    return Counted(np.array([float(far)]), np.array([shown]), "share", False, "no track was shown")


def _multiple_tracks(scene: Scene, need: Mapping[str, Any]) -> Counted:
    near = float((scene.rest & (scene.seen.rest.apart < scene.seen.c)).sum())
    return Counted(
        np.array([near]), np.array([near + float(scene.shown.sum())]), "share", False, "no track was near one"
    )


def _identity(scene: Scene, need: Mapping[str, Any]) -> Counted:
    seen, true = scene.seen, [scene.identities.get(one) for one in scene.seen.targets]
    known = np.array([one is not None for one in true], dtype=np.bool_)
    rows = np.flatnonzero(scene.held & known[seen.pairs.t])
    wanted = np.array([seen.identities.index(one) if one in seen.identities else -2 for one in true], dtype=np.intp)
    said = seen.pairs.identity[rows]
    right = said == wanted[seen.pairs.t[rows]]
    good = {"correct": right, "none": said < 0, "wrong": ~right & (said >= 0)}[need["verdict"]]
    why = "no target's identity is known: give them under [identities]" if not known.any() else "no such track"
    return Counted(scene.by_target(rows, good), scene.by_target(rows), "share", why=why)


def _latency(scene: Scene, need: Mapping[str, Any]) -> Counted:
    seen = scene.seen
    if need["of"] == "picture":
        late, why = seen.latency, "the pictures have no clock: the mission did not run in real time"
        return Counted(
            np.array([float((late <= need["within_s"]).sum())]), np.array([float(len(late))]), "share", False, why
        )
    rows = np.flatnonzero(scene.held & (seen.pairs.updated >= 0))
    age = (seen.times[seen.pairs.k[rows]] - seen.pairs.updated[rows]) / 1e9
    return Counted(scene.by_target(rows, age <= need["within_s"]), scene.by_target(rows), "share")


def _continuity(scene: Scene, need: Mapping[str, Any]) -> Counted:
    """Events in the hours of the stays. A break lies within a stay; a swap is a change to a number that followed
    another target before."""
    seen, rows_of = scene.seen, scene.of_target()
    seconds = (seen.times - seen.times[0]) / 1e9
    events, hours = np.zeros((2, len(seen.targets)))
    first = dict[tuple[int, int], int]()
    for number, t, k in zip(seen.pairs.number.tolist(), seen.pairs.t.tolist(), seen.pairs.k.tolist(), strict=True):
        first.setdefault((number, t), k)
    others: dict[int, list[tuple[int, int]]] = {}
    for (number, t), k in first.items():
        others.setdefault(number, []).append((t, k))
    for t, begin, end in scene.stays():
        hours[t] += (seconds[end] - seconds[begin]) / HOUR
        rows = rows_of[t]
        rows = rows[(seen.pairs.k[rows] >= begin) & (seen.pairs.k[rows] <= end)]
        k, number = seen.pairs.k[rows], seen.pairs.number[rows]
        new = np.flatnonzero(number[1:] != number[:-1]) + 1
        if need["count"] == "breaks":
            events[t] += int((np.diff(k) > 1).sum())
        elif need["count"] == "changes":
            events[t] += len(new)
        else:
            events[t] += sum(
                any(other != t and since < k[at] for other, since in others[int(number[at])]) for at in new.tolist()
            )
    return Counted(events, hours, "rate", why="no target stayed")


def _tracked_through(scene: Scene, need: Mapping[str, Any]) -> Counted:
    """At each time from the first track on, whose last `of` scored times are all of the stay and of which a source had
    the target in `seen`."""
    seen = scene.seen
    shown = np.zeros_like(seen.exists)
    shown[seen.pairs.k, seen.pairs.t] = True
    good, total = np.zeros((2, len(seen.targets)))
    for t, begin, end in scene.stays():
        with_track = np.flatnonzero(shown[begin : end + 1, t])
        if not len(with_track):
            continue
        summed = np.concatenate([[0], np.cumsum(seen.seen[begin : end + 1, t])])
        at = np.arange(max(need["of"] - 1, int(with_track[0])), end + 1 - begin)
        at = at[summed[at + 1] - summed[at + 1 - need["of"]] >= need["seen"]]
        good[t] += int(shown[begin + at, t].sum())
        total[t] += len(at)
    return Counted(good, total, "share", why="no target was seen so often by a source")


def _motion_after(scene: Scene, need: Mapping[str, Any]) -> Counted:
    """One sample for each stay with a track: the first scored time so long after it, if the target is still there."""
    seen, rows_of = scene.seen, scene.of_target()
    seconds = (seen.times - seen.times[0]) / 1e9
    good, total = np.zeros((2, len(seen.targets)))
    for t, begin, end in scene.stays():
        rows = rows_of[t]
        rows = rows[(seen.pairs.k[rows] >= begin) & (seen.pairs.k[rows] <= end)]
        if not len(rows):
            continue
        k = int(np.searchsorted(seconds, seconds[seen.pairs.k[rows[0]]] + need["after_s"] - EDGE))
        if k > end:
            continue
        total[t] += 1
        row = rows[seen.pairs.k[rows] == k]
        good[t] += len(row) > 0 and _right(seen.velocity[k, t], seen.pairs.velocity[row[0]], need)
    return Counted(good, total, "share", why="no target was there so long after its first track")


def _right(true: Floats, said: Floats, need: Mapping[str, Any]) -> bool:
    speed, shown = float(np.hypot(*true)), float(np.hypot(*said))
    if not abs(shown - speed) <= max(need["speed_within_m_per_s"], need["or_speed_share"] * speed):
        return False
    turn = float(np.arctan2(true[0], true[1]) - np.arctan2(said[0], said[1]))
    off = abs(np.degrees(np.arctan2(np.sin(turn), np.cos(turn))))
    return bool(speed < need["min_speed_m_per_s"] or off <= need["course_within_deg"])


def _prediction_error(scene: Scene, need: Mapping[str, Any]) -> Counted:
    """Each track at a scored time with one `horizon` later, to half a step, at which its target is there."""
    seen, pairs = scene.seen, scene.seen.pairs
    rows = np.flatnonzero(scene.held & np.isfinite(pairs.velocity).all(axis=1))
    if need["after_s"] > 0:
        begun = np.full(len(seen.targets), np.iinfo(np.int64).max)
        np.minimum.at(begun, pairs.t, seen.times[pairs.k])
        rows = rows[seen.times[pairs.k[rows]] - begun[pairs.t[rows]] >= (need["after_s"] - EDGE) * 1e9]
    step = float(np.median(np.diff(seen.times))) if len(seen.times) > 1 else 0.0
    wanted = seen.times[pairs.k[rows]] + round(need["horizon_s"] * 1e9)
    after = np.minimum(np.searchsorted(seen.times, wanted - step / 2), len(seen.times) - 1)
    there = (np.abs(seen.times[after] - wanted) <= step / 2 + 1) & scene.inside[after, pairs.t[rows]]
    rows, after = rows[there], after[there]
    ahead = ((seen.times[after] - seen.times[pairs.k[rows]]) / 1e9)[:, None]
    moved = seen.place[after, pairs.t[rows]][:, :2] - seen.place[pairs.k[rows], pairs.t[rows]][:, :2]
    off = pairs.offset[rows, :2] + pairs.velocity[rows] * ahead - moved
    return _errors(scene, rows, np.hypot(off[:, 0], off[:, 1]), need["within_m"], "no target was there so much later")


COUNTING: Mapping[str, Callable[[Scene, Mapping[str, Any]], Counted]] = {
    "detection": _detection,
    "update": _update,
    "update_interval": _update_interval,
    "gap": _gap,
    "position_error": _position_error,
    "velocity_error": _velocity_error,
    "false_tracks": _false_tracks,
    "multiple_tracks": _multiple_tracks,
    "identity": _identity,
    "latency": _latency,
    "continuity": _continuity,
    "tracked_through": _tracked_through,
    "motion_after": _motion_after,
    "prediction_error": _prediction_error,
}
