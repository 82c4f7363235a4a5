"""Local trackers for an infrared and an optical camera on a ship in a harbour: bearings only.

A camera tells direction and hardly anything of range, for its ship moves little: its tracks are mixtures over range.
Frames follow each other faster than their errors change, so one every `interval` is used. What a large vessel shows
first, bow or stern, stays the same for long: that error is no noise, it is added to what is reported. Whatever stands
still is told by the `ClutterMap` of bearings and by not turning: a track is reported once its bearing has turned, so
a vessel that comes straight on is not, until it passes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from schemas import Motion
from sensor_clients.events import Parameter
from sensor_clients.filters import Bearing, BearingTracker, Report, TrackerConfig
from sensor_clients.filters.measurement import Floats, sight_covariance
from sensor_clients.playback.following import SECOND, ClutterMap, follow, parameters

__all__ = ["EO", "IR", "CameraSensor", "CameraTracker"]

SOURCES = {
    "period": "chosen",
    "edges": "chosen",
    "latency": "chosen: fits to the truth scatter from 0 to 0.7 s and hardly matter",
    "detection": "chosen, after the share of frames with a bearing at a vessel",
    "coverage": "chosen",
    "coverage_detection": "chosen: what one period adds, misses lasting long",
    "initiation_delay": "chosen",
}
"""Where each number comes from; all others are `following.TUNED`."""


@dataclass(frozen=True, slots=True)
class CameraSensor:
    """A sensor that gives bearings. Angles in rad, lengths in m, times in s, intensities per rad and frame used.

    period: one frame in so long is used, and tracks are sent after it; latency: how long ago a bearing with this
    time stamp was true; sigma_bearing, sigma_cross, edges: as in `Bearing`; reference_bearing, reference_cross:
    standard deviations across the line of sight of what stays the same from frame to frame (heading, bow or stern),
    reference_range: along it, over the range, of what the model of motion gets wrong; added to what is reported, not
    to the noise; detection: range and probability that a vessel is seen, linear between; clutter, births: intensities
    of false bearings (before any are learned) and of vessels seen for the first time; map_sigma, map_scans: of the
    `ClutterMap`; coverage (a disk), coverage_detection, initiation_delay: what the info says.
    """

    name: str
    sensor_id: int
    period: float
    latency: float
    sigma_bearing: float
    sigma_cross: float
    edges: tuple[float, ...]
    reference_bearing: float
    reference_cross: float
    reference_range: float
    detection: tuple[tuple[float, float], ...]
    clutter: float
    births: float
    map_sigma: float
    map_scans: float
    coverage: float
    coverage_detection: float
    initiation_delay: float
    tracker: TrackerConfig

    def parameters(self) -> list[Parameter]:
        """One row for `sensor-client list` per number."""
        return parameters(self, self.tracker, SOURCES)


IR = CameraSensor(
    name="ir",
    sensor_id=3,
    period=0.5,
    latency=0.3,
    sigma_bearing=0.02,
    sigma_cross=3.0,
    edges=(12.0, 21.5, 38.6, 69.3, 124.3, 223.0, 400.0),
    reference_bearing=0.03,
    reference_cross=9.0,
    reference_range=0.25,
    detection=((0.0, 0.6), (100.0, 0.5), (200.0, 0.3), (500.0, 0.1)),
    clutter=0.2,
    births=0.01,
    map_sigma=0.04,
    map_scans=20.0,
    coverage=150.0,
    coverage_detection=0.02,
    initiation_delay=10.0,
    tracker=TrackerConfig(
        motion=Motion("cv", 0.08),
        survival=0.98,
        sigma_speed=4.0,
        gate=12.0,
        confirm=0.95,
        drop=0.1,
        drop_tentative=0.01,
        merge=4.0,
        extent=8.0,
        min_way=0.1,
        min_speed=0.003,
    ),
)

EO = replace(
    IR,
    name="eo",
    sensor_id=4,
    detection=((0.0, 0.8), (100.0, 0.7), (200.0, 0.4), (500.0, 0.1)),
    clutter=0.5,
)


class CameraTracker:
    """The local tracker of one `CameraSensor`, frame by frame."""

    def __init__(self, sensor: CameraSensor) -> None:
        self.sensor = sensor
        self.tracker = BearingTracker(sensor.tracker, len(sensor.edges) - 1)
        self.clutter = ClutterMap(sensor.clutter, sensor.map_sigma, sensor.map_scans, angles=True)
        self._due = 0
        self._own: Floats = np.zeros(2)

    def step(self, time: int, own: Floats, bearings: Floats) -> bool:
        """One frame stamped `time`, ns: own ship's place (2,), m, bearings (1, M), rad. Whether it was used."""
        sensor = self.sensor
        if time < self._due:
            return False
        period = round(sensor.period * SECOND)
        self._due = max(self._due + period, time + period // 2)
        self._own = own
        model = Bearing(sensor.sigma_bearing, sensor.sigma_cross, sensor.edges, (float(own[0]), float(own[1])))
        follow(self.tracker, self.clutter, sensor, time, own, bearings, model)
        return True

    def report(self, time: int) -> Report:
        """The confirmed tracks, predicted to `time`, ns, as mixtures over range."""
        report = self.tracker.report(time)
        sight = report.means[:, :2].T - self._own[:, None]
        r2 = np.sum(sight * sight, axis=0)
        across = self.sensor.reference_bearing**2 + self.sensor.reference_cross**2 / np.maximum(r2, 1.0)
        lasting = sight_covariance(sight, self.sensor.reference_range**2, across)
        report.covariances[:, :2, :2] += lasting.transpose(2, 0, 1)
        return report
