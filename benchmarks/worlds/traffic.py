"""`radar-v2x`: the tracks of a real traffic radar, whose numbers are used again and again, through the centre.

There is no truth, but there are lives: a number's life ends where the number is away for more than `AWAY` s, and where
what comes back, after however short a time, is physically not the same object: from where it was, at its velocity, it
is off by more than `NEAR` m + `DRIFT` m for each second away, or its speed differs by more than `SPEED` m/s +
`SPEEDING` for each second (no more than 5 s counted). A confirmed global id joins two lives wrongly if it has both,
one after the other, and they are not the same object by that measure. A life is broken if it has several confirmed
global ids.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.centre import FusionCentre, SourceFound
from schemas import LocalTracks, SensorInfo
from schemas.messages import CONFIRMED
from sensor_clients.playback import radar_v2x
from sensor_clients.playback.radar_v2x import Report

__all__ = ["NAME", "Life", "find", "joins", "lives_of", "measure", "report", "same_object"]

Floats = NDArray[np.float64]

NAME = "radar-v2x"
SECOND = 10**9
DELAY = 0.5
PERIODS = (1.0, 0.2)
AWAY = 1.0
NEAR, DRIFT, SPEED, SPEEDING, LONGEST = 5.0, 3.0, 3.0, 2.0, 5.0
SCAN = 0.077
"""One and a half periods of the radar: a number that is not there for longer was away, s."""


class Life(NamedTuple):
    """One object under one number: times (K,), s, and states (K, 4), x, y, vx, vy."""

    number: int
    times: Floats
    states: Floats


def find(data: Path | str | None) -> Path | None:
    """The folder itself, or the one of that name in it, if it has the radar's tracks."""
    if data is None:
        return None
    folder = radar_v2x.find(Path(data))
    return folder if (folder / "radar.csv").is_file() else None


def same_object(first: Life, second: Life) -> bool:
    """Whether the second may be the first further on; where they overlap, at the beginning of the second."""
    at = np.searchsorted(first.times, second.times[0], side="right") - 1
    gap = max(float(second.times[0] - first.times[at]), 0.0)
    one, other = first.states[at], second.states[0]
    off = float(np.linalg.norm(other[:2] - one[:2] - gap * one[2:]))
    faster = abs(float(np.linalg.norm(other[2:]) - np.linalg.norm(one[2:])))
    gap = min(gap, LONGEST)
    return off <= NEAR + DRIFT * gap and faster <= SPEED + SPEEDING * gap


def lives_of(reports: Sequence[Report]) -> list[Life]:
    """The lives of all numbers, by number and time."""
    times = np.concatenate([np.full(len(one.id), (one.time - reports[0].time) / SECOND) for one in reports])
    ids = np.concatenate([one.id for one in reports])
    states = np.concatenate([one.mean for one in reports])
    out: list[Life] = []
    for number in np.unique(ids).tolist():
        rows = np.flatnonzero(ids == number)
        gap = np.diff(times[rows])
        moved = np.diff(states[rows, :2], axis=0) - gap[:, None] * states[rows[:-1], 2:]
        cut = np.flatnonzero((gap > SCAN) | (np.linalg.norm(moved, axis=1) > NEAR)) + 1
        pieces = [Life(number, times[some], states[some]) for some in np.split(rows, cut)]
        joined = pieces[:1]
        for piece in pieces[1:]:
            last = joined[-1]
            if piece.times[0] - last.times[-1] <= AWAY and same_object(last, piece):
                both = (np.concatenate([getattr(last, name), getattr(piece, name)]) for name in ("times", "states"))
                joined[-1] = Life(number, *both)
            else:
                joined.append(piece)
        out += joined
    return out


