"""One row that stands for two objects: both tracks live, keep their ids, and are split again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre
from fusion_service.centre.blobs import HOLD, Blobs
from fusion_service.centre.lifecycle import newborn
from fusion_service.centre.rows import Rows
from fusion_service.centre.tracks import empty_tracks, unlinked
from schemas import STATUSES
from tests.centre.passing import CAMERA, LIDAR, MERGED, boats, passing
from tests.centre.worlds import START, centre, give, info, step, tracks

CONFIRMED = STATUSES.index("confirmed")


def errors(result: Any, truth: np.ndarray) -> list[float]:
    places = {int(track): mean[:2] for track, mean in zip(result.tracks.ids, result.tracks.means, strict=True)}
    return [float(np.hypot(*(places[k + 1] - truth[k, :2]))) for k in range(2)]


@pytest.mark.parametrize(("blob", "seed"), [(False, 1), (True, 1), (True, 2)])
def test_what_a_camera_tells_apart_stays_two(blob: bool, seed: int) -> None:
    passed = passing(camera=True, blob=blob, seed=seed)
    merged = [r for second, r in enumerate(passed.results, 1) if second in MERGED]
    assert len(merged) == 15
    for second, (result, truth) in enumerate(zip(passed.results, passed.truth, strict=True), 1):
        assert result.tracks.ids.tolist() == [1, 2], second
        assert not result.tracks.ended
        if second > 5:
            assert (result.tracks.status == CONFIRMED).all(), second
        if blob and second > 5:
            assert max(errors(result, truth)) < 6.0, second
            assert (result.tracks.existence > 0.99).all()
    assert max(errors(passed.results[-1], passed.truth[-1])) < 2.0
    counts = np.array([r.tracks.contributor_counts for r in merged])
    if blob:
        assert (counts.sum(axis=1) == 3).mean() > 0.8, "the lidar's one row counts in one of them"


@pytest.mark.parametrize("seed", [1, 2])
def test_a_lidar_that_says_blob_holds_both_alone(seed: int) -> None:
    passed = passing(camera=False, blob=True, seed=seed)
    for second, result in enumerate(passed.results, 1):
        assert result.tracks.ids.tolist() == [1, 2], second
        if second > 5:
            assert (result.tracks.status == CONFIRMED).all(), second
            assert (result.tracks.existence > 0.8).all()
    assert max(errors(passed.results[-1], passed.truth[-1])) < 2.0


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_of_a_lidar_that_does_not_say_so_the_second_ends_with_the_next_report_and_the_first_goes_on(seed: int) -> None:
    """Its row is 4 m off both boats and claims 0.5 m: nothing tells that from a boat that was dropped."""
    passed = passing(camera=False, seed=seed, judged=True)
    there = {second: r.tracks.ids.tolist() for second, r in enumerate(passed.results, 1)}
    first = MERGED.start
    assert there[first] == there[first + 1] == [1, 2], "not dropped at once"
    assert all(1 in ids for second, ids in there.items() if second < MERGED.stop)
    assert all(len(ids) == 1 for second, ids in there.items() if first + 3 < second < MERGED.stop)
    assert len(passed.results[-1].tracks.ids) == 2


def test_a_track_that_is_dropped_with_nobody_near_ends_at_once() -> None:
    made = centre((), period=1.0)
    give(made, info("lidar", motion=schemas.Motion("cv", 0.05)))
    far = boats(20) + np.array([[0.0] * 4, [0.0, 300.0, 0.0, 0.0]])
    lives = []
    for second in range(1, 20):
        now = far if second < 12 else far[:1]
        judged = np.full(len(now), 0.95)
        give(made, tracks("lidar", second, now, sigma=LIDAR, reference="blob", existence=judged))
        lives.append(2 in step(made, second).tracks.ids.tolist())
    near = passing(camera=False, blob=True)
    assert lives.count(True) < 18
    assert all(2 in r.tracks.ids.tolist() for r in near.results)


def test_two_that_a_row_stands_for_are_not_merged_though_they_look_alike() -> None:
    """The camera follows only the second boat while the lidar has one row in the first's track, beside it."""

    def run(apart: bool) -> list[int]:
        made = centre((), period=1.0)
        give(made, *(info(name, motion=schemas.Motion("cv", 0.05)) for name in ("camera", "lidar")))
        for second in range(1, 50):
            states = boats(31)
            states[:, 2:] = 0.0
            states[1, 0] = states[0, 0]
            states[1, 1] = states[0, 1] + (8.0 if second < 20 else 1.0)
            both = states if second < 20 and apart else states[:1]
            said: dict[str, Any] = {"reference": "blob", "extent": np.array([[9.0, 9.0, 0.0]] * len(both))}
            give(made, tracks("lidar", second, both, sigma=LIDAR, **said))
            give(made, tracks("camera", second, states[1:], [2], sigma=CAMERA))
            result = step(made, second)
        return [int(track) for track in result.tracks.ids]

    assert len(run(apart=False)) == 1, "evidence alone would merge them"
    assert len(run(apart=True)) == 2


