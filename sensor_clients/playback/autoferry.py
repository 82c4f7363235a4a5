"""The Autoferry benchmark (Helgesen et al. 2022): lidar, radar, cameras and truth of harbour scenes, from JSON.

A file of detections holds one record per scan of one sensor (1 lidar, 2 radar, 3 IR, 4 EO): `time` in Unix
seconds, `ownshipPosition` (north, east) m from Piren, and `measurement`, [] or [north, east] or
[[north, ...], [east, ...]] relative to the own ship; of a camera [bearing, ...] or one bare bearing, rad, clockwise
from north. Everything here is in the ENU frame about Piren
(x = east, y = north). The records of some scenarios are not in the order of time.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fusion_service.errors import DataError
from schemas import Disk, Enu, Height
from sensor_clients.events import Event, Parameter, Scenario
from sensor_clients.filters.measurement import Floats
from sensor_clients.playback.autoferry_hulls import PARAMETERS as HULL_PARAMETERS
from sensor_clients.playback.autoferry_hulls import hulls
from sensor_clients.playback.cameras import EO, IR, CameraSensor, CameraTracker
from sensor_clients.playback.harbour import LIDAR, RADAR, HarbourSensor, HarbourTracker

__all__ = [
    "PARAMETERS",
    "PIREN",
    "SCENARIOS",
    "SENSORS",
    "SUMMARY",
    "Scan",
    "load",
    "read_scans",
    "read_truth",
    "sensor_events",
]

SCENARIOS = (2, 3, 4, 5, 6, 13, 16, 17, 22)
SUMMARY = "lidar, radar and cameras of a small ferry among two vessels, about 2 minutes"
PIREN = Enu(63.4389029083, 10.39908278, 39.923)
SENSORS: dict[str, HarbourSensor | CameraSensor] = {"lidar": LIDAR, "radar": RADAR, "ir": IR, "eo": EO}
SECOND = 10**9
TRUTH_PERIOD = SECOND // 5
CAMERAS = (IR.sensor_id, EO.sensor_id)
MOVED = 1.0
"""The info is sent again when the own ship has moved by more than this, m."""

PARAMETERS: tuple[Parameter, ...] = (
    Parameter("frame", "ENU about Piren, 63.4389029083 N 10.39908278 E 39.923 m", "data set's README"),
    *HULL_PARAMETERS,
    *(row for sensor in SENSORS.values() for row in sensor.parameters()),
)


class Scan(NamedTuple):
    """One scan: time, ns UTC; own ship's x, y (2,), m; returns' x, y (2, M), m, or a camera's bearings (1, M), rad."""

    time: int
    own: Floats
    returns: Floats


def read_scans(path: Path, sensor_id: int) -> list[Scan]:
    """Scans of one sensor in the order of time. Raises FileNotFoundError, and
    `DataError` for a file that is not one of detections."""
    scans = []
    for record in _read(path):
        try:
            if record["sensorID"] != sensor_id:
                continue
            own = np.array(record["ownshipPosition"], dtype=np.float64)[::-1]
            returns = np.array(record["measurement"], dtype=np.float64)
            camera = sensor_id in CAMERAS
            returns = returns.reshape(1, -1) if camera else returns.reshape(2, -1)[::-1] + own[:, None]
            scans.append(Scan(round(record["time"] * SECOND), own, returns))
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path}: a detection cannot be read ({type(error).__name__}: {error})") from None
    return sorted(scans, key=lambda scan: scan.time)


def read_truth(path: Path) -> dict[int, tuple[Floats, Floats]]:
    """Each vessel's fixes in the order of time, each once: target -> (times (K,), Unix s; x and y (K, 2), m).
    Raises FileNotFoundError, and `DataError` for a file that is none of truth."""
    fixes: dict[int, dict[float, tuple[float, float]]] = {}
    for record in _read(path):
        for fix in record:
            try:
                north, east = fix["position"][:2]
                fixes.setdefault(int(fix["targetID"]), {})[float(fix["time"])] = float(east), float(north)
            except (KeyError, TypeError, ValueError) as error:
                raise DataError(f"{path}: a fix cannot be read ({type(error).__name__}: {error})") from None
    return {
        target: (np.array(sorted(places)), np.array([places[time] for time in sorted(places)]))
        for target, places in sorted(fixes.items())
    }


