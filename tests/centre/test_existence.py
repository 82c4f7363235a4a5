"""Existence in the centre: fused from those who report it, lowered by those who look and see nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre
from schemas.messages import CONFIRMED, TENTATIVE
from tests.centre.worlds import FRAME, SIGMA, centre, give, info, moved, step, tracks, truth

SPOT = [[0.0, 0.0, 0.0, 0.0]]


def pair(method: str, aspect: float) -> float:
    """Two sources say 0.8 of one target; their covariances differ by `aspect` in opposite directions."""
    made = centre(("r1", "r2"), existence=method)
    for name, sigma in (("r1", [1.0, aspect, 1.0, aspect]), ("r2", [aspect, 1.0, aspect, 1.0])):
        give(made, tracks(name, 1, SPOT, existence=np.array([0.8]), sigma=10.0 * np.array(sigma)))
    picture = step(made, 1).tracks
    assert picture.contributor_counts.tolist() == [2]
    return float(picture.existence[0])


@pytest.mark.parametrize("aspect", [1.0, 5.0, 30.0])
def test_two_that_agree_on_existence_are_believed_however_they_see_it(aspect: float) -> None:
    assert pair("consistent", aspect) == pytest.approx(0.8, abs=1e-12)
    assert pair("average", aspect) == pytest.approx(0.8, abs=1e-12)


def test_the_exponential_mixture_loses_the_target() -> None:
    assert pair("geometric", 1.0) == pytest.approx(0.8)
    assert pair("geometric", 30.0) < 0.5
    aspect = 7.0
    first = np.diag([1, aspect, 1, aspect]) ** 2
    second = np.diag([aspect, 1, aspect, 1]) ** 2
    mean = np.linalg.inv(0.5 * np.linalg.inv(first) + 0.5 * np.linalg.inv(second))
    z = np.sqrt(np.linalg.det(mean)) / (np.linalg.det(first) * np.linalg.det(second)) ** 0.25
    assert pair("geometric", aspect) == pytest.approx(0.8 * z / (0.2 + 0.8 * z), rel=1e-9)


def watcher(radius: float, **changes: Any) -> schemas.SensorInfo:
    return info("r2", coverage=schemas.Disk(radius), detection_probability=0.9, **changes)


def seen_by_one(watch: schemas.SensorInfo, scans: int, *, complete: bool = True, **config: object) -> FusionCentre:
    made = FusionCentre({"lateness": 3.0, **config})
    give(made, info("r1"), watch)
    give(made, tracks("r1", 1, SPOT, existence=np.array([0.8])))
    for k in range(scans):
        give(made, tracks("r2", 1 - k / 10, np.zeros((0, 4)), seq=10 - k, complete=complete))
    return made


@pytest.mark.parametrize("scans", [1, 3])
def test_a_source_that_looks_and_sees_nothing_lowers_it_once_per_scan(scans: int) -> None:
    r = 0.8
    for _ in range(scans):
        r = r * (1 - 0.9) / (1 - r * 0.9)
    assert step(seen_by_one(watcher(1e4), scans), 1).tracks.existence[0] == pytest.approx(r)


def test_who_does_not_look_there_or_not_yet_or_only_partly_lowers_nothing() -> None:
    assert step(seen_by_one(watcher(1e4), 0), 1).tracks.existence[0] == pytest.approx(0.8)
    assert step(seen_by_one(watcher(1e4), 1, complete=False), 1).tracks.existence[0] == pytest.approx(0.8)
    assert step(seen_by_one(watcher(1e4, initiation_delay=5.0), 1), 1).tracks.existence[0] == pytest.approx(0.8)
    elsewhere = watcher(1e4, position=(5e4, 0.0, 0.0))
    assert step(seen_by_one(elsewhere, 1), 1).tracks.existence[0] == pytest.approx(0.8)


def test_a_weak_track_is_not_shown_and_comes_back() -> None:
    made = seen_by_one(watcher(1e4), 1, min_existence=0.5)
    assert step(made, 1).tracks.status.tolist() == [TENTATIVE]
    give(made, tracks("r1", 2, SPOT, existence=np.array([0.9])), tracks("r2", 2, SPOT, existence=np.array([0.9])))
    strong = step(made, 2).tracks
    assert strong.status.tolist() == [CONFIRMED]
    ids = strong.ids.tolist()
    give(made, tracks("r1", 3, SPOT, existence=np.array([0.6])), tracks("r2", 3, np.zeros((0, 4)), seq=20))
    weak = step(made, 3).tracks
    assert (weak.status.tolist(), weak.ids.tolist()) == ([TENTATIVE], ids)
    give(made, tracks("r1", 4, np.zeros((0, 4)), seq=30), tracks("r2", 4, np.zeros((0, 4)), seq=30))
    assert len(step(made, 4).tracks.ids) == 0


def test_sources_without_an_opinion_leave_it_alone() -> None:
    made = centre(("r1", "r2"))
    states = truth(3)
    give(made, tracks("r1", 1, states), tracks("r2", 1, states, existence=np.array([0.5, 0.6, 0.7])))
    assert sorted(step(made, 1).tracks.existence) == pytest.approx([0.5, 0.6, 0.7])
    give(made, tracks("r1", 2, moved(states, 1), sigma=SIGMA), tracks("r2", 2, np.zeros((0, 4))))
    assert sorted(step(made, 2).tracks.existence) == pytest.approx([0.5, 0.6, 0.7])
    assert made.config.frame is None
    assert step(made, 3).tracks.frame == FRAME