def test_a_checkpoint_in_the_middle_goes_on_to_the_bit() -> None:
    def messages(second: int) -> list[Any]:
        rng = np.random.default_rng(second)
        merged = second in MERGED
        states = boats(second)
        means = states.mean(axis=0, keepdims=True) if merged else states
        means = means + rng.normal(size=means.shape) * LIDAR
        said: dict[str, Any] = {"reference": "blob", "extent": np.array([[16.0, 10.5, 0.4]] * len(means))}
        return [
            tracks("lidar", second, means, sigma=LIDAR, **said),
            tracks("radar", second, states + rng.normal(size=(2, 4)) * CAMERA, sigma=CAMERA,
                   extent=np.array([[7.0, 2.5, 0.1], [np.nan, np.nan, np.nan]])),
        ]  # fmt: skip

    def run(again: bool, backwards: bool = False) -> list[bytes]:
        made = centre(("lidar", "radar"), period=1.0)
        out = []
        for second in range(1, 45):
            give(made, *(messages(second)[::-1] if backwards else messages(second)))
            out.append(schemas.encode(replace(step(made, second).tracks, seq=second)))
            if again and second in (10, 25, 30):
                made = FusionCentre(made.config, made.checkpoint())
        return out

    whole = run(again=False)
    assert schemas.decode(whole[30]).extent is not None  # type: ignore[union-attr]
    assert run(again=True) == whole
    assert run(again=False, backwards=True) == whole


def rows_of(links: list[tuple[int, int, float]], names: int) -> tuple[Rows, Any]:
    """Rows (source, link, x) of unit variance, and the picture of tracks 1.. at x = 0, 1, 2, ..."""
    count = len(links)
    tracks_ = replace(
        empty_tracks(4),
        id=np.arange(count, dtype=np.uint64),
        mean=np.array([[x, 0.0, 0.0, 0.0] for _, _, x in links]).reshape(-1, 4).T,
        covariance=np.repeat(np.eye(4)[:, :, None], count, axis=2),
        part_covariance=np.zeros((4, 4, 0, count)),
        log_weight=np.zeros((0, count)),
        extent=np.zeros((0, count)),
        **unlinked(count) | {"link": np.array([link for _, link, _ in links], dtype=np.uint64)},
    )
    none = np.zeros(count, dtype=np.bool_)
    source = np.array([one for one, _, _ in links], dtype=np.intp)
    rows = Rows(source, none, tracks_, none, none, none, none, none, {})  # type: ignore[arg-type]
    picture = newborn(np.arange(1, 4, dtype=np.uint64), 4, 0)
    mean = np.zeros((4, 3))
    mean[0] = np.arange(3.0)
    picture = replace(
        picture, time=np.full(3, START), mean=mean, covariance=np.repeat(np.eye(4)[:, :, None], 3, axis=2)
    )
    return rows, picture


def test_what_counts_as_merged() -> None:
    made = centre(())
    second = 10**9

    def shared(*steps: list[tuple[int, int, float]], seconds: float = 1.0) -> list[tuple[int, int]]:
        blobs = Blobs(made.config)
        for k, links in enumerate(steps):
            rows, picture = rows_of(links, 2)
            time = START + round(k * seconds * second)
            found = blobs.follow(rows, ("a", "b"), picture, time, made.config.frame)
        return [(int(row), int(track)) for row, track in zip(found.row, found.track, strict=True)]

    both, one = [(0, 1, 0.0), (0, 2, 1.0)], [(0, 1, 0.5)]
    assert shared(both, one) == [(0, 1)]
    assert shared(both, one, one, one) == [(0, 1)], "as long as it lasts"
    assert shared(both, one, seconds=HOLD + 1) == [], "but not for ever"
    camera = [(1, 1, 0.0), (1, 2, 1.0)]
    assert shared(both + camera, one + camera, seconds=HOLD + 1) == [(0, 1)], "unless another tells them apart"
    assert shared(both, both) == []
    assert shared(both, [(0, 1, 40.0)]) == [], "it does not cover the other"
    assert shared([(0, 2, 1.0)], one) == [], "a row that went from one to the other"
    assert shared([(1, 2, 1.0), (0, 1, 0.0)], one) == [], "another source's track"
    assert shared([]) == []
    assert shared(both, []) == []
    assert shared([], both, []) == []
