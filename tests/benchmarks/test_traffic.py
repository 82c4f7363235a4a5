"""Lives of a traffic radar's numbers and what a picture did with them, on lives made by hand; and the recording."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from benchmarks.worlds import traffic
from benchmarks.worlds.traffic import Life, joins, lives_of, same_object
from sensor_clients.playback.radar_v2x import Report, read_radar

SECOND = 10**9
DATA = traffic.find(os.environ.get("FUSION_DATA"))


def life(number: int, begin: float, end: float, x: float, speed: float = 10.0) -> Life:
    """Along x, from x at `begin`, a scan every 0.05 s."""
    times = np.arange(begin, end, 0.05)
    place = x + speed * (times - begin)
    return Life(number, times, np.stack([place, 0 * place, speed + 0 * place, 0 * place], axis=1))


def reports(*lives: Life) -> list[Report]:
    """The scans of a radar that sees these."""
    out = []
    for k in range(round(max(one.times[-1] for one in lives) / 0.05) + 1):
        there = [(one, np.flatnonzero(np.round(one.times / 0.05) == k)) for one in lives]
        rows = [(one.number, one.states[at[0]]) for one, at in there if len(at)]
        rows.sort(key=lambda row: row[0])
        mean = np.array([state for _, state in rows]).reshape(-1, 4)
        time = round(k * 0.05 * SECOND)
        ids = np.array([number for number, _ in rows], dtype=np.uint64)
        out.append(Report(time, time, ids, mean, np.tile(np.eye(4), (len(rows), 1, 1))))
    return out


@pytest.mark.parametrize(
    ("second", "same"),
    [
        (life(1, 2.0, 4.0, 20.0), True),
        (life(1, 3.0, 5.0, 37.9), True),  # 1 s away: 5 m and 3 m more
        (life(1, 3.0, 5.0, 38.6), False),
        (life(1, 2.0, 4.0, 20.0, speed=14.0), False),
        (life(1, 3.0, 5.0, 30.0, speed=14.0), True),  # 3 m/s and 2 m/s more
        (life(1, 60.0, 65.0, 600.0), True),
        (life(1, 60.0, 65.0, 625.0), False),  # 5 s counted at most
        (life(2, 1.0, 4.0, 12.0), True),  # while the first is still there
        (life(2, 1.0, 4.0, 16.0), False),
    ],
)
def test_what_may_be_the_same_object(second: Life, same: bool) -> None:
    assert same_object(life(1, 0.0, 2.0, 0.0), second) == same


def test_lives_end_with_an_absence_or_a_jump() -> None:
    given = [
        life(3, 0.0, 2.0, 0.0),
        life(3, 2.5, 4.0, 25.0),  # half a second away, and as expected: the same life
        life(3, 4.3, 5.0, 200.0),  # .3 s away, and elsewhere
        life(3, 5.0, 6.0, 0.0),  # a jump from scan to scan
        life(3, 7.5, 8.0, 25.0),  # 1.5 s away
        life(8, 0.0, 8.0, 50.0),
    ]
    found = lives_of(reports(*given))
    assert [(one.number, round(float(one.times[0]), 2)) for one in found] == [
        (3, 0.0), (3, 4.3), (3, 5.0), (3, 7.5), (8, 0.0),
    ]  # fmt: skip


def test_wrong_joins_and_broken_lives() -> None:
    lives = [life(1, 0, 4, 0), life(1, 5, 9, 300), life(1, 9.5, 13, 345), life(2, 0, 6, 80), life(3, 6.1, 12, 400)]
    seen = [(t, {70: 1, 71: 2}) for t in (1.0, 2.0, 3.0)]  # 70: lives 0, then 1 elsewhere: one number; 71: life 3,
    seen += [(6.5, {70: 1, 71: 3}), (7.5, {72: 1, 71: 3})]  # then 4, another number and place; 72: life 1 again
    seen += [(10.0, {72: 1})]  # and life 2, the same object
    assert joins(seen, lives) == {
        "lives": 5, "ids": 3, "wrong": 2, "wrong_number": 1, "broken": 1, "extra": 1, "without": 0,
    }  # fmt: skip
    assert joins([], lives)["without"] == 5


def test_the_folder_is_found_or_not(tmp_path: Path) -> None:
    folder = tmp_path / "radar-v2x"
    assert traffic.find(None) is None
    assert traffic.find(tmp_path) is None
    folder.mkdir()
    (folder / "radar.csv").touch()
    assert traffic.find(tmp_path) == traffic.find(folder) == folder


@pytest.mark.skipif(DATA is None, reason="FUSION_DATA names no folder with radar-v2x")
def test_the_recording_has_its_lives() -> None:
    """166 by its own description: absences of more than a second. Here jumps within a second count too."""
    assert DATA is not None
    radar = read_radar(DATA / "radar.csv")
    assert len(radar) == 6161
    found = lives_of(radar)
    assert len({one.number for one in found}) == 64
    away = 0
    for number in range(64):
        times = np.concatenate([one.times for one in found if one.number == number])
        away += 1 + int((np.diff(np.sort(times)) > 1.03).sum())
    assert away == 166
    assert 166 <= len(found) < 200
