"""The traffic radar's playback: axes, times, repeated fixes, and files that cannot be read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from schemas import Enu
from sensor_clients.playback import radar_v2x

RADAR = """time,id,x,y,vx,vy,length
10.000,5,100.0,0.0,-10.0,0.0,4.4
10.000,2,0.0,50.0,0.0,3.0,4.4
10.051,2,0.0,50.0,0.0,3.0,4.4
"""
VEHICLE = """received,stamp,lat,lon,heading,speed,rms_lat,rms_lon
10.195,10.000,29.6225956,-82.3867591,90.0000,12.00,0.03,2.03
10.245,10.000,29.6225956,-82.3867591,90.0000,12.00,0.03,2.03
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "radar.csv").write_text(RADAR)
    (tmp_path / "vehicle1.csv").write_text(VEHICLE)
    return tmp_path


def test_the_radar_looks_to_the_left_of_north(folder: Path) -> None:
    first, second = radar_v2x.read_radar(folder / "radar.csv", latency=0.25)
    assert (first.id.tolist(), second.id.tolist()) == ([2, 5], [2])
    assert second.time - first.time == 51_000_000
    assert first.received - first.time == 250_000_000
    bearing = np.degrees(np.arctan2(first.mean[:, 0], first.mean[:, 1]))
    np.testing.assert_allclose(bearing, [-93.6, -3.6], atol=1e-9)
    np.testing.assert_allclose(np.hypot(*first.mean[:, :2].T), [50.0, 100.0])
    np.testing.assert_allclose(np.degrees(np.arctan2(first.mean[:, 2], first.mean[:, 3])), [-93.6, 176.4], atol=1e-9)
    along = first.mean[1, :2] / 100.0
    assert along @ first.covariance[1, 2:, 2:] @ along == pytest.approx(0.25)


def test_a_fix_is_told_as_often_as_it_was_sent(folder: Path) -> None:
    reports = radar_v2x.read_vehicle(folder / "vehicle1.csv")
    assert [one.received - one.time for one in reports] == [195_000_000, 245_000_000]
    assert reports[0].time == reports[1].time
    np.testing.assert_allclose(reports[0].mean, [[0.0, 100.0, 12.0, 0.0]], atol=0.05)  # 0.0009025 degrees north
    np.testing.assert_allclose(np.diag(reports[0].covariance[0]), [2.03**2, 1.0, 0.09, 0.09])


def test_as_a_scenario(folder: Path) -> None:
    scenario = radar_v2x.load(folder)
    assert (list(scenario.sensors), scenario.origin) == (["radar", "vehicle1"], "replay")
    events = list(scenario.sensors["vehicle1"](0))
    assert [event.kind for event in events] == ["info", "tracks", "tracks"]
    assert isinstance(events[0].fields["frame"], Enu)
    assert events[1].fields["updated"].tolist() == [events[1].time]
    assert not list(scenario.truth())


def test_the_folder_is_given_or_one_above_it(folder: Path) -> None:
    assert radar_v2x.find(folder) == folder
    below = folder / "radar-v2x"
    below.mkdir()
    assert radar_v2x.find(folder) == folder, "nothing is in it"
    (below / "radar.csv").write_text(RADAR)
    assert radar_v2x.find(folder) == below


def test_what_cannot_be_read_is_said_with_its_line(folder: Path) -> None:
    (folder / "radar.csv").write_text(RADAR + "10.1,2,here,0,0,0,0\n")
    with pytest.raises(ValueError, match=r"radar\.csv:5: cannot be read"):
        radar_v2x.load(folder)
    (folder / "radar.csv").write_text(RADAR.replace("50.0", "nan", 1))
    with pytest.raises(ValueError, match=r"radar\.csv:3: not a finite number"):
        radar_v2x.load(folder)
    (folder / "radar.csv").write_text("time,id\n")
    with pytest.raises(ValueError, match="no rows"):
        radar_v2x.load(folder)
    (folder / "radar.csv").unlink()
    with pytest.raises(FileNotFoundError):
        radar_v2x.load(folder)
