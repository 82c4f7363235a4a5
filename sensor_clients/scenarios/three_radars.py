"""Three radars and twenty targets on a flat sea, after Sharma 6.4.

The coordinates are those of its Table 3. Its Table 2 (noise, clutter, detection, process noise, scan time) is
missing from the text; `RADAR` and the constants beside it hold what was chosen instead, and `PARAMETERS`
lists every number with its source.

A target moves along the straight chord between its two places, at constant speed, and each point of the chord
is put onto the ellipsoid (height 0) along its normal: over 22-70 km that is the geodesic within 1 m, at a speed
constant within 1e-4. A radar sees range and azimuth, atan2(y, x), of a target's (x, y) in its own tangent plane
(ENU, WGS84). Its clutter is uniform in range and azimuth. Its local tracker works in that plane with a CKF
and starts tracks by the unbiased conversion, so that the curved cross-range (3 mrad are 900 m at 300 km, bent
by 1.4 m) is taken account of.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from fusion_service import geodesy
from schemas import Disk, Ecef, Enu, Height, Motion
from sensor_clients.events import Event, Parameter, Scenario
from sensor_clients.filters import (
    GmPhdFilter,
    ImmTracker,
    LocalTracker,
    Modes,
    PhdConfig,
    RangeAzimuth,
    TrackerConfig,
)
from sensor_clients.filters.measurement import Floats

__all__ = [
    "PARAMETERS",
    "RADARS",
    "TARGETS",
    "TRACKERS",
    "Radar",
    "radar_events",
    "scan",
    "three_radars",
    "true_states",
]

START = 1_767_225_600 * 10**9
"""2026-01-01T00:00:00Z, ns."""
DURATION = 300.0
REPORT_PERIOD = 10.0
SECOND = 10**9

TARGETS = (
    (59.6104, -52.6939, 59.9352, -52.7611),
    (57.7699, -59.1922, 58.0822, -58.7635),
    (60.7648, -55.7620, 60.8607, -56.3676),
    (57.7025, -54.7059, 57.3769, -54.7036),
    (59.4254, -54.4498, 59.7284, -54.5691),
    (59.1483, -51.2977, 59.4869, -51.3718),
    (58.8561, -58.4840, 58.6288, -58.4950),
    (59.8310, -58.3974, 59.6367, -58.0819),
    (59.5306, -53.1629, 59.5036, -53.5418),
    (58.8028, -54.3803, 58.6656, -53.5222),
    (57.8132, -52.6504, 57.6760, -51.8147),
    (57.4636, -58.9469, 57.5906, -59.8504),
    (57.2096, -52.6824, 57.7325, -52.5499),
    (59.9093, -56.8477, 59.8108, -57.9123),
    (57.5181, -56.2302, 58.1104, -56.6123),
    (58.3548, -56.4447, 58.0948, -56.8321),
    (57.8268, -49.5721, 57.5500, -50.3705),
    (60.2969, -49.9242, 60.6296, -49.3978),
    (57.6451, -59.8337, 57.9880, -59.1956),
    (60.6533, -51.4683, 61.1832, -51.9363),
)
"""Initial and final latitude and longitude of targets 1 to 20, degrees (Sharma, Table 3)."""

RADARS = {
    "radar1": Enu(59.7138694, -55.2676093, 0.0),
    "radar2": Enu(57.5399008, -57.6551522, 0.0),
    "radar3": Enu(56.6320564, -52.1042720, 0.0),
}
"""The radars' places and tracking frames (Sharma, Table 3)."""


@dataclass(frozen=True, slots=True)
class Radar:
    """What the radars have in common. sigma_range m; sigma_azimuth rad; field_of_view m; period s between
    scans; clutter: mean number of false returns in a scan; births: mean number of targets that a local
    tracker expects to see for the first time in a scan."""

    sigma_range: float = 100.0
    sigma_azimuth: float = 3e-3
    detection: float = 0.9
    field_of_view: float = 300e3
    period: float = 5.0
    clutter: float = 400.0
    births: float = 1.0

    def per_unit(self, number: float) -> float:
        """`number` per scan as an intensity in range and azimuth, 1/(m rad)."""
        return number / (self.field_of_view * 2 * math.pi)