def joins(seen: Sequence[tuple[float, dict[int, int]]], lives: Sequence[Life]) -> dict[str, Any]:
    """What the pictures did with lives. seen: for each step its time, s, and the number that each confirmed global id
    had from the radar. "wrong": successive lives of one global id that are not the same object, and of those
    "wrong_number" under one number; "broken": lives with several global ids; "extra": ids beyond the first; "without":
    lives of 3 s or more with none."""
    ids: dict[int, list[int]] = defaultdict(list)
    owners: dict[int, list[int]] = defaultdict(list)
    by_number: dict[int, list[int]] = defaultdict(list)
    for k, life in enumerate(lives):
        by_number[life.number].append(k)
    for time, having in seen:
        for one, number in having.items():
            begun = [k for k in by_number[number] if lives[k].times[0] <= time]
            if begun:
                if ids[one][-1:] != begun[-1:]:
                    ids[one].append(begun[-1])
                if one not in owners[begun[-1]]:
                    owners[begun[-1]].append(one)
    wrong = [
        lives[a].number == lives[b].number
        for chain in ids.values()
        for a, b in pairwise(chain)
        if not same_object(*sorted((lives[a], lives[b]), key=lambda life: float(life.times[0])))
    ]
    return {
        "lives": len(lives),
        "ids": len(ids),
        "wrong": len(wrong),
        "wrong_number": sum(wrong),
        "broken": sum(len(of) > 1 for of in owners.values()),
        "extra": sum(len(of) - 1 for of in owners.values()),
        "without": sum(bool(life.times[-1] - life.times[0] >= 3.0) and k not in owners for k, life in enumerate(lives)),
    }


def measure(folder: Path, seconds: float | None = None) -> dict[str, Any]:
    """`joins` of the recording (its first `seconds`) for each period of the centre, which hears the vehicle as well."""
    radar = radar_v2x.read_radar(folder / "radar.csv")
    vehicle = radar_v2x.read_vehicle(folder / "vehicle1.csv")
    end = radar[-1].time if seconds is None else radar[0].time + round(seconds * SECOND)
    radar, vehicle = ([one for one in reports if one.time <= end] for reports in (radar, vehicle))
    lives = lives_of(radar)
    return {f"{period:g} s": joins(_fly(radar, vehicle, period), lives) for period in PERIODS}


def _fly(radar: list[Report], vehicle: list[Report], period: float) -> list[tuple[float, dict[int, int]]]:
    centre = FusionCentre({"frame": radar_v2x.FRAME, "period": period})
    told: list[tuple[int, SensorInfo | LocalTracks]] = []
    for name, reports in (("radar", radar), ("vehicle1", vehicle)):
        header: dict[str, Any] = {"source": name, "epoch": 1, "origin": "replay"}
        sent = radar[0].time
        centre.handle(SourceFound(name), sent)
        centre.handle(SensorInfo(**header, seq=0, sent=sent, **radar_v2x.info(name)), sent)
        for seq, one in enumerate(reports):
            message = LocalTracks(
                **header, seq=seq, sent=one.received, time=one.time, complete=True, space=radar_v2x.SPACE,
                frame=radar_v2x.FRAME, ids=one.id, means=one.mean, covariances=one.covariance,
                updated=np.full(len(one.id), one.time),
            )  # fmt: skip
            told.append((one.received, message))
    told.sort(key=lambda one: (one[0], one[1].source, one[1].seq))
    seen, at = [], 0
    for k in range(1, int((radar[-1].time - radar[0].time) / SECOND / period) + 1):
        time = radar[0].time + round(k * period * SECOND)
        while at < len(told) and told[at][0] <= time + round(DELAY * SECOND):
            centre.handle(told[at][1], told[at][0])
            at += 1
        tracks = centre.step(time).tracks
        owner = np.repeat(np.arange(len(tracks.ids)), tracks.contributor_counts)
        who = tracks.sources.index("radar") if "radar" in tracks.sources else -1
        rows = (tracks.contributor_source == who) & (tracks.status[owner] == CONFIRMED)
        having = zip(tracks.ids[owner[rows]].tolist(), tracks.contributor_id[rows].tolist(), strict=True)
        seen.append((k * period, dict(having)))
    return seen


def report(found: dict[str, Any], before: dict[str, Any] | None = None) -> list[str]:
    """The measures as a table."""
    lines = [
        f"| {NAME}, a step every | lives | global ids | joined wrongly | of one number | lives broken | extra ids "
        "| lives of 3 s without one |",
        "|---|---|---|---|---|---|---|---|",
    ]
    names = ("lives", "ids", "wrong", "wrong_number", "broken", "extra", "without")
    for period, one in found.items():
        if before and period in before:
            lines.append(f"| {period}, before | " + " | ".join(f"{before[period][name]}" for name in names) + " |")
        lines.append(f"| {period} | " + " | ".join(f"{one[name]}" for name in names) + " |")
    return lines
