"""The cameras of Autoferry: their bearings in a made-up harbour and (with FUSION_DATA) in the data."""

from __future__ import annotations

import json
import math
import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service import densities
from fusion_service.bus import open_bus
from fusion_service.process import data_folder
from sensor_clients.events import Event
from sensor_clients.filters.measurement import Floats
from sensor_clients.playback import autoferry
from sensor_clients.playback.cameras import EO, IR, CameraSensor, CameraTracker
from sensor_clients.playback.following import ClutterMap
from tests.helpers.processes import Hub, Program, eventually

SECOND = 10**9
CAMERAS = {"ir": IR, "eo": EO}
DATA = pytest.mark.skipif("FUSION_DATA" not in os.environ, reason="needs the Autoferry files: set FUSION_DATA")


def wrap(angle: Floats) -> Floats:
    return np.asarray((angle + math.pi) % (2 * math.pi) - math.pi)


def bearings(event: Event, own: Floats) -> tuple[Floats, Floats]:
    """Bearing and its standard deviation (T,) of the tracks in an event, by the moments of their mixtures."""
    fields = event.fields
    mean, P = densities.moments(
        fields["means"][:, :2], fields["covariances"][:, :2, :2], fields["weights"], fields["counts"]
    )
    sight = mean - own
    across = np.stack([sight[:, 1], -sight[:, 0]], axis=-1) / np.sum(sight**2, axis=1)[:, None]
    return np.arctan2(*sight.T), np.sqrt(np.einsum("ta,tab,tb->t", across, P, across))


def test_bearings_are_read_in_every_form(tmp_path: Path) -> None:
    """One bare number, a list, none; rad from north, clockwise; the own ship in east, north."""
    common = {"measurements": [], "ownshipPosition": [100.0, -50.0]}
    records = [
        {"sensorID": 4, "time": 1000.4, "measurement": [0.1, -3.0, 2.0], **common},
        {"sensorID": 3, "time": 1000.1, "measurement": [0.3], **common},
        {"sensorID": 4, "time": 1000.2, "measurement": 0.5, **common},
        {"sensorID": 4, "time": 1000.6, "measurement": [], **common},
    ]
    path = tmp_path / "scenario2_detections.json"
    path.write_text(json.dumps(records))
    scans = autoferry.read_scans(path, 4)
    assert [scan.returns.tolist() for scan in scans] == [[[0.5]], [[0.1, -3.0, 2.0]], [[]]]
    assert all(scan.returns.shape[0] == 1 and scan.own.tolist() == [-50.0, 100.0] for scan in scans)


def test_the_clutter_map_goes_round() -> None:
    """5 false bearings per scan, uniform on the circle, are 5 / 2 pi per rad everywhere, at pi as well."""
    rng = np.random.default_rng(1)
    world = ClutterMap(prior=0.1, sigma=0.3, scans=1.0, angles=True)
    for _ in range(400):
        false = rng.uniform(-math.pi, math.pi, (1, rng.poisson(5)))
        world.learn(false, np.ones(false.shape[1]))
    # Some 340 bearings count at each place (a kernel of 2 sqrt(pi) 0.3 rad): 5 % of spread.
    np.testing.assert_allclose(world.intensity(np.array([[0.0, math.pi, -math.pi, 3.0]])), 5 / (2 * math.pi), rtol=0.25)


def frames(sensor: CameraSensor, rate: float, seconds: float, seed: int) -> list[autoferry.Scan]:
    """A vessel at 4 m/s passes 60 m off, seen `latency` late in 8 frames of 10, among three still objects (as the
    ship's heading sways they sway) and one false bearing in every second frame."""
    rng = np.random.default_rng(seed)
    scans = []
    for k in range(round(seconds * rate)):
        t = k / rate
        sway = 0.02 * math.sin(t / 3)
        vessel = math.atan2(-80.0 + 4.0 * (t - sensor.latency), 60.0)
        seen = [vessel + rng.normal() * 0.01] if rng.random() < 0.8 else []
        seen += [b + sway + rng.normal() * 0.005 for b in (-2.5, -0.5, 1.8) if rng.random() < 0.7]
        seen += list(rng.uniform(-math.pi, math.pi, rng.poisson(0.5)))
        scans.append(autoferry.Scan(round(t * SECOND), np.zeros(2), np.array([seen]).reshape(1, -1)))
    return scans


