"""Local trackers for a lidar and a radar on a ship in a harbour, with what is known of each sensor as data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from schemas import Motion
from sensor_clients.events import Parameter
from sensor_clients.filters import LocalTracker, Position, Report, TrackerConfig
from sensor_clients.filters.measurement import Floats
from sensor_clients.playback.following import SECOND, ClutterMap, follow, parameters
from sensor_clients.playback.hulls import Hulls
from sensor_clients.playback.shadow import Shade

__all__ = ["LIDAR", "RADAR", "HarbourSensor", "HarbourTracker", "cluster"]

VESSEL = (36.0, 10.0)
"""Length and beam of the largest vessel reckoned with, m: the larger of the two."""

SOURCES = {
    "period": "median of the data",
    "latency": "best fit to the truth of 2, 3, 5, 13, 16",
    "coverage": "chosen",
    "coverage_detection": "chosen",
    "initiation_delay": "chosen",
    "shade": "vessels up to 36 by 10 m, as the larger of the two; a radar's beam of 2.6 deg; wake and seen chosen",
    "resolves": "number of returns of the larger vessel in a scan",
    "reach": "the farthest returns",
    **dict.fromkeys(
        ("sigma_range", "sigma_cross", "sigma_azimuth"), "innovations, without truth: these are still some .3 of it"
    ),
    "tracker hull": "as in shade",
    "tracker extent": "hull in its place",
    "tracker merge": "4: no farther apart than the hull",
    "tracker min_way": "chosen",
}
"""Where each number comes from; all others are `following.TUNED`."""


@dataclass(frozen=True, slots=True)
class HarbourSensor:
    """A sensor that gives places. Lengths in m, times in s, intensities per m2 and scan.

    latency: how long ago a return with this time stamp was true; sigma_range, sigma_cross, sigma_azimuth:
    noise as in `Position`; offset: how far inside a vessel its reference point lies, seen from the sensor;
    reference: standard deviation per axis of what remains of that, the same from scan to scan, so it is added
    to what is reported and not to the noise; cluster: returns closer than this to one another are one; blind:
    returns nearer than this are the own ship's; reach: returns beyond are not looked at; detection: range and
    probability that a vessel is seen, linear between; clutter, births: intensities of false returns (before
    any are learned) and of vessels seen for the first time; map_sigma, map_scans: of the `ClutterMap`;
    coverage, coverage_detection, initiation_delay: what the info says; shade: what vessels hide of one another;
    resolves: whether one vessel gives several returns, from which its length is learned.
    """

    name: str
    sensor_id: int
    period: float
    latency: float
    sigma_range: float
    sigma_cross: float
    sigma_azimuth: float
    offset: float
    reference: float
    cluster: float
    blind: float
    reach: float
    detection: tuple[tuple[float, float], ...]
    clutter: float
    births: float
    map_sigma: float
    map_scans: float
    coverage: float
    coverage_detection: float
    initiation_delay: float
    shade: Shade
    resolves: bool
    tracker: TrackerConfig

    def parameters(self) -> list[Parameter]:
        """One row for `sensor-client list` per number."""
        return parameters(self, self.tracker, SOURCES)


LIDAR = HarbourSensor(
    name="lidar",
    sensor_id=1,
    period=0.5,
    latency=0.7,
    sigma_range=1.4,
    sigma_cross=1.8,
    sigma_azimuth=0.0,
    offset=1.5,
    reference=1.5,
    cluster=5.0,
    blind=3.5,
    reach=200.0,
    detection=((0.0, 0.75), (70.0, 0.75), (100.0, 0.05), (200.0, 0.02)),
    clutter=2e-6,
    births=1e-7,
    map_sigma=20.0,
    map_scans=20.0,
    coverage=75.0,
    coverage_detection=0.8,
    initiation_delay=4.0,
    shade=Shade(*VESSEL, wake=60.0, width=0.0, seen=0.3),
    resolves=True,
    tracker=TrackerConfig(
        motion=Motion("cv", 0.05),
        survival=0.99,
        sigma_speed=4.0,
        gate=12.0,
        confirm=0.95,
        drop=0.002,
        drop_tentative=0.001,
        max_sigma=12.0,
        merge=4.0,
        hull=VESSEL,
        min_way=2.0,
        min_speed=0.5,
    ),
)


RADAR = HarbourSensor(
    name="radar",
    sensor_id=2,
    period=1.68,
    latency=2.2,
    sigma_range=1.2,
    sigma_cross=1.8,
    sigma_azimuth=0.006,
    offset=-1.0,
    reference=2.5,
    cluster=5.0,
    blind=7.0,
    reach=500.0,
    detection=((0.0, 0.8), (500.0, 0.8)),
    clutter=1e-5,
    births=1e-7,
    map_sigma=35.0,
    map_scans=20.0,
    coverage=250.0,
    coverage_detection=0.8,
    initiation_delay=10.0,
    shade=Shade(*VESSEL, wake=60.0, width=0.023, seen=0.3),
    resolves=False,
    tracker=TrackerConfig(
        motion=Motion("cv", 0.08),
        survival=0.99,
        sigma_speed=4.0,
        gate=12.0,
        confirm=0.98,
        drop=0.1,
        drop_tentative=0.001,
        max_sigma=5.5,
        merge=4.0,
        hull=VESSEL,
        min_way=2.0,
        min_speed=0.5,
    ),
)


def cluster(returns: Floats, distance: float) -> Floats:
    """Centres (2, K) of the groups of returns (2, M) linked by gaps below `distance`."""
    if returns.shape[1] < 2 or distance <= 0:
        return returns
    near = np.hypot(*(returns[:, :, None] - returns[:, None])) < distance
    count, label = connected_components(near, directed=False)
    member = (label == np.arange(count)[:, None]) / np.bincount(label)[:, None]
    return np.asarray(returns @ member.T)


class HarbourTracker:
    """The local tracker of one `HarbourSensor`, scan by scan."""

    def __init__(self, sensor: HarbourSensor) -> None:
        self.sensor = sensor
        self.tracker = LocalTracker(sensor.tracker)
        self.clutter = ClutterMap(sensor.clutter, sensor.map_sigma, sensor.map_scans)
        self.hulls = Hulls(sensor.shade.length, sensor.shade.beam / 2 + sensor.sigma_cross)

    def step(self, time: int, own: Floats, returns: Floats) -> bool:
        """One scan stamped `time`, ns: own ship's place (2,), returns (2, M) in the same frame, m. Always used."""
        sensor = self.sensor
        sight = returns - own[:, None]
        distance = np.hypot(*sight)
        kept = (distance >= sensor.blind) & (distance <= sensor.reach)
        returns, sight, distance = returns[:, kept], sight[:, kept], distance[kept]
        if sensor.offset:
            returns = returns + sensor.offset * sight / distance
        model = Position(sensor.sigma_range, sensor.sigma_cross, sensor.sigma_azimuth, (float(own[0]), float(own[1])))
        if sensor.resolves:
            self.tracker.predict(time - round(sensor.latency * SECOND))
            chosen = self.tracker.reported()
            self.hulls.learn(self.tracker.ids[chosen], self.tracker.means[:, chosen], returns)
        returns = cluster(returns, sensor.cluster)
        follow(self.tracker, self.clutter, sensor, time, own, returns, model, beyond=0.0, shade=sensor.shade)
        return True

    def report(self, time: int) -> Report:
        """The confirmed tracks, predicted to `time`, ns."""
        report = self.tracker.report(time)
        report.covariances[:, [0, 1], [0, 1]] += self.sensor.reference**2
        report.covariances[:, :2, :2] += self.hulls.reference(report.ids, report.means.T).transpose(2, 0, 1)
        return report
