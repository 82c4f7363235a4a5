"""MR.CLAM, set 6 (Leung, Halpern, Barfoot, Liu 2011): five robots that watch each other and the landmarks of a map.

Files of a set, in a folder named by its number, with one line of names: `landmarks.csv` (subject, x, y);
`robotN_odometry.csv` (time, Unix s; speed, m/s; turn_rate, rad/s; each row holds until the next), `robotN_seen.csv`
(time, subject, range, m, bearing, rad, left positive; 1 to 5 are robots, the others landmarks), `robotN_truth.csv`
(time, x, y, heading). Everything is in the local frame "mrclam", x and y in m.

Each robot knows its place by odometry and landmarks alone and tracks the robots that it sees. Two sources come of it,
both in the correlation group "robotN":

    robotN        the others. The error of its own place, common to them all, is in the SensorInfo, which is sent again
                  as it changes, and beside its place in the `platform` of each message; what its heading adds, which
                  goes with the error of the place, is in the covariances.
    robotN-self   itself, one track. Its covariance is the whole: a source of its own, so that nothing is added to it.

Both report at full seconds, and say nothing while the robot does not know its place.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fusion_service.errors import DataError
from schemas import Local, Platform
from sensor_clients.events import Event, Parameter, Scenario
from sensor_clients.filters.measurement import STATE, Floats
from sensor_clients.playback.own_place import OwnPlace, Pose
from sensor_clients.playback.robot import MRCLAM, wrapped
from sensor_clients.playback.sighted import Others, Seen

__all__ = ["FRAME", "PARAMETERS", "ROBOTS", "SENSORS", "SETS", "SUMMARY", "Recorded", "load", "read"]

SETS = (6,)
ROBOTS = range(1, 6)
SENSORS = (*(f"robot{n}" for n in ROBOTS), *(f"robot{n}-self" for n in ROBOTS))
SUMMARY = "five robots that watch each other and report themselves, about 13 minutes"
FRAME = Local("mrclam")
SECOND = 10**9
PERIOD = SECOND
TRUTH_PERIOD = SECOND // 5
MOVED = 0.1
"""The info is sent again when the robot has moved by more than this, m, ..."""
CHANGED = 0.1
"""... or when the variances of its place have changed by more than this part."""

PARAMETERS: tuple[Parameter, ...] = (
    Parameter("frame", 'local, "mrclam"', "data set"),
    Parameter("period", f"{PERIOD // SECOND} s", "chosen"),
    *MRCLAM.parameters(),
)


class Recorded:
    """One robot's rows in the order of time: odometry (K, 3), seen (L, 4), truth (M, 4), time in Unix s first; and the
    map, landmark -> place (2,), m."""

    __slots__ = ("landmarks", "number", "odometry", "seen", "truth")

    def __init__(self, number: int, odometry: Floats, seen: Floats, truth: Floats, landmarks: dict[int, Floats]):
        self.number, self.odometry, self.seen, self.truth, self.landmarks = number, odometry, seen, truth, landmarks


def read(folder: Path) -> list[Recorded]:
    """The robots of one set. FileNotFoundError; DataError says which line of which file is wrong."""
    landmarks = {int(row[0]): row[1:] for row in _read(folder / "landmarks.csv", ("subject", "x", "y"), False)}
    robots = []
    for n in ROBOTS:
        odometry = _read(folder / f"robot{n}_odometry.csv", ("time", "speed", "turn_rate"))
        seen = _read(folder / f"robot{n}_seen.csv", ("time", "subject", "range", "bearing"))
        truth = _read(folder / f"robot{n}_truth.csv", ("time", "x", "y", "heading"))
        known = {float(one) for one in (*ROBOTS, *landmarks)} - {float(n)}
        strange = [one for one in seen[:, 1].tolist() if one not in known]
        if strange:
            raise DataError(f"{folder / f'robot{n}_seen.csv'}: robot {n} cannot see subject {strange[0]:g}")
        robots.append(Recorded(n, odometry, seen, truth, landmarks))
    return robots


def _read(path: Path, names: tuple[str, ...], sort: bool = True) -> Floats:
    """The named columns (R, len(names)), by the first of them."""
    rows = []
    try:
        with path.open(encoding="utf-8", newline="") as file:
            for line, row in enumerate(csv.DictReader(file), start=2):
                try:
                    rows.append([float(row[name]) for name in names])
                except (KeyError, TypeError, ValueError) as error:
                    raise DataError(f"{path}:{line}: cannot be read ({type(error).__name__}: {error})") from None
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} is not there: give the directory that holds 6/landmarks.csv") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path} is not a table: {error}") from None
    if not rows:
        raise DataError(f"{path}: no rows")
    found = np.array(rows)
    if not np.isfinite(found).all():
        raise DataError(f"{path}:{int(np.argmin(np.isfinite(found).all(axis=1))) + 2}: not a finite number")
    return found[np.argsort(found[:, 0], kind="stable")] if sort else found


class _Robot:
    """One robot at work: its rows taken in up to a time."""

    def __init__(self, recorded: Recorded) -> None:
        self.recorded = recorded
        self.place = OwnPlace(MRCLAM, recorded.landmarks)
        self.others = Others(MRCLAM)
        self._moves = np.rint(recorded.odometry[:, 0] * SECOND).astype(np.int64).tolist()
        self._looks = np.rint(recorded.seen[:, 0] * SECOND).astype(np.int64).tolist()
        self._moved = self._looked = 0

    def until(self, time: int) -> Pose | None:
        """Take in all rows up to `time`, ns; where it is then. Commands come before sightings of the same time."""
        moves, looks = self._moves, self._looks
        while True:
            move = moves[self._moved] if self._moved < len(moves) else time + 1
            look = looks[self._looked] if self._looked < len(looks) else time + 1
            if min(move, look) > time:
                self.place.advance(time)
                return self.place.pose()
            if move <= look:
                _, speed, turn = self.recorded.odometry[self._moved].tolist()
                self.place.command(move, speed, turn)
                self._moved += 1
            else:
                self._look(look)
                self._looked += 1

    def _look(self, time: int) -> None:
        _, subject, distance, bearing = self.recorded.seen[self._looked].tolist()
        if subject not in ROBOTS:
            self.place.see(time, int(subject), distance, bearing)
            if self.place.mean is None:
                self.others.forget()
            return
        self.place.advance(time)
        pose = self.place.pose()
        if pose is not None:
            self.others.see(time, int(subject), distance, bearing, pose)


def seen_events(recorded: Recorded, start: int, end: int, seed: int = 0) -> Iterator[Event]:
    """What robotN says: where it is and how sure, and the other robots, at every full second of [start, end], ns."""
    robot = _Robot(recorded)
    told = np.full(3, np.inf), np.eye(2)
    for time in range(-(-start // PERIOD) * PERIOD, end + 1, PERIOD):
        pose = robot.until(time)
        if pose is None:
            continue
        common = pose.common
        if _changed(told, (pose.mean, common)):
            told = pose.mean, common
            yield Event(time, "info", _info(recorded.number, pose.mean, common))
        seen = robot.others.report(time, told[1])
        yield Event(time, "tracks", _tracks(seen) | {"platform": _platform(pose.mean, told[1])})


def self_events(recorded: Recorded, start: int, end: int, seed: int = 0) -> Iterator[Event]:
    """What robotN-self says: one track, of itself, at every full second of [start, end], ns."""
    robot, epoch = _Robot(recorded), 0
    told = np.full(3, np.inf)
    known = False
    for time in range(-(-start // PERIOD) * PERIOD, end + 1, PERIOD):
        pose, state = robot.until(time), robot.place.state()
        if pose is None or state is None:
            known = False
            continue
        epoch, known = epoch + (not known), True
        if not np.hypot(*(pose.mean - told)[:2]) <= MOVED:
            told = pose.mean
            yield Event(time, "info", _info(recorded.number, pose.mean, None))
        now, mean, covariance = np.array([time]), state[0][None], state[1][None]
        own = Seen(np.array([epoch], dtype=np.uint64), [recorded.number], mean, covariance, now)
        yield Event(time, "tracks", _tracks(own) | {"platform": _platform(pose.mean, None)})


def _tracks(seen: Seen) -> dict[str, Any]:
    return {
        "complete": True,
        "space": STATE,
        "frame": FRAME,
        "ids": seen.ids,
        "means": seen.means,
        "covariances": seen.covariances,
        "updated": seen.updated,
        "identity": tuple(f"robot:{subject}" for subject in seen.subjects),
    }


def _platform(pose: Floats, common: Floats | None) -> Platform:
    """Where the robot is; its heading, counted from x to y, as one that is counted from +y clockwise."""
    place = float(pose[0]), float(pose[1]), 0.0
    return Platform(place, None if common is None else _flat(common), wrapped(math.pi / 2 - float(pose[2])))


def _flat(common: Floats) -> Floats:
    P = np.zeros((3, 3))
    P[:2, :2] = common
    return P


def _changed(told: tuple[Floats, Floats], now: tuple[Floats, Floats]) -> bool:
    """Whether a pose and its common covariance (2, 2) are no longer what was told."""
    if not np.hypot(*(now[0] - told[0])[:2]) <= MOVED:
        return True
    scale = np.sqrt(np.diag(now[1]))
    return bool((np.abs(now[1] - told[1]) > CHANGED * np.outer(scale, scale)).any())


def _info(number: int, pose: Floats, common: Floats | None) -> dict[str, Any]:
    fields: dict[str, Any] = {
        "frame": FRAME,
        "position": (float(pose[0]), float(pose[1]), 0.0),
        "period": PERIOD / SECOND,
        "motion": MRCLAM.motion,
        "correlation_group": f"robot{number}",
    }
    if common is not None:
        fields["position_covariance"] = _flat(common)
    return fields


def truth_events(robots: list[Recorded], start: int, end: int) -> Iterator[Event]:
    """Where the robots are, every `TRUTH_PERIOD`, linear between the fixes; a robot whose truth has ended, or has not
    begun, is left out."""
    for time in range(-(-start // TRUTH_PERIOD) * TRUTH_PERIOD, end + 1, TRUTH_PERIOD):
        t = time / SECOND
        there = [one for one in robots if one.truth[0, 0] <= t <= one.truth[-1, 0]]
        places = [[np.interp(t, one.truth[:, 0], one.truth[:, axis]) for axis in (1, 2)] for one in there]
        ids = np.array([one.number for one in there], dtype=np.uint64)
        fields = {"space": ("x", "y"), "frame": FRAME, "ids": ids, "means": np.array(places).reshape(-1, 2)}
        yield Event(time, "truth", fields)


def load(directory: Path, number: int) -> Scenario:
    """Set `number` below `directory`, for as long as the truth has all robots. FileNotFoundError, DataError."""
    robots = read(directory / str(number))
    start = round(max(min(one.odometry[0, 0], one.seen[0, 0]) for one in robots) * SECOND)
    end = round(min(one.truth[-1, 0] for one in robots) * SECOND)
    if not start < end:
        raise DataError(f"{directory / str(number)}: the robots' files have no time in common")
    kinds = {"": seen_events, "-self": self_events}
    return Scenario(
        name=f"mrclam:{number}",
        summary=SUMMARY,
        start=start,
        duration=(end - start) / SECOND,
        origin="replay",
        parameters=PARAMETERS,
        sensors={
            f"robot{one.number}{suffix}": partial(events, one, start, end)
            for suffix, events in kinds.items()
            for one in robots
        },
        truth=partial(truth_events, robots, start, end),
    )