@pytest.mark.parametrize("name", list(CAMERAS))
def test_a_passing_vessel_is_tracked_and_what_stands_still_is_not(name: str) -> None:
    """Over five runs of 45 s: after 10 s it has a track in most messages, in the right direction at this moment, its
    mixture covers the true place, and there is less than one other track in five messages."""
    sensor = CAMERAS[name]
    held = messages = others = covered = 0
    errors = []
    for seed in range(5):
        for event in autoferry.sensor_events(sensor, frames(sensor, 10.0, 45.0, seed)):
            if event.kind == "info" or event.time < 10 * SECOND:
                continue
            place = np.array([-80.0 + 4e-9 * event.time, 60.0])
            angle, sigma = bearings(event, np.zeros(2))
            gap = np.abs(wrap(angle - math.atan2(*place)))
            near = gap < 0.1
            messages, others = messages + 1, others + int((~near).sum())
            if near.any():
                best = int(gap.argmin())
                held += 1
                errors.append(gap[best] / sigma[best])
                rows = np.repeat(np.arange(len(angle)), event.fields["counts"]) == best
                away = event.fields["means"][rows, :2] - place
                P = event.fields["covariances"][rows, :2, :2]
                distance = np.einsum("ca,cab,cb->c", away, np.linalg.inv(P), away)
                covered += bool((distance[event.fields["weights"][rows] > 0.02] < 9.0).any())
    assert messages == 5 * 70
    assert held / messages > 0.85
    assert others / messages < 0.2
    assert np.sqrt(np.mean(np.square(errors))) < 1.0, "its covariance has room for what lasts"
    assert covered / held > 0.95


def test_frames_are_used_at_the_period_and_only_then() -> None:
    for rate, expected in ((20.0, 90), (9.0, 90), (1.5, 68)):
        scans = frames(IR, rate, 45.0, 0)
        events = [event for event in autoferry.sensor_events(IR, scans) if event.kind == "tracks"]
        assert abs(len(events) - expected) <= 1
        assert all(b.time > a.time for a, b in pairwise(events))


def test_what_is_reported_has_the_lasting_errors_on_top() -> None:
    """Across the line of sight never less than they say, along it neither."""
    tracker = CameraTracker(EO)
    for scan in frames(EO, 2.0, 30.0, 1):
        tracker.step(scan.time, scan.own, scan.returns)
    report = tracker.report(30 * SECOND)
    assert len(report.means) > 1
    for mean, P in zip(report.means[:, :2], report.covariances[:, :2, :2], strict=True):
        r = np.hypot(*mean)
        sight, across = mean / r, np.array([mean[1], -mean[0]]) / r
        assert across @ P @ across > (r * EO.reference_bearing) ** 2 + EO.reference_cross**2
        assert sight @ P @ sight > (r * EO.reference_range) ** 2


@pytest.mark.parametrize("name", list(CAMERAS))
def test_what_a_camera_says_can_be_sent(name: str) -> None:
    events = list(autoferry.sensor_events(CAMERAS[name], frames(CAMERAS[name], 5.0, 30.0, 2)))
    header: dict[str, Any] = {"source": name, "epoch": 1, "seq": 0, "sent": 1, "origin": "replay"}
    info = schemas.SensorInfo(**header, **events[0].fields)
    assert schemas.decode(schemas.encode(info))
    assert not info.may_start, "no range, no start"
    assert info.correlation_group == "own-ship"
    assert isinstance(info.coverage, schemas.Disk)
    messages = [schemas.LocalTracks(**header, time=event.time, **event.fields) for event in events[1:]]
    assert all(schemas.decode(schemas.encode(message)) for message in messages)
    assert not any(codes.any() for codes in schemas.check_numbers(messages))
    assert max(message.counts.max(initial=0) for message in messages if message.counts is not None) > 1


