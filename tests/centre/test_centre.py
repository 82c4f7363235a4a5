"""FusionCentre from outside: what goes in, what comes out, whatever the order, whatever is sent."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import schemas
from fusion_service.centre import FusionCentre, Order, SourceFound, SourceLost, StepResult
from fusion_service.centre.checkpoint import CheckpointError
from schemas.messages import COASTING, CONFIRMED, TENTATIVE
from tests.centre.worlds import SIGMA, SPACE, centre, give, info, moved, seen, step, tracks, truth

SOURCES = ("r1", "r2", "r3")


def mission(order: Callable[[list[Any]], list[Any]], seconds: int = 6, **config: Any) -> list[StepResult]:
    """Three sources, ten targets; `order` arranges the messages of each step before they are handed over."""
    rng = np.random.default_rng(3)
    states = truth(10)
    made = FusionCentre({"lateness": 3.0, **config})
    results = []
    for second in range(1, seconds + 1):
        batch: list[Any] = [tracks(name, second, seen(moved(states, second), rng)) for name in SOURCES]
        batch += [info(name) for name in SOURCES if second == 1]
        give(made, *order(batch))
        results.append(step(made, second))
    return results


def bytes_of(results: list[StepResult]) -> list[bytes]:
    return [schemas.encode(part) for result in results for part in (result.tracks, result.log)]


@pytest.mark.parametrize("memory", ["restart", "recursive", "tracklet"])
@pytest.mark.parametrize("rule", ["naive", "ci", "hmd-ga"])
def test_same_events_same_bytes_in_any_order(rule: str, memory: str) -> None:
    first = bytes_of(mission(lambda batch: batch, rule=rule, memory=memory))
    for seed in range(3):
        rng = np.random.default_rng(seed)

        def shuffled(batch: list[Any], rng: np.random.Generator = rng) -> list[Any]:
            return [batch[k] for k in rng.permutation(len(batch))]

        again = mission(shuffled, rule=rule, memory=memory)
        assert bytes_of(again) == first


def test_one_global_track_per_target_with_all_sources_in_it() -> None:
    result = mission(lambda batch: batch)[-1]
    picture = result.tracks
    assert len(picture.ids) == 10
    assert (picture.status == CONFIRMED).all()
    assert (picture.contributor_counts == 3).all()
    distance = np.linalg.norm(picture.means[:, None, :2] - moved(truth(10), 6)[None, :, :2], axis=2)
    assert (np.sort(distance.argmin(axis=1)) == np.arange(10)).all()


@pytest.mark.parametrize("rule", ["naive", "ci", "hmd-ga"])
def test_influences_of_a_linear_unbiased_rule_sum_to_one(rule: str) -> None:
    picture = mission(lambda batch: batch, rule=rule)[-1].tracks
    owner = np.repeat(np.arange(len(picture.ids)), picture.contributor_counts)
    sums = np.bincount(owner, weights=picture.contributor_influence)
    np.testing.assert_allclose(sums, 1.0, rtol=1e-9)


def test_naive_picture_is_the_information_sum_of_what_was_sent() -> None:
    made = centre(("r1", "r2"), rule="naive")
    means = [np.array([[0.0, 0.0, 1.0, 0.0]]), np.array([[20.0, -10.0, 0.0, 1.0]])]
    sigmas = [SIGMA, SIGMA * 2]
    for name, mean, sigma in zip(("r1", "r2"), means, sigmas, strict=True):
        give(made, tracks(name, 1, mean, sigma=sigma))
    picture = step(made, 1).tracks
    informations = [np.linalg.inv(np.diag(sigma**2)) for sigma in sigmas]
    covariance = np.linalg.inv(sum(informations))
    np.testing.assert_allclose(picture.covariances[0], covariance, rtol=1e-12)
    expected = covariance @ sum(y @ mean[0] for y, mean in zip(informations, means, strict=True))
    np.testing.assert_allclose(picture.means[0], expected, rtol=1e-12, atol=1e-12)


def test_prediction_to_the_step_uses_the_declared_motion() -> None:
    made = FusionCentre({})
    give(made, info("r1", motion=schemas.Motion("cv", 4.0), period=10.0), tracks("r1", 1, [[0, 0, 10, 0]]))
    picture = step(made, 3.0).tracks
    transition = np.eye(4) + 2.0 * np.eye(4, k=2)
    noise = 4.0 * np.kron([[8 / 3, 2], [2, 2]], np.eye(2))
    np.testing.assert_allclose(picture.means[0], [20, 0, 10, 0], atol=1e-12)
    np.testing.assert_allclose(
        picture.covariances[0], transition @ np.diag(SIGMA**2) @ transition.T + noise, rtol=1e-12
    )


def test_a_coordinated_turn_bends_the_prediction() -> None:
    made = FusionCentre({})
    space = (*SPACE, "turn_rate")
    rate = np.pi / 20
    message = dataclasses.replace(
        tracks("r1", 1, [[0, 0, 10, 0]]),
        space=space,
        means=np.array([[0, 0, 10, 0, rate]]),
        covariances=np.diag([1, 1, 1, 1, 1e-6])[None],
    )
    give(made, info("r1", motion=schemas.Motion("ct", 0.0), period=10.0), message)
    picture = step(made, 11.0).tracks
    radius = 10 / rate
    assert picture.space == SPACE
    np.testing.assert_allclose(picture.means[0], [radius, radius, 0, 10], atol=1e-9)


def test_sources_with_their_own_frames_meet() -> None:
    from fusion_service.geodesy import geodetic_to_enu

    frames = [schemas.Enu(59.0, -55.0), schemas.Enu(57.5, -57.6)]
    made = FusionCentre({"frame": {"kind": "enu", "lat": 59.0, "lon": -55.0}})
    for name, frame in zip(("r1", "r2"), frames, strict=True):
        x, y, _ = (float(v) for v in geodetic_to_enu(58.4, -56.4, 0.0, frame))
        give(made, info(name, frame=frame), tracks(name, 1, [[x, y, 0, 0]], frame=frame))
    picture = step(made, 1).tracks
    assert picture.contributor_counts.tolist() == [2]
    expected = [float(v) for v in geodetic_to_enu(58.4, -56.4, 0.0, frames[0])][:2]
    np.testing.assert_allclose(picture.means[0, :2], expected, atol=0.01)


def test_a_mixture_goes_out_as_its_mean_and_covariance_where_asked() -> None:
    made = FusionCentre({"publish": "mean"})
    parts = np.array([[-10.0, 0, 0, 0], [30.0, 0, 0, 0]])
    message = dataclasses.replace(
        tracks("r1", 1, parts),
        ids=np.array([7], dtype=np.uint64),
        counts=np.array([2], dtype=np.uint16),
        weights=np.array([0.25, 0.75]),
    )
    give(made, info("r1"), message)
    picture = step(made, 1).tracks
    assert picture.means[0, 0] == pytest.approx(20.0)
    assert picture.covariances[0, 0, 0] == pytest.approx(SIGMA[0] ** 2 + 0.25 * 30**2 + 0.75 * 10**2)


# Recursive memory


def test_recursive_memory_fuses_each_version_once() -> None:
    made = centre(("r1",), memory="recursive", motion=schemas.Motion("cv", 1.0))
    give(made, tracks("r1", 1, [[0, 0, 0, 0]]))
    first = step(made, 1).tracks
    alone = step(made, 1.5).tracks
    grown = np.trace(alone.covariances[0]) > np.trace(first.covariances[0])
    assert grown
    assert alone.contributor_influence.tolist() == [0.0]


def test_recursive_memory_is_ci_of_the_prediction_and_the_new_track() -> None:
    from scipy.optimize import minimize_scalar

    made = centre(("r1",), memory="recursive", motion=schemas.Motion("cv", 1.0), rule="naive")
    give(made, tracks("r1", 1, [[0, 0, 0, 0]]))
    step(made, 1)
    give(made, tracks("r1", 2, [[5, 0, 1, 0]], sigma=np.array([10.0, 60.0, 1.0, 4.0])))
    picture = step(made, 2).tracks
    transition = np.eye(4) + np.eye(4, k=2)
    noise = np.kron([[1 / 3, 1 / 2], [1 / 2, 1]], np.eye(2))
    old = np.linalg.inv(transition @ np.diag(SIGMA**2) @ transition.T + noise)
    new = np.linalg.inv(np.diag(np.array([10.0, 60.0, 1.0, 4.0]) ** 2))
    best = minimize_scalar(
        lambda w: -np.linalg.slogdet(w * new + (1 - w) * old)[1],
        bounds=(0, 1),
        method="bounded",
        options={"xatol": 1e-12},
    )
    covariance = np.linalg.inv(best.x * new + (1 - best.x) * old)
    np.testing.assert_allclose(picture.covariances[0], covariance, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(picture.means[0], covariance @ (best.x * new @ [5, 0, 1, 0]), rtol=1e-4, atol=1e-4)


# Sources, epochs, sequence


def test_a_restarted_source_takes_over_nobodys_links() -> None:
    made = centre(("r1", "r2"))
    give(made, tracks("r1", 1, [[0, 0, 0, 0], [9000, 0, 0, 0]], [1, 2]))
    before = step(made, 1).tracks
    give(made, info("r1", epoch=2), tracks("r1", 2, [[0, 5000, 0, 0]], [1], epoch=2, seq=0))
    after = step(made, 2)
    new = after.tracks.ids[np.argmin(np.abs(after.tracks.means[:, 1] - 5000))]
    assert new not in before.ids
    assert {"kind": "restarted", "source": "r1", "epoch": 2} in after.log.events
    give(made, tracks("r1", 3, [[0, 0, 0, 0]], [1], epoch=1, seq=9))
    assert step(made, 3).status.refused == {"old-epoch": 1}


def test_a_restarted_source_finds_its_targets_again_by_place() -> None:
    states = truth(5)
    made = centre(("r1", "r2"))
    give(made, tracks("r1", 1, states, range(1, 6)), tracks("r2", 1, states, range(1, 6)))
    before = step(made, 1).tracks
    give(made, info("r1", epoch=2), tracks("r1", 2, moved(states, 1), range(5, 0, -1), epoch=2, seq=0))
    give(made, tracks("r2", 2, moved(states, 1), range(1, 6)))
    after = step(made, 2).tracks
    assert after.ids.tolist() == before.ids.tolist()
    assert (after.contributor_counts == 2).all()


def test_repeats_gaps_and_swaps_change_only_counters() -> None:
    def run(mess: bool) -> tuple[list[bytes], dict[str, Any]]:
        rng = np.random.default_rng(3)
        states = truth(10)
        made = FusionCentre({"lateness": 3.0})
        out = []
        held: list[schemas.LocalTracks] = []
        for second in range(1, 9):
            batch = [tracks(name, second, seen(moved(states, second), rng)) for name in SOURCES]
            if second == 1:
                give(made, *(info(name) for name in SOURCES))
            for message in batch:
                give(made, message, *([message] * 2 if mess else []))
            if mess:
                give(made, *held)
            held = batch
            out.append(schemas.encode(step(made, second).tracks))
        return out, step(made, 9).status.sources["r1"]

    clean, calm = run(False)
    messy, told = run(True)
    assert messy == clean
    assert calm["repeats"] == 0
    assert told["repeats"] == 8 * 2 + 7

    made = centre(("r1",))
    give(made, tracks("r1", 1, truth(3), seq=1), tracks("r1", 1.4, truth(3), seq=5), tracks("r1", 1.2, truth(3), seq=3))
    one = step(made, 2)
    assert one.status.sources["r1"]["gaps"] == 2
    give(made, tracks("r1", 1.3, truth(3), seq=4))
    two = step(made, 3)
    assert (two.status.sources["r1"]["gaps"], two.status.sources["r1"]["reordered"]) == (1, 1)
    assert two.status.refused == {}


def test_the_newest_version_counts_whatever_comes_last() -> None:
    made = centre(("r1",))
    give(made, tracks("r1", 2, [[100, 0, 0, 0]], seq=2))
    step(made, 2)
    give(made, tracks("r1", 1, [[0, 0, 0, 0]], seq=1))
    assert step(made, 3).tracks.means[0, 0] == 100


def test_a_complete_scan_drops_what_it_does_not_list_and_none_is_a_scan_too() -> None:
    made = centre(("r1",), coast=0.0)
    give(made, tracks("r1", 1, truth(4), [1, 2, 3, 4]))
    assert len(step(made, 1).tracks.ids) == 4
    give(made, tracks("r1", 2, moved(truth(4), 1)[:1], [1], complete=False))
    assert step(made, 2).tracks.contributor_counts.sum() == 4
    give(made, tracks("r1", 3, moved(truth(4), 2)[:2], [1, 2]))
    assert step(made, 3).tracks.contributor_counts.sum() == 2
    give(made, tracks("r1", 4, np.zeros((0, 4))))
    assert step(made, 4).tracks.contributor_counts.sum() == 0


def test_a_source_goes_stale_after_its_periods_and_is_told() -> None:
    made = centre(("r1",), stale_periods=3, coast=100.0)
    give(made, SourceFound("r1"), tracks("r1", 0, truth(2)))
    step(made, 0)
    give(made, tracks("r1", 1, moved(truth(2), 1)))
    assert step(made, 1).status.sources["r1"]["alive"] is True
    assert step(made, 7).tracks.contributor_counts.sum() == 2  # three periods of 1 s, and a lateness of 3 s
    late = step(made, 7.1)
    assert late.status.sources["r1"]["stale"]
    assert (late.tracks.contributor_counts == 0).all()
    give(made, SourceLost("r1"))
    assert step(made, 8).status.sources["r1"]["alive"] is False


# Life


def test_life_of_a_track() -> None:
    made = centre(("r1",), coast=3.0, confirm_hits=2)
    spot = [[0, 0, 10, 0]]
    give(made, tracks("r1", 1, spot))
    first = step(made, 1).tracks
    assert first.status.tolist() == [TENTATIVE]
    give(made, tracks("r1", 2, [[10, 0, 10, 0]]))
    assert step(made, 2).tracks.status.tolist() == [CONFIRMED]
    give(made, tracks("r1", 3, np.zeros((0, 4))))
    lost = step(made, 3).tracks
    assert (lost.status.tolist(), lost.ids.tolist()) == ([COASTING], first.ids.tolist())
    give(made, tracks("r1", 5, [[40, 0, 10, 0]], [77]))
    back = step(made, 5).tracks
    assert (back.status.tolist(), back.ids.tolist()) == ([CONFIRMED], first.ids.tolist())
    give(made, tracks("r1", 6, np.zeros((0, 4))))
    step(made, 6)
    gone = step(made, 9).tracks
    assert len(gone.ids) == 0
    assert gone.ended == ((int(first.ids[0]), "lost", None),)


def test_a_source_that_may_not_start_supports_only() -> None:
    made = FusionCentre({})
    give(made, info("r1"), info("r2", may_start=False))
    give(made, tracks("r2", 1, [[0, 0, 0, 0], [9000, 0, 0, 0]]))
    assert len(step(made, 1).tracks.ids) == 0
    give(made, tracks("r1", 2, [[0, 0, 0, 0]]), tracks("r2", 2, [[0, 0, 0, 0], [9000, 0, 0, 0]]))
    assert step(made, 2).tracks.contributor_counts.tolist() == [2]


def test_duplicates_merge_and_wrong_merges_split_on_evidence() -> None:
    made = centre(("r1", "r2"))
    give(made, tracks("r1", 1, [[0, 0, 0, 0]]), tracks("r2", 1, [[300, 0, 0, 0]]))
    apart = step(made, 1).tracks
    assert len(apart.ids) == 2
    counts = []
    for second in range(2, 12):
        place = {2: 200, 3: 120, 4: 50}.get(second, 10)
        give(made, tracks("r1", second, [[0, 0, 0, 0]]), tracks("r2", second, [[place, 0, 0, 0]]))
        last = step(made, second).tracks
        counts.append(len(last.ids))
        if counts[-1] == 1:
            assert last.ended == ((int(apart.ids[1]), "merged", int(apart.ids[0])),)
            break
    assert counts[:3] == [2, 2, 2]  # never on one datum
    assert counts[-1] == 1
    counts = []
    for second in range(12, 16):
        give(made, tracks("r1", second, [[0, 0, 0, 0]]), tracks("r2", second, [[2000, 0, 0, 0]]))
        last = step(made, second).tracks
        counts.append(len(last.ids))
        assert last.ids[0] == apart.ids[0]
        assert np.linalg.norm(last.means[0, :2]) < 1.0  # the jump is never fused
        if counts[-1] == 2:
            assert last.split_from == ((int(last.ids[1]), int(apart.ids[0])),)
            break
    assert counts[-1] == 2
    assert last.ids[1] not in apart.ids


def test_orders() -> None:
    made = centre(("r1", "r2"))
    states = truth(3)
    give(made, tracks("r1", 1, states), tracks("r2", 1, states))
    before = step(made, 1).tracks
    give(made, Order("mute", "r2"), tracks("r1", 2, moved(states, 1)), tracks("r2", 2, moved(states, 1)))
    muted = step(made, 2)
    assert muted.status.refused == {"muted": 1}
    assert (muted.tracks.contributor_counts == 1).all()
    give(made, Order("delete", track=int(before.ids[0])), Order("unmute", "r2"))
    after = step(made, 2.5).tracks
    assert before.ids[0] not in after.ids
    assert after.ended == ((int(before.ids[0]), "ordered", None),)


# Checkpoint and ids


@pytest.mark.parametrize("memory", ["restart", "recursive", "tracklet"])
@pytest.mark.parametrize("cut", [1, 3, 5])
def test_a_centre_from_a_checkpoint_goes_on_bit_for_bit(memory: str, cut: int) -> None:
    rng = np.random.default_rng(3)
    states = truth(10)
    one = centre(SOURCES, memory=memory)
    other = None
    for second in range(1, 8):
        batch = [tracks(name, second, seen(moved(states, second), rng)) for name in SOURCES]
        give(one, *batch)
        expected = step(one, second)
        if other is not None:
            give(other, *batch)
            got = step(other, second)
            assert schemas.encode(dataclasses.replace(got.tracks, seq=0)) == schemas.encode(
                dataclasses.replace(expected.tracks, seq=0)
            )
        if second == cut:
            blob = one.checkpoint()
            other = FusionCentre(one.config, blob)
            assert other.checkpoint() == blob


def test_a_new_generation_gives_new_ids_and_keeps_the_old() -> None:
    states = truth(4)
    one = FusionCentre({}, generation=7)
    give(one, info("r1"), tracks("r1", 1, states[:2]))
    before = step(one, 1).tracks
    assert (before.ids >> np.uint64(32)).tolist() == [7, 7]
    two = FusionCentre({}, one.checkpoint(), generation=8)
    give(two, tracks("r1", 2, moved(states, 1)))
    after = step(two, 2).tracks
    assert after.ids[:2].tolist() == before.ids.tolist()
    assert (after.ids[2:] >> np.uint64(32)).tolist() == [8, 8]


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_broken_checkpoint_is_refused(data: st.DataObject) -> None:
    made = centre(("r1",))
    give(made, tracks("r1", 1, truth(2)))
    step(made, 1)
    blob = made.checkpoint()
    cut = data.draw(st.integers(0, len(blob) - 1))
    with pytest.raises(CheckpointError):
        FusionCentre({}, blob[:cut])


def test_steps_only_go_forward() -> None:
    made = centre()
    step(made, 1)
    with pytest.raises(ValueError, match="not after"):
        step(made, 1)


def test_the_log_names_every_message_and_decision() -> None:
    states = truth(3)
    made = centre(("r1", "r2"))
    batch = [tracks("r1", 1, states), tracks("r2", 1, states)]
    give(made, *batch)
    log = step(made, 1).log
    assert {(e.source, e.hash) for e in log.taken} >= {(m.source, schemas.digest(m)) for m in batch}
    kinds = [schemas.DECISIONS[code] for code in log.decisions.kind]
    assert kinds.count("linked") == 6
    assert kinds.count("born") == 3
    give(made, *(tracks(name, 2, moved(states, 1)) for name in ("r1", "r2")))
    kinds = [schemas.DECISIONS[code] for code in step(made, 2).log.decisions.kind]
    assert kinds.count("kept") == 6


@pytest.mark.parametrize("order", list(itertools.permutations(range(3)))[1:3])
def test_info_and_tracks_of_one_step_in_any_order(order: tuple[int, ...]) -> None:
    made = FusionCentre({})
    batch = [info("r1"), tracks("r1", 1, truth(2)), tracks("r1", 0.5, truth(2), seq=0)]
    give(made, *(batch[k] for k in order))
    assert step(made, 1).tracks.contributor_counts.sum() == 2
