"""Autoferry playback: the files' quirks, the local trackers in made-up harbours, and (with FUSION_DATA) the data."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

import schemas
from fusion_service.process import data_folder
from sensor_clients.filters.measurement import Floats
from sensor_clients.playback import autoferry
from sensor_clients.playback.autoferry_hulls import hulls
from sensor_clients.playback.following import ClutterMap
from sensor_clients.playback.harbour import LIDAR, RADAR, HarbourSensor, HarbourTracker, cluster

SECOND = 10**9


def record(sensor: int, time: float, measurement: Any) -> dict[str, Any]:
    return {
        "sensorID": sensor,
        "measurements": [],
        "ownshipPosition": [100.0, -50.0],
        "time": time,
        "measurement": measurement,
    }


@pytest.fixture
def data(tmp_path: Path) -> Path:
    detections = [
        record(1, 1000.5, [[1.0, 2.0, 3.0], [10.0, 20.0, 30.0]]),
        record(4, 1000.2, 0.5),
        record(3, 1000.1, [0.1, 0.2, 0.3]),
        record(1, 1000.0, [1.0, 10.0]),
        record(2, 1000.0, []),
        record(1, 1001.0, []),
        record(2, 1002.0, [5.0, 6.0]),
    ]
    fixes = [
        [
            {"targetID": 1, "position": [0.0, 5.0, 0.0], "time": 999.0},
            {"targetID": 2, "position": [7, 8, 0], "time": 998},
        ],
        [
            {"targetID": 1, "position": [0.0, 5.0, 0.0], "time": 999.0},
            {"targetID": 2, "position": [7, 8, 0], "time": 1001},
        ],
        [{"targetID": 1, "position": [4.0, 9.0, 0.0], "time": 1003.0}],
    ]
    (tmp_path / "scenario2_detections.json").write_text(json.dumps(detections))
    (tmp_path / "scenario2_groundTruth.json").write_text(json.dumps(fixes))
    return tmp_path


def test_returns_come_out_in_time_east_first_and_from_piren(data: Path) -> None:
    scans = autoferry.read_scans(data / "scenario2_detections.json", 1)
    assert [scan.time for scan in scans] == [1000 * SECOND, 1000 * SECOND + SECOND // 2, 1001 * SECOND]
    assert [scan.own.tolist() for scan in scans] == [[-50.0, 100.0]] * 3
    assert scans[0].returns.tolist() == [[-40.0], [101.0]]
    assert scans[1].returns.tolist() == [[-40.0, -30.0, -20.0], [101.0, 102.0, 103.0]]
    assert scans[2].returns.shape == (2, 0)


def test_truth_is_complete_and_linear_between_fixes(data: Path) -> None:
    events = list(autoferry.load(data, 2).truth())
    assert [event.time for event in events] == [1000 * SECOND + k * SECOND // 5 for k in range(11)]
    assert events[0].fields["ids"].tolist() == [1, 2]
    np.testing.assert_allclose(events[0].fields["means"], [[6.0, 1.0], [8.0, 7.0]])
    # Target 2's fixes end at 1001 s.
    assert events[-1].fields["ids"].tolist() == [1]
    np.testing.assert_allclose(events[-1].fields["means"], [[8.0, 3.0]])


def test_what_a_sensor_says_can_be_sent(data: Path) -> None:
    events = list(autoferry.load(data, 2).sensors["lidar"](0))
    assert [event.kind for event in events] == ["info", "tracks", "tracks", "tracks"]
    header: dict[str, Any] = {"source": "lidar", "epoch": 1, "seq": 0, "sent": 1, "origin": "replay"}
    assert schemas.encode(schemas.SensorInfo(**header, **events[0].fields))
    for event in events[1:]:
        assert schemas.encode(schemas.LocalTracks(**header, time=event.time, **event.fields))


def test_info_follows_the_own_ship() -> None:
    scans = [autoferry.Scan(k * SECOND, np.array([0.4 * k, 0.0]), np.zeros((2, 0))) for k in range(10)]
    infos = [event for event in autoferry.sensor_events(LIDAR, scans) if event.kind == "info"]
    assert [round(info.fields["position"][0], 1) for info in infos] == [0.0, 1.2, 2.4, 3.6]


def test_clusters_are_chains_of_near_returns() -> None:
    returns = np.array([[0.0, 100.0, 8.0, 16.0, 101.0], [0.0, 0.0, 0.0, 0.0, 4.0]])
    centres = cluster(returns, 10.0)
    assert sorted(centres.T.tolist()) == [[8.0, 0.0], [100.5, 2.0]]
    assert cluster(returns[:, :0], 10.0).shape == (2, 0)
    np.testing.assert_array_equal(cluster(returns, 0.0), returns)


def test_clutter_map_learns_the_intensity_of_poisson_clutter() -> None:
    rng = np.random.default_rng(1)
    world = ClutterMap(prior=1e-4, sigma=20.0, scans=1.0)
    start = world.intensity(np.zeros((2, 1)))
    np.testing.assert_allclose(start, 1e-4)
    for _ in range(200):
        returns = rng.uniform([[0.0], [-200.0]], [[400.0], [200.0]], (2, rng.poisson(8)))
        world.learn(returns, np.ones(returns.shape[1]))
    there = world.intensity(np.array([[200.0], [0.0]]))
    # 8 per 160,000 m2; 200 scans, kernel of 4 pi 20^2 m2: 50 returns count, so 14 % of spread.
    np.testing.assert_allclose(there, 8 / 160_000, rtol=0.5)
    assert world.intensity(np.array([[-200.0], [0.0]]))[0] < 1e-5


def simulate(sensor: HarbourSensor, start: Floats, velocity: Floats, scans: int, seed: int) -> list[tuple[float, Any]]:
    """Tracks after each scan of objects on straight lines, seen `latency` late with the sensor's noise."""
    rng = np.random.default_rng(seed)
    tracker = HarbourTracker(sensor)
    own = np.zeros(2)
    out = []
    for k in range(scans):
        stamp = k * sensor.period
        place = start + velocity * (stamp - sensor.latency)
        sight = place / np.hypot(*place)
        across = np.hypot(sensor.sigma_cross, sensor.sigma_azimuth * np.hypot(*place))
        noise = rng.normal(size=place.shape) * [[sensor.sigma_range], [1.0]]
        noise[1] *= across
        seen = place - sensor.offset * sight + noise[0] * sight + noise[1] * np.stack([-sight[1], sight[0]])
        seen = seen[:, rng.random(place.shape[1]) < 0.9]
        time = round(stamp * SECOND)
        tracker.step(time, own, seen)
        out.append((stamp, tracker.report(time)))
    return out