def _read(path: Path) -> list[Any]:
    try:
        with path.open(encoding="utf-8") as file:
            records = json.load(file)
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} is not there: give the directory of the Autoferry JSON files") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DataError(f"{path} is not JSON: {error}") from None
    if not isinstance(records, list):
        raise DataError(f"{path} does not hold a list of records")
    return records


def sensor_events(sensor: HarbourSensor | CameraSensor, scans: list[Scan], seed: int = 0) -> Iterator[Event]:
    """What the sensor says: its info where the own ship is, and its tracks after every scan (a camera: after every
    frame that it uses)."""
    tracker = HarbourTracker(sensor) if isinstance(sensor, HarbourSensor) else CameraTracker(sensor)
    told = np.full(2, math.inf)
    for scan in scans:
        if not math.dist(told, scan.own) <= MOVED:
            told = scan.own
            yield Event(scan.time, "info", _info(sensor, scan.own))
        if not tracker.step(scan.time, scan.own, scan.returns):
            continue
        fields = tracker.report(scan.time).fields()
        yield Event(scan.time, "tracks", {"frame": PIREN, "height": Height(PIREN.alt, 0.0)} | fields)


def _info(sensor: HarbourSensor | CameraSensor, own: Floats) -> dict[str, Any]:
    return {
        "frame": PIREN,
        "position": (float(own[0]), float(own[1]), 0.0),
        "period": sensor.period,
        "motion": sensor.tracker.motion,
        "coverage": Disk(sensor.coverage),
        "detection_probability": sensor.coverage_detection,
        "initiation_delay": sensor.initiation_delay,
        "may_start": sensor.sensor_id not in CAMERAS,
        "correlation_group": "own-ship",
    }


def truth_events(truth: dict[int, tuple[Floats, Floats]], start: int, end: int) -> Iterator[Event]:
    """Where the vessels are, every `TRUTH_PERIOD`, linear between the fixes (5 to 25 a second, each vessel at
    its own times); a vessel whose fixes have not begun or have ended is left out."""
    for time in range(start, end + 1, TRUTH_PERIOD):
        t = time / SECOND
        places = {
            target: [np.interp(t, times, place[:, 0]), np.interp(t, times, place[:, 1])]
            for target, (times, place) in truth.items()
            if times[0] <= t <= times[-1]
        }
        fields = {"space": ("x", "y"), "frame": PIREN, "ids": np.array(list(places), dtype=np.uint64)}
        fields |= {"means": np.array(list(places.values())).reshape(-1, 2)}
        if places:
            fields |= {"extent": np.concatenate([hulls(k, *truth[k], np.array([t])) for k in places]), "shape": "box"}
        yield Event(time, "truth", fields)


def load(directory: Path, number: int) -> Scenario:
    """Scenario `number` from its two files. Raises FileNotFoundError and `DataError`, which say what is
    wrong with which file."""
    detections = directory / f"scenario{number}_detections.json"
    scans = {name: read_scans(detections, sensor.sensor_id) for name, sensor in SENSORS.items()}
    truth = read_truth(directory / f"scenario{number}_groundTruth.json")
    ranging = [scans[name] for name in ("lidar", "radar")]
    if not all(ranging) or not truth:
        raise DataError(f"{detections} or the truth beside it is empty")
    start = min(found[0].time for found in ranging)
    end = max(found[-1].time for found in ranging)
    return Scenario(
        name=f"autoferry:{number}",
        summary=SUMMARY,
        start=start,
        duration=(end - start) / SECOND,
        origin="replay",
        parameters=PARAMETERS,
        sensors={name: partial(sensor_events, SENSORS[name], found) for name, found in scans.items() if found},
        truth=partial(truth_events, truth, start, end),
    )
