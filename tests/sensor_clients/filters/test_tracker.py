"""The local tracker: it starts, holds and ends tracks as its probabilities promise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from schemas import Motion
from sensor_clients.filters import LocalTracker, Position, TrackerConfig
from sensor_clients.filters.measurement import Floats

SECOND = 10**9
SIDE, CLUTTER, DETECTION = 1000.0, 20.0, 0.9
CONFIG = TrackerConfig(
    motion=Motion("cv", 0.1), survival=0.999, sigma_speed=10.0, confirm=0.98, drop=0.1, drop_tentative=1e-3
)
MODEL = Position(5.0, 5.0)


def inside(place: Floats) -> Floats:
    return np.where((np.abs(place) < SIDE).all(axis=0), DETECTION, 0.0)


def scan(rng: np.random.Generator, targets: Floats) -> Floats:
    seen = targets[:, rng.random(targets.shape[1]) < DETECTION]
    false = rng.uniform(-SIDE, SIDE, (2, rng.poisson(CLUTTER)))
    return rng.permutation(np.concatenate([seen + 5.0 * rng.normal(size=seen.shape), false], axis=1), axis=1)


def step(tracker: LocalTracker, second: int, returns: Floats) -> None:
    per_area = np.full(returns.shape[1], 1 / (2 * SIDE) ** 2)
    tracker.step(second * SECOND, returns, MODEL, CLUTTER * per_area, 0.1 * per_area, inside)


def test_targets_are_found_held_and_let_go() -> None:
    rng = np.random.default_rng(1)
    tracker = LocalTracker(CONFIG)
    velocity = np.array([[8.0, -8.0, 0.0], [0.0, 5.0, -9.0]])
    start = np.array([[-200.0, 300.0, 0.0], [0.0, -300.0, 400.0]])
    held: set[int] = set()
    for second in range(60):
        targets = start + velocity * second
        step(tracker, second, scan(rng, targets if second < 40 else targets[:, :0]))
        report = tracker.report()
        if 8 <= second < 40:
            assert len(report.ids) == 3
            gap = np.abs(report.means[:, None, :2] - targets.T[None]).max(axis=-1)
            assert sorted(gap.argmin(axis=1)) == [0, 1, 2]
            assert gap.min(axis=1).max() < 25
            held |= set(report.ids.tolist())
    assert len(held) == 3, "a target changed its id"
    assert len(tracker.report().ids) == 0


def test_false_tracks_are_as_rare_as_confirm_says() -> None:
    """Clutter alone: with existence calibrated, at most a share 1 - confirm of what starts and is confirmed
    is false, and births come at .1 per scan: over 2,000 scans at most 2000 * .1 * .02 = 4 on average."""
    rng = np.random.default_rng(2)
    tracker = LocalTracker(CONFIG)
    ids: set[int] = set()
    for second in range(2000):
        step(tracker, second, scan(rng, np.zeros((2, 0))))
        ids |= set(tracker.report().ids.tolist())
    assert len(ids) <= 10, "P < .003 for a mean of 4"


def test_tracks_end_outside_the_field_of_view() -> None:
    config = TrackerConfig(motion=Motion("cv", 0.1), survival=1.0, sigma_speed=10.0, drop=0.0, drop_tentative=0.0)
    tracker = LocalTracker(config)
    for second in range(8):
        step(tracker, second, np.array([[900.0 + 12 * second], [0.0]]))
        assert 1 in tracker.ids, "nothing else ends it"
    for second in range(8, 12):
        step(tracker, second, np.zeros((2, 0)))
    assert 1 not in tracker.ids


def test_a_duplicate_ends() -> None:
    config = TrackerConfig(motion=Motion("cv", 0.1), survival=1.0, sigma_speed=10.0, merge=9.0, drop_tentative=0.0)
    tracker = LocalTracker(config)
    twice = np.array([[0.0, 1.0, 500.0], [0.0, 0.0, 0.0]])
    step(tracker, 0, twice)
    assert tracker.ids.tolist() == [1, 2, 3]
    step(tracker, 1, np.zeros((2, 0)))
    assert tracker.ids.tolist() == [1, 3], "the elder stays"


def test_two_are_one_along_a_hull_and_two_abeam() -> None:
    """Moving east at 10 m/s, 25 m apart: in line they are bow and stern of 36 m, abeam two boats."""
    config = TrackerConfig(*(Motion("cv", 0.1), 1.0, 10.0), merge=4.0, hull=(36.0, 10.0), drop_tentative=0.0)
    for apart, count in (([25.0, 0.0], 1), ([0.0, 25.0], 2)):
        tracker = LocalTracker(config)
        for second in range(6):
            place = np.array([[10.0 * second], [0.0]])
            step(tracker, second, np.concatenate([place, place + np.array(apart)[:, None]], axis=1))
        assert (tracker.existence > 0.5).sum() == count


def test_what_is_hidden_proves_nothing_until_it_comes_out() -> None:
    """Seen all along, hidden for 20 s: reported soon after, and not for the way that it made before."""
    config = replace(CONFIG, min_way=20.0)
    tracker, first = LocalTracker(config), 0
    for second in range(40):
        place = np.array([[10.0 * second], [0.0]])
        area = np.full(1, 1 / (2 * SIDE) ** 2)
        tracker.step(second * SECOND, place, MODEL, CLUTTER * area, area, inside, lambda at: at[0] < 200.0)
        if not first and len(tracker.report().ids):
            first = second
    assert 22 <= first <= 26
    for second in range(40, 50):  # and goes on where it is hidden again
        place = np.array([[10.0 * second], [0.0]])
        area = np.full(1, 1 / (2 * SIDE) ** 2)
        tracker.step(second * SECOND, place, MODEL, CLUTTER * area, area, inside, lambda at: at[0] > 0.0)
        assert tracker.report().ids.tolist() == [1]


def test_ids_are_never_used_twice() -> None:
    rng = np.random.default_rng(3)
    tracker = LocalTracker(CONFIG)
    seen: set[int] = set()
    alive: set[int] = set()
    for second in range(50):
        step(tracker, second, scan(rng, np.zeros((2, 1))))
        now = set(tracker.ids.tolist())
        assert not (now - alive) & seen
        seen |= now
        alive = now


def test_time_never_runs_back() -> None:
    tracker = LocalTracker(CONFIG)
    step(tracker, 5, np.zeros((2, 1)))
    with pytest.raises(ValueError, match="back in time"):
        step(tracker, 4, np.zeros((2, 1)))


def test_an_empty_scan_and_no_tracks() -> None:
    tracker = LocalTracker(CONFIG)
    step(tracker, 0, np.zeros((2, 0)))
    report = tracker.report()
    assert report.ids.shape == (0,)
    assert report.means.shape == (0, 4)
    assert report.covariances.shape == (0, 4, 4)
