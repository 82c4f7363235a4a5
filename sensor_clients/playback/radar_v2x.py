"""A traffic radar and the reports of one vehicle at a crossing in Gainesville, 2017-05-02 (Emami, `sensible`, MIT).

`radar.csv`: the track output of a Smartmicro UMRR, 20 scans a second: time (s of the day, UTC), the object's number, x
and y (ahead and left of the radar, m), vx, vy (m/s). A number is used again and again, a second later for another
vehicle. `vehicle1.csv`: DSRC reports as received beside the road: each fix about four times with the same stamp, .15
to .2 s late. No covariances are said by the radar: `RADAR_SIGMA` is chosen. Everything here is in the ENU frame of the
radar's place; the radar looks 3.6 degrees to the left of north. There is no truth.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service import geodesy
from schemas import Disk, Enu, Motion
from sensor_clients.events import Event, Parameter, Scenario

__all__ = [
    "FRAME",
    "PARAMETERS",
    "SENSORS",
    "SPACE",
    "SUMMARY",
    "Report",
    "find",
    "info",
    "load",
    "read_radar",
    "read_vehicle",
]

Floats = NDArray[np.float64]

SECOND = 10**9
MIDNIGHT = 1_493_683_200 * SECOND
"""2017-05-02T00:00:00Z, ns."""
FRAME = Enu(29.6216931, -82.3867591)
TURNED = np.radians(3.6)
RADAR_SIGMA = (1.0, 1.0, 0.5, 2.0)
"""Of x, y, vx, vy in the radar's own axes, m and m/s: chosen; its vy is 0 nearly always, also of what turns."""
VEHICLE_SIGMA, VEHICLE_SPEED = 1.0, 0.3
"""The least sigma of a vehicle's place that is believed, m, and that of its velocity, m/s: chosen."""
SPACE = ("x", "y", "vx", "vy")
SENSORS = ("radar", "vehicle1")
SUMMARY = "a traffic radar with numbers used again, and one vehicle's reports, about 5 minutes"
PARAMETERS = (
    Parameter(
        "radar's place", "29.6216931 N 82.3867591 W, looking 3.6 degrees left of north", "authors' configuration"
    ),
    Parameter("radar: sigma of x, y, vx, vy", "1 m, 1 m, 0.5 m/s, 2 m/s", "chosen"),
    Parameter("vehicle: sigma of place, velocity", "as said, 1 m at least; 0.3 m/s", "chosen"),
    Parameter("motion", "cv, 2 m2/s3", "chosen"),
)


def find(data: Path) -> Path:
    """The folder of the recording: `radar-v2x` in `data` where that is there, else `data` itself."""
    below = data / "radar-v2x"
    return below if (below / "radar.csv").is_file() else data


class Report(NamedTuple):
    """One message: time of its states and of its reception, ns; id (T,), mean (T, 4), covariance (T, 4, 4)."""

    time: int
    received: int
    id: NDArray[np.uint64]
    mean: Floats
    covariance: Floats


def read_radar(path: Path, latency: float = 0.1) -> list[Report]:
    """The radar's scans, as received `latency` s later (not recorded)."""
    rows = _read(path, ("time", "id", "x", "y", "vx", "vy"))
    turn = np.array([[-np.sin(TURNED), -np.cos(TURNED)], [np.cos(TURNED), -np.sin(TURNED)]])
    both = np.kron(np.eye(2), turn)
    mean, covariance = rows[:, 2:] @ both.T, both @ np.diag(np.square(RADAR_SIGMA)) @ both.T
    out = []
    starts = np.flatnonzero(np.diff(rows[:, 0], prepend=-1.0))
    for some in np.split(np.arange(len(rows)), starts[1:]):
        some = some[np.argsort(rows[some, 1], kind="stable")]
        time = MIDNIGHT + round(rows[some[0], 0] * SECOND)
        spread = np.tile((covariance + covariance.T) / 2, (len(some), 1, 1))
        out.append(Report(time, time + round(latency * SECOND), rows[some, 1].astype(np.uint64), mean[some], spread))
    return out


def read_vehicle(path: Path) -> list[Report]:
    """The vehicle's messages as received: id 1."""
    names = ("received", "stamp", "lat", "lon", "heading", "speed", "rms_lat", "rms_lon")
    out = []
    for received, stamp, lat, lon, heading, speed, rms_lat, rms_lon in _read(path, names).tolist():
        east, north, _ = geodesy.geodetic_to_enu(lat, lon, 0.0, FRAME)
        course = np.radians(heading)
        mean = np.array([[float(east), float(north), speed * np.sin(course), speed * np.cos(course)]])
        sigma = [max(rms_lon, VEHICLE_SIGMA), max(rms_lat, VEHICLE_SIGMA), VEHICLE_SPEED, VEHICLE_SPEED]
        time, heard = (MIDNIGHT + round(one * SECOND) for one in (stamp, received))
        out.append(Report(time, heard, np.ones(1, dtype=np.uint64), mean, np.diag(np.square(sigma))[None]))
    return out


def _read(path: Path, names: tuple[str, ...]) -> Floats:
    """The named columns (R, len(names)). FileNotFoundError; ValueError says which line cannot be read."""
    rows = []
    with path.open(encoding="utf-8", newline="", errors="replace") as file:
        reader = csv.DictReader(file)
        try:
            for row in reader:
                rows.append([float(row[name]) for name in names])
        except (KeyError, TypeError, ValueError, csv.Error) as error:
            raise ValueError(f"{path}:{reader.line_num}: cannot be read ({type(error).__name__}: {error})") from None
    if not rows:
        raise ValueError(f"{path}: no rows")
    found = np.array(rows)
    if not np.isfinite(found).all():
        raise ValueError(f"{path}:{int(np.argmin(np.isfinite(found).all(axis=1))) + 2}: not a finite number")
    return found


def info(name: str) -> dict[str, Any]:
    """What `radar` or `vehicle1` says of itself."""
    fields = {"frame": FRAME, "position": (0.0, 0.0, 0.0), "period": 0.05, "motion": Motion("cv", 2.0)}
    return fields | ({"coverage": Disk(250.0)} if name == "radar" else {})


def _events(name: str, reports: list[Report]) -> Iterator[Event]:
    yield Event(reports[0].time, "info", info(name))
    for one in reports:
        fields = {"space": SPACE, "frame": FRAME, "ids": one.id, "means": one.mean, "covariances": one.covariance}
        yield Event(one.time, "tracks", fields | {"updated": np.full(len(one.id), one.time)})


def load(directory: Path) -> Scenario:
    """The two files as a scenario, each message due at the time of its states (the vehicle's were later).
    FileNotFoundError, ValueError."""
    reports = {"radar": read_radar(directory / "radar.csv"), "vehicle1": read_vehicle(directory / "vehicle1.csv")}
    start, end = min(one[0].time for one in reports.values()), max(one[-1].time for one in reports.values())
    sensors = {name: partial(_said, name, found) for name, found in reports.items()}
    return Scenario(
        "radar-v2x", SUMMARY, start, (end - start) / SECOND, "replay", PARAMETERS, sensors, lambda: iter(())
    )


def _said(name: str, reports: list[Report], seed: int) -> Iterator[Event]:
    return _events(name, reports)
