"""Whether a truth that was given is of this mission: what would make it fit where it does not.

Where no fused track comes near any target: latitude and longitude swapped, or without their sign, each tried. Where
tracks are far more wrong than they say: one error of the truth's times, from the errors along the true velocities,

    dt = sum e'v / sum v'v,    e = track - truth,

found again with the truth at t + dt, and told only if the errors are then less than `BETTER` of what they were.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.review.evaluation.gps_table import GpsTable
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.tables import digits
from fusion_service.review.snapshots import Times, truth_path, truth_positions
from schemas import Frame, GlobalTracks, Truth, merged
from schemas.messages import TENTATIVE

__all__ = ["misfit"]

PICTURES = 300
"""So many are looked at."""
BETTER, LEAST_S = 0.5, 0.2
ROUNDS, LEAST_PAIRS = 4, 3
KNOWN = {18.0: "GPS time is 18 s ahead of UTC", 37.0: "TAI is 37 s ahead of UTC"}
NEAR_S = 0.5


class _Shown(NamedTuple):
    """Places (R, 2), m, of confirmed and coasting tracks at a time, ns."""

    time: int
    places: Floats


def misfit(book: Logbook, centre: str, truths: Sequence[Truth], table: GpsTable | None, c: float, lost: bool) -> str:
    """What is to be said of `truths` beside the tracks of a centre, "" for nothing. c: cut-off, m; lost: whether no
    track had a target."""
    frame = book.first_pictures[centre].frame
    shown = _shown(book, centre, frame)
    if not shown:
        return ""
    if not lost:
        return _late(shown, truths, frame, c)
    near, far = _near(shown, truths, frame, c)
    if near > 0 or not np.isfinite(far):
        return ""
    for words, other in _others(table):
        if _near(shown, other.messages(frame), frame, c)[0] > BETTER:
            return f"no fused track comes near any target, but with {words} they do: mend the table"
    where = "" if table is None or table.geodetic else "; are its x and y those of the picture's frame?"
    return (
        f"no fused track comes within the cut-off of any target, the nearest are {far / 1e3:.4g} km off: "
        f"is it the truth of this mission{where or '?'}"
    )


def _shown(book: Logbook, centre: str, frame: Frame) -> list[_Shown]:
    found: list[_Shown] = []
    picture = None
    stream = book.tracks(lambda kind, name: kind == "global" and name == centre)
    for message in islice(stream, PICTURES):
        assert isinstance(message, GlobalTracks)
        picture = merged(picture, message)
        if picture is None or picture.frame != frame or not {"x", "y"} <= set(picture.space):
            continue
        at = [picture.space.index("x"), picture.space.index("y")]
        places = picture.means[picture.status != TENTATIVE][:, at]
        if len(places):
            found.append(_Shown(picture.time, places))
    return found


def _states(truths: Sequence[Truth], frame: Frame, times: Times) -> Floats:
    """x, y, vx, vy (K, T, 4) of all targets, NaN where not known."""
    paths = truth_path(truths, frame, ("x", "y"), ("vx", "vy"))
    return np.stack([truth_positions(*path, times, 5.0) for path in paths.values()], axis=1)


def _distances(shown: Sequence[_Shown], states: Floats) -> tuple[Floats, Floats, Floats]:
    """Of each target at each time (R of them): e (R, 2) to the nearest track, its size (R,), velocity (R, 2)."""
    errors, speeds = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for one, there in zip(shown, states, strict=True):
        targets = there[np.isfinite(there[:, :2]).all(axis=1)]
        e = one.places[None] - targets[:, None, :2]
        nearest = np.argmin((e**2).sum(axis=2), axis=1)
        errors.append(e[np.arange(len(targets)), nearest])
        speeds.append(targets[:, 2:])
    error = np.concatenate(errors)
    return error, np.hypot(error[:, 0], error[:, 1]), np.concatenate(speeds)


def _near(shown: Sequence[_Shown], truths: Sequence[Truth], frame: Frame, c: float) -> tuple[float, float]:
    """The share of targets with a track within the cut-off, and the smallest distance, m."""
    times = np.array([one.time for one in shown], dtype=np.int64)
    _, apart, _ = _distances(shown, _states(truths, frame, times))
    return (float((apart < c).mean()), float(apart.min())) if len(apart) else (0.0, np.inf)


def _others(table: GpsTable | None) -> list[tuple[str, GpsTable]]:
    """What the table might have meant, in words and as a table."""
    if table is None:
        return []
    if not table.geodetic:
        return [("x and y swapped", replace(table, places=table.places[:, [1, 0, *range(2, table.places.shape[1])]]))]
    other = [("longitudes of the other sign", table.places * [1, -1, 1])]
    other.append(("latitudes of the other sign", table.places * [-1, 1, 1]))
    if (np.abs(table.places[:, 1]) <= 90).all():
        other.append(("lat and lon swapped", table.places[:, [1, 0, 2]]))
    return [(words, replace(table, places=places)) for words, places in other]


def _late(shown: Sequence[_Shown], truths: Sequence[Truth], frame: Frame, c: float) -> str:
    times = np.array([one.time for one in shown], dtype=np.int64)
    dt, first, last = 0.0, np.nan, np.nan
    for turn in range(ROUNDS + 1):
        states = _states(truths, frame, times + round(dt * 1e9))
        error, apart, speed = _distances(shown, states)
        good = (apart < c) & np.isfinite(speed).all(axis=1)
        if good.sum() < LEAST_PAIRS:
            return ""
        last = float(np.sqrt((apart[good] ** 2).mean()))
        first = last if turn == 0 else first
        below = float((speed[good] ** 2).sum())
        if turn < ROUNDS:
            dt += float((error[good] * speed[good]).sum()) / below if below > 0 else 0.0
    if not (abs(dt) >= LEAST_S and last < BETTER * first):
        return ""
    known = next((f": {words}" for size, words in KNOWN.items() if abs(dt - size) < NEAR_S), "")
    return (
        f"the tracks would be {digits(last)} m from the truth instead of {digits(first)} m if the truth were stamped "
        f"{abs(dt):.3g} s {'earlier' if dt > 0 else 'later'}{known or ': a clock, or tracks that lag?'}"
    )
