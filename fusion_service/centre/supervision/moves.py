"""What the tracks of one source did between two steps: new versions, those that stand still to the bit, and those that
jumped.

A version is new when it holds later and says that a measurement came in. It **repeats** when its mean and covariance
are those of the one before to the last bit. An anchored ship's AIS does so for days, and so does a track without a
measurement; a state with a speed does not, and nor does what a filter makes of measurements with noise.

It has **jumped** when the place is further from where the last one led than

    5 sigma + 3 manoeuvre dt^2 / 2  (+ 3 unknown_speed dt where it has no velocity),

sigma that of both versions and of the velocity over dt, with the shift that the source states. That is asked only where
the id went on without a pause: numbers are used again.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Bools, Floats, picked
from fusion_service.centre.partial import Unknown
from fusion_service.centre.sources import Source
from fusion_service.centre.tracks import Tracks
from fusion_service.config import CentreConfig
from schemas import Frame

__all__ = ["Change", "Moves", "Snapshot", "judged", "moves"]

AXES = (("x", "vx"), ("y", "vy"), ("z", "vz"))
SIGMAS = 5.0
TIMES = 3.0
PAUSE = 3.0
"""Intervals of a track, beyond which its id may be another object's."""


class Snapshot(NamedTuple):
    """The table of a source as it was after a step."""

    epoch: int
    space: tuple[str, ...]
    frame: Frame | None
    tracks: Tracks

    @classmethod
    def of(cls, source: Source, frame: Frame | None) -> Snapshot:
        return cls(source.epoch, source.space, frame, source.tracks)


class Moves(NamedTuple):
    """Of the K new versions, in order of id: at (K,), their place in the table; again (K,), as before to the bit;
    speed (K,), m/s, what they claim, 0 where they claim none; sigma (K,), m, of the place; jumped (K,); away (K,), m,
    from where the last one led; was (K,): the place of that in the table before."""

    at: NDArray[np.intp]
    again: Bools
    speed: Floats
    sigma: Floats
    jumped: Bools
    away: Floats
    was: NDArray[np.intp]


def moves(old: Snapshot, source: Source, frame: Frame | None, shift: float, config: CentreConfig) -> Moves:
    """What the tracks of `source` did since `old`; shift: m, one sigma of what the source states of its place."""
    new = source.tracks
    none = np.zeros(0)
    whole = np.zeros(0, dtype=np.intp)
    nothing = Moves(whole, none > 0, none, none, none > 0, none, whole)
    if (old.epoch, old.space, old.frame) != (source.epoch, source.space, frame) or not len(old.tracks.id):
        return nothing
    before = old.tracks
    at, was = _later(before, new)
    count = len(at)
    if not count:
        return nothing
    if count == len(before.id) == len(new.id):
        x, y, P, R = before.mean, new.mean, before.covariance, new.covariance
    else:
        x, y, P, R = (
            picked(before.mean, was),
            picked(new.mean, at),
            picked(before.covariance, was),
            picked(new.covariance, at),
        )
    dt = (new.time[at] - before.time[was]) / 1e9
    return Moves(at, *judged(Change(x, y, P, R, dt, before.interval[was]), source.space, shift, config), was)


class Change(NamedTuple):
    """K new versions and the ones before: mean before (n, K) and now; covariance before (n, n, K) and now; seconds (K,)
    between them; interval (K,), ns, of the ones before."""

    before: Floats
    now: Floats
    spread_before: Floats
    spread_now: Floats
    dt: Floats
    interval: NDArray[np.int64]


def judged(
    change: Change, space: tuple[str, ...], shift: float, config: CentreConfig
) -> tuple[Bools, Floats, Floats, Bools, Floats]:
    """again, speed, sigma, jumped and away of `Moves`, each (K,); every one of a version by itself."""
    x, y, P, R, dt, interval = change
    again = np.asarray((x == y).all(axis=0))
    if again.any():
        again[again] = (P[:, :, again] == R[:, :, again]).all(axis=(0, 1))
    limit = Unknown.of(space).limit
    away, spread, speed, sigma = np.zeros((4, len(dt)))
    for axis, rate in AXES:
        if axis not in space:
            continue
        k = space.index(axis)
        off, wide = y[k] - x[k], np.full(len(dt), (TIMES * config.unknown_speed / SIGMAS) ** 2)
        if rate in space:
            i = space.index(rate)
            known = P[i, i] < limit[i]
            v, wide = np.where(known, x[i], 0.0), np.where(known, P[i, i], wide)
            off = off - v * dt
            speed += v * v
        counts = P[k, k] < limit[k]
        away += np.where(counts, off * off, 0.0)
        spread += np.where(counts, P[k, k] + R[k, k] + wide * dt * dt + 2.0 * shift * shift, 0.0)
        sigma += np.where(counts, R[k, k], 0.0)
    moved = np.sqrt(away)
    far = SIGMAS * np.sqrt(spread) + TIMES * config.manoeuvre * dt * dt / 2
    held = dt <= PAUSE * np.maximum(interval, 1) / 1e9
    return again, np.sqrt(speed), np.sqrt(sigma), held & (moved > far) & np.isfinite(far), moved


def _later(before: Tracks, new: Tracks) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The new versions (K,) in a table, with a newer measurement, and what they follow in the table before."""
    if len(before.id) == len(new.id) and np.array_equal(before.id, new.id):
        later = (new.time > before.time) & (new.updated > before.updated) & (before.origin == new.origin)
        at = np.flatnonzero(later)
        return at, at
    place = np.minimum(np.searchsorted(before.id, new.id), len(before.id) - 1)
    later = (before.id[place] == new.id) & (new.time > before.time[place]) & (new.updated > before.updated[place])
    at = np.flatnonzero(later & (before.origin[place] == new.origin))
    return at, place[at]