def test_a_camera_of_a_recording_reaches_the_bus(hub: Hub, tmp_path: Path) -> None:
    """Made-up files, a real process: its mixtures arrive as the camera's tracker has them."""
    start = 1000
    common: dict[str, Any] = {"measurements": [], "ownshipPosition": [0.0, 0.0]}
    records: list[dict[str, Any]] = [{"sensorID": k, "time": start, "measurement": [], **common} for k in (1, 2)]
    for scan in frames(EO, 5.0, 30.0, 3):
        records.append(
            {"sensorID": 4, "time": start + scan.time / SECOND, "measurement": scan.returns[0].tolist(), **common}
        )
    fix = [{"targetID": 1, "position": [0.0, 60.0, 0.0], "time": float(start)}]
    (tmp_path / "scenario2_detections.json").write_text(json.dumps(records))
    (tmp_path / "scenario2_groundTruth.json").write_text(json.dumps([fix]))
    expected = list(autoferry.load(tmp_path, 2).sensors["eo"](0))
    assert "ir" not in autoferry.load(tmp_path, 2).sensors, "not in these files"
    heard: list[schemas.Message] = []
    main = "import sys; from sensor_clients.cli import main; sys.exit(main(sys.argv[1:]))"
    common_options = ("--sensor", "eo", "--data", str(tmp_path), "--connect", hub.endpoint, "--speed", "20")
    with open_bus([hub.endpoint], wait=60.0) as bus:
        bus.subscribe("**", lambda key, data: heard.append(schemas.decode(data)), history=8)
        with Program(main, "playback", "autoferry:2", *common_options) as camera:
            assert camera.end(20) == (0, "")
            eventually(lambda: len(heard) >= len(expected))
    last = [message for message in heard if isinstance(message, schemas.LocalTracks)][-1]
    assert last.time == expected[-1].time
    assert last.counts is not None
    assert last.counts.tolist() == expected[-1].fields["counts"].tolist() != []
    np.testing.assert_array_equal(last.means, expected[-1].fields["means"])
    assert any(isinstance(message, schemas.SensorInfo) and not message.may_start for message in heard)


@DATA
@pytest.mark.parametrize("number", [2, 3, 5, 13, 16])
@pytest.mark.parametrize("name", list(CAMERAS))
def test_the_bearings_of_the_data_are_clockwise_from_north(name: str, number: int) -> None:
    """A return lies within 0.06 rad of a vessel far more often so than counted the other way, or from another axis."""
    directory = data_folder("autoferry") or Path()
    scans = autoferry.read_scans(directory / f"scenario{number}_detections.json", CAMERAS[name].sensor_id)
    truth = autoferry.read_truth(directory / f"scenario{number}_groundTruth.json")
    hits = np.zeros(4)
    for scan in scans:
        for times, places in truth.values():
            sight = [np.interp(scan.time * 1e-9, times, places[:, k]) - scan.own[k] for k in range(2)]
            b = math.atan2(*sight)
            for k, other in enumerate((b, -b, math.pi / 2 - b, b + math.pi)):
                hits[k] += bool((np.abs(wrap(scan.returns - other)) < 0.06).any())
    assert hits[0] > 0.3 * len(scans)
    assert hits[0] > 1.5 * hits[1:].max()


@DATA
@pytest.mark.parametrize("scenes", [(2, 13), pytest.param((2, 3, 5, 13, 16), marks=pytest.mark.slow)], ids=len)
@pytest.mark.parametrize("name", list(CAMERAS))
def test_real_vessels_are_tracked_with_few_false_tracks(name: str, scenes: tuple[int, ...]) -> None:
    """Over two scenes, slowly all five: the vessels nearer than 250 m have a track in a third of the messages or more,
    false ones are fewer than those, and the error of bearing fits what is told of it."""
    tracked = wanted = false = 0
    errors = []
    for number in scenes:
        directory = data_folder("autoferry") or Path()
        scans = autoferry.read_scans(directory / f"scenario{number}_detections.json", CAMERAS[name].sensor_id)
        truth = autoferry.read_truth(directory / f"scenario{number}_groundTruth.json")
        own = {scan.time: scan.own for scan in scans}
        for event in autoferry.sensor_events(CAMERAS[name], scans):
            if event.kind == "info":
                continue
            angle, sigma = bearings(event, own[event.time])
            free = np.ones(len(angle), dtype=bool)
            for times, places in truth.values():
                sight = [np.interp(event.time * 1e-9, times, places[:, k]) - own[event.time][k] for k in range(2)]
                gap = np.abs(wrap(angle - math.atan2(*sight)))
                near = gap < 0.05 + 18.0 / math.hypot(*sight)
                inside = math.hypot(*sight) < 250
                wanted, tracked = wanted + inside, tracked + bool(inside and near.any())
                if near.any():
                    errors.append(gap.min() / sigma[gap.argmin()])
                free &= ~near
            false += int(free.sum())
    assert tracked / wanted > 0.33
    assert false < tracked
    assert 0.25 < np.mean(np.square(errors)) < 1.5
