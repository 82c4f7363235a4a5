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


def odds(r: float) -> float:
    return r / (1 - r)


def test_a_detection_of_a_source_without_an_opinion_is_evidence_by_bayes() -> None:
    """Detection probability .9 (usual) against a tenth of false reports: each new datum multiplies the odds by 9."""
    made = centre(("r1", "r2"))
    states = truth(3)
    give(made, tracks("r1", 1, states), tracks("r2", 1, states, existence=np.array([0.5, 0.6, 0.7])))
    said = [9 * odds(r) for r in (0.5, 0.6, 0.7)]
    assert sorted(step(made, 1).tracks.existence) == pytest.approx([o / (1 + o) for o in said])
    give(made, tracks("r1", 2, moved(states, 1), sigma=SIGMA), tracks("r2", 2, np.zeros((0, 4))))
    assert sorted(step(made, 2).tracks.existence) == pytest.approx([9 * o / (1 + 9 * o) for o in said])
    assert made.config.frame is None
    assert step(made, 3).tracks.frame == FRAME


def test_a_repeated_opinion_is_one_and_silence_wears_it_down() -> None:
    made = centre(("r1",), survival=0.9, coast=20.0)
    for second in (1, 2, 3):
        give(made, tracks("r1", second, SPOT, existence=np.array([0.8])))
        assert step(made, second).tracks.existence[0] == pytest.approx(0.8)
    for k in (1, 2, 3):
        assert step(made, 3 + k).tracks.existence[0] == pytest.approx(0.8 * 0.9**k)


def test_a_blind_source_wears_nothing_down_that_others_hold_and_is_forgiven() -> None:
    made = centre(("r1", "r3"))
    give(made, watcher(1e4))
    for second in range(1, 30):
        give(made, tracks("r1", second, SPOT), tracks("r3", second, SPOT), tracks("r2", second, np.zeros((0, 4))))
        existence = step(made, second).tracks.existence[0]
    assert existence > 0.4
    for second in range(30, 36):
        give(made, tracks("r1", second, SPOT), tracks("r3", second, SPOT), tracks("r2", second, SPOT))
        existence = step(made, second).tracks.existence[0]
    assert existence > 0.999


def test_initiation_delay_counts_from_entry_into_coverage() -> None:
    """A target outside the disk for ten seconds, then inside: two seconds pass before its absence says anything."""
    made = centre(("r1",))
    give(made, watcher(1e4, initiation_delay=2.0))
    place = 20_000.0
    seen = {}
    for second in range(1, 16):
        place = 20_000.0 if second < 10 else 5_000.0 if second == 10 else place
        give(made, tracks("r1", second, [[place, 0, 0, 0]], [second // 10 + 1], existence=np.array([0.8])))
        give(made, tracks("r2", second, np.zeros((0, 4))))
        picture = step(made, second).tracks
        row = int(np.argmin(np.abs(picture.means[:, 0] - place)))
        seen[second] = float(picture.existence[row])
    assert [seen[k] for k in range(1, 12)] == pytest.approx([0.8] * 11)
    assert seen[12] == pytest.approx(0.4 / 1.4)
    assert seen[13] < 0.05


@pytest.mark.parametrize("seed", [2])
def test_of_tracks_reported_at_some_existence_so_many_exist(seed: int) -> None:
    """Two sensors of known detection probability and false reports; short-lived, so that every value occurs."""
    rng = np.random.default_rng(seed)
    p, false = 0.6, 0.15
    said, real = [], []
    for _ in range(100):
        made = centre((), birth_existence=0.3, survival=1.0, coast=100.0, confirm_within=60,
                      source_defaults={"false_track": false})  # fmt: skip
        for name in ("r1", "r2"):
            give(made, info(name, coverage=schemas.Disk(1e6), detection_probability=p))
        exists = rng.random(20) < 0.3
        places = np.column_stack([np.arange(20) * 1000.0, np.zeros((20, 3))])
        for second in range(1, 1 + int(rng.integers(1, 5))):
            for name in ("r1", "r2"):
                shown = rng.random(20) < np.where(exists, p, false)
                if second == 1 and name == "r1":
                    start = shown
                chosen = np.flatnonzero(shown & start)
                give(made, tracks(name, second, places[chosen], chosen + 1))
            picture = step(made, second).tracks
        for row, place in zip(picture.existence, picture.means[:, 0], strict=True):
            said.append(float(row))
            real.append(bool(exists[round(place / 1000.0)]))
    told, true = np.array(said), np.array(real)
    for low in np.arange(0.0, 1.0, 0.2):
        some = (told >= low) & (told < low + 0.2)
        if some.sum() >= 66:
            error = np.sqrt(0.25 / some.sum())
            assert abs(told[some].mean() - true[some].mean()) < 0.1 + 2 * error, (seed, low, int(some.sum()))
    assert len(told) > 500