RADAR = Radar()
TRACKER = TrackerConfig(
    motion=Motion("cv", 0.02),
    survival=0.999,
    sigma_speed=120.0,
    confirm=0.98,
    drop=0.1,
    drop_tentative=1e-3,
    max_sigma=5e3,
    merge=4.0,
)
MODES = Modes(intensities=(0.02, 10.0), sojourns=(120.0, 20.0))
PHD = PhdConfig(TRACKER.motion, TRACKER.survival, TRACKER.sigma_speed)
PHD_BIRTHS = 0.25
"""As `Radar.births`, for the GM-PHD, whose mass is directly that much too large where no target appears."""
TRACKERS = {
    "ckf": "a CKF for each track",
    "imm": "an IMM for each track, its two modes published as a mixture",
    "gm-phd": "a GM-PHD filter, its intensity published instead of tracks",
}
"""The local trackers a radar can have."""

PARAMETERS = (
    Parameter("targets, radars", "20, 3", "Sharma, Table 3"),
    Parameter("field of view", f"{RADAR.field_of_view / 1e3:g} km", "Sharma, Fig. 8a, chosen: no radar sees target 18"),
    Parameter("tracks sent every", f"{REPORT_PERIOD:g} s", "Sharma 6.4.1"),
    Parameter("height of targets and radars", "0 m", "chosen: Table 3 has none"),
    Parameter("duration", f"{DURATION:g} s", "chosen: 75-240 m/s"),
    Parameter("start", "2026-01-01T00:00:00Z", "chosen"),
    Parameter("scan period", f"{RADAR.period:g} s", "chosen"),
    Parameter("range noise, 1 sigma", f"{RADAR.sigma_range:g} m", "chosen"),
    Parameter("azimuth noise, 1 sigma", f"{RADAR.sigma_azimuth * 1e3:g} mrad", "chosen"),
    Parameter("detection probability", f"{RADAR.detection:g}", "chosen"),
    Parameter("false returns per scan", f"{RADAR.clutter:g}, Poisson, uniform in range and azimuth", "chosen"),
    Parameter("process noise intensity", f"{TRACKER.motion.q:g} m2/s3", "chosen"),
    Parameter("IMM: process noise intensities", " and ".join(f"{q:g} m2/s3" for q in MODES.intensities), "chosen"),
    Parameter("IMM: mean time in each mode", " and ".join(f"{tau:g} s" for tau in MODES.sojourns), "chosen"),
    Parameter("GM-PHD: births per scan", f"{PHD_BIRTHS:g}", "chosen: 15 targets in 60 scans"),
    Parameter("GM-PHD: components", f"prune {PHD.prune:g}, merge {PHD.merge:g}, at most {PHD.cap}", "chosen"),
    Parameter("local tracker", f"CKF, joint IPDA, confirmed at existence {TRACKER.confirm:g}", "PDA: Sharma 6.4.1"),
)


def true_states(times: Floats) -> Floats:
    """x, y, z, vx, vy, vz in ECEF, (K, 20, 6), of all targets at `times` (K,), seconds from the start."""

    def places(t: Floats) -> Floats:
        share = (t / DURATION)[:, None]
        ends = np.array(TARGETS)
        first = np.stack(geodesy.geodetic_to_ecef(ends[:, 0], ends[:, 1], 0.0))
        last = np.stack(geodesy.geodetic_to_ecef(ends[:, 2], ends[:, 3], 0.0))
        chord = first[:, None] * (1 - share) + last[:, None] * share
        lat, lon, _ = geodesy.ecef_to_geodetic(*chord)
        return np.stack(geodesy.geodetic_to_ecef(lat, lon, 0.0), axis=-1)

    return np.concatenate([places(times), (places(times + 0.5) - places(times - 0.5))], axis=-1)


def _in_frame(states: Floats, frame: Enu) -> Floats:
    """States (..., 6) in ECEF, moved to `frame`."""
    zeros = np.zeros((*states.shape, 6))
    return geodesy.transform(states, zeros, ("x", "y", "z", "vx", "vy", "vz"), Ecef(), frame)[0]