@pytest.mark.parametrize("sensor", [LIDAR, RADAR], ids=["lidar", "radar"])
def test_a_vessel_is_tracked_where_it_is_now(sensor: HarbourSensor) -> None:
    """60 s of one vessel at 4 m/s: the latency (up to 9 m of way) is made up for, the errors fit the covariance."""
    start, velocity = np.array([[80.0], [-60.0]]), np.array([[-1.0], [4.0]])
    scans = round(60 / sensor.period)
    nees = []
    for seed in range(10):
        history = simulate(sensor, start, velocity, scans, seed)
        ids = set()
        for stamp, report in history[scans // 2 :]:
            assert len(report.ids) == 1, f"seed {seed}, {stamp} s"
            ids.add(int(report.ids[0]))
            error = report.means[0, :2] - (start + velocity * stamp)[:, 0]
            nees.append(error @ np.linalg.solve(report.covariances[0, :2, :2], error))
        assert len(ids) == 1
    # Ten runs, errors correlated over some 10 s: about 30 independent values of mean 2 or less (q is not 0 here).
    assert 0.4 < np.mean(nees) < 3.0


@pytest.mark.parametrize("sensor", [LIDAR, RADAR], ids=["lidar", "radar"])
def test_what_lies_still_is_not_reported(sensor: HarbourSensor) -> None:
    reports = 0
    for seed in range(5):
        history = simulate(sensor, np.array([[60.0], [50.0]]), np.zeros((2, 1)), round(100 / sensor.period), seed)
        reports += sum(len(report.ids) for _, report in history)
    assert reports <= 0.05 * 5 * 100 / sensor.period


def gospa(tracks: Floats, truth: Floats, c: float = 20.0) -> float:
    """alpha = p = 2: sqrt(min sum d^2 + c^2 / 2 per object left over)."""
    squared = np.sum((tracks[:, None] - truth[None]) ** 2, axis=-1)
    rows, columns = linear_sum_assignment(np.minimum(squared, c**2))
    return math.sqrt(np.minimum(squared, c**2)[rows, columns].sum() + abs(len(tracks) - len(truth)) * c**2 / 2)


@pytest.mark.skipif("FUSION_DATA" not in os.environ, reason="needs the Autoferry files: set FUSION_DATA")
@pytest.mark.parametrize("number", [2, *(pytest.param(one, marks=pytest.mark.slow) for one in (3, 5, 13)), 16])
def test_real_scenes_score_better_than_no_tracks_at_all(number: int) -> None:
    """Two missed vessels cost 20 m; each sensor alone stays below that on every scene."""
    scenario = autoferry.load(data_folder("autoferry") or Path(), number)
    truth = [(event.time, event.fields["means"]) for event in scenario.truth()]
    times = np.array([time for time, _ in truth])
    for events in (scenario.sensors["lidar"], scenario.sensors["radar"]):
        scores = [
            gospa(event.fields["means"][:, :2], truth[min(int(np.searchsorted(times, event.time)), len(truth) - 1)][1])
            for event in events(0)
            if event.kind == "tracks"
        ]
        assert np.mean(scores) < 18.0


def test_a_hull_lies_along_the_course_and_keeps_it_while_the_vessel_lies_still() -> None:
    """North-east at 2 m/s for 30 s, then still."""
    times = np.arange(0.0, 60.0, 0.5)
    places = np.minimum(times, 30.0)[:, None] * np.sqrt(2.0)
    found = hulls(2, times, np.tile(places, (1, 2)), np.array([-5.0, 10.0, 55.0]))
    np.testing.assert_allclose(found, [[36.25, 9.6, np.pi / 4]] * 3)
    jet = hulls(2, times + 1_620_200_000.0, np.tile(places, (1, 2)), times[:1] + 1_620_200_000.0)
    assert jet[0, 0] < 10.0
    still = hulls(1, times, np.zeros((len(times), 2)), times[:2])
    assert np.isnan(still[:, 2]).all()
    assert np.isfinite(still[:, :2]).all()
    assert np.isnan(hulls(7, times, np.zeros((len(times), 2)), times[:2])).all()
    assert hulls(1, times, np.zeros((len(times), 2)), times[:0]).shape == (0, 3)