def scan(radar: Radar, places: Floats, rng: np.random.Generator) -> Floats:
    """One scan's returns (2, M), range and azimuth in random order, of targets at `places` (2, N) in the
    radar's plane: those in the field of view, seen by chance and with noise, and clutter."""
    model = RangeAzimuth(radar.sigma_range, radar.sigma_azimuth)
    seen = (np.hypot(*places) < radar.field_of_view) & (rng.random(places.shape[1]) < radar.detection)
    noise = rng.standard_normal((2, int(seen.sum()))) * [[radar.sigma_range], [radar.sigma_azimuth]]
    false = rng.random((2, rng.poisson(radar.clutter))) * [[radar.field_of_view], [2 * math.pi]] - [[0], [math.pi]]
    returns = np.concatenate([model.observe(places[:, seen]) + noise, false], axis=1)
    returns[1] = (returns[1] + math.pi) % (2 * math.pi) - math.pi
    return rng.permutation(returns, axis=1)


def radar_events(
    name: str, seed: int = 0, radar: Radar = RADAR, config: TrackerConfig = TRACKER, tracker: str = "ckf"
) -> Iterator[Event]:
    """What radar `name` says: its info, then its tracks or intensity every `REPORT_PERIOD`, by one of `TRACKERS`. The
    seed is that of its noise."""
    frame = RADARS[name]
    rng = np.random.default_rng([seed, list(RADARS).index(name)])
    times = np.arange(0.0, DURATION + radar.period / 2, radar.period)
    places = _in_frame(true_states(times), frame)[..., :2]
    model = RangeAzimuth(radar.sigma_range, radar.sigma_azimuth)
    phd, births = GmPhdFilter(PHD), PHD_BIRTHS if tracker == "gm-phd" else radar.births
    local = ImmTracker(config, MODES) if tracker == "imm" else LocalTracker(config)

    def detection(place: Floats) -> Floats:
        return np.where(np.hypot(place[0], place[1]) < radar.field_of_view, radar.detection, 0.0)

    info = {
        "frame": frame,
        "position": (0.0, 0.0, 0.0),
        "period": REPORT_PERIOD,
        "motion": MODES.motion() if tracker == "imm" else config.motion,
        "coverage": Disk(radar.field_of_view),
        "detection_probability": radar.detection,
        "initiation_delay": 3 * radar.period + REPORT_PERIOD,
    }
    yield Event(START, "info", info)
    for t, at in zip(times, places, strict=True):
        time = START + round(t * SECOND)
        returns = scan(radar, at.T, rng)
        clutter, birth = (np.full(returns.shape[1], radar.per_unit(number)) for number in (radar.clutter, births))
        (phd if tracker == "gm-phd" else local).step(time, returns, model, clutter, birth, detection)
        if t % REPORT_PERIOD == 0:
            where = {"frame": frame, "height": Height(0.0, 0.0)}
            if tracker == "gm-phd":
                yield Event(time, "intensity", where | phd.report())
            else:
                yield Event(time, "tracks", where | local.report().fields())


def truth_events(period: float = RADAR.period) -> Iterator[Event]:
    """Where all targets are, every `period` s, in radar 1's frame (the fusion centre's place in Sharma 6.4)."""
    frame = RADARS["radar1"]
    times = np.arange(0.0, DURATION + period / 2, period)
    for t, states in zip(times, _in_frame(true_states(times), frame), strict=True):
        yield Event(
            START + round(t * SECOND),
            "truth",
            {
                "space": ("x", "y", "z", "vx", "vy", "vz"),
                "frame": frame,
                "ids": np.arange(1, len(TARGETS) + 1, dtype=np.uint64),
                "means": states,
            },
        )


@lru_cache
def three_radars(tracker: str = "ckf") -> Scenario:
    """The scenario as the command line knows it, each radar with one of `TRACKERS`."""
    return Scenario(
        name="three-radars",
        summary="three radars, twenty targets and heavy clutter over 300 s (Sharma 6.4)",
        start=START,
        duration=DURATION,
        origin="simulated",
        parameters=PARAMETERS,
        sensors={name: partial(radar_events, name, tracker=tracker) for name in RADARS},
        truth=truth_events,
    )
