"""The centre for intensities: what goes in, what comes out, and the guarantees it shares with that for tracks."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import msgpack
import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre, IntensityCentre, Order, StepResult
from fusion_service.centre.checkpoint import CheckpointError
from fusion_service.metrics import gospa
from schemas import Disk
from schemas.messages import COASTING, CONFIRMED, TENTATIVE
from sensor_clients.scenarios import three_radars as world
from tests.centre.worlds import FRAME, SECOND, SPACE, START, give, info, moved, step, tracks, truth
from tests.helpers import fuse_again

SIGMA = np.array([30.0, 30.0, 2.0, 2.0])
STATES = np.array([[0.0, 0, 10, 0], [5000.0, 0, 0, 10], [0.0, 8000, -5, 5]])


def intensity(
    source: str,
    second: float,
    states: Any,
    weights: Any = 0.9,
    *,
    seq: int | None = None,
    epoch: int = 1,
    **changes: Any,
) -> schemas.LocalIntensity:
    means = np.asarray(states, dtype=float).reshape(-1, len(SPACE))
    fields: dict[str, Any] = {
        "source": source,
        "epoch": epoch,
        "seq": round(second) if seq is None else seq,
        "sent": START,
        "time": START + round(second * SECOND),
        "space": SPACE,
        "frame": FRAME,
        "weights": np.asarray(weights, dtype=float) * np.ones(1 if np.ndim(weights) else len(means)),
        "means": means,
        "covariances": np.tile(np.diag(SIGMA**2), (len(means), 1, 1)),
    }
    return schemas.LocalIntensity(**{**fields, **changes})


def centre(sources: Sequence[str] = ("r1", "r2", "r3"), **config: Any) -> Any:
    made: Any = IntensityCentre({"lateness": 3.0, **config})
    for source in sources:
        made.handle(info(source), START)
    return made


def mass(of: IntensityCentre) -> float:
    return 0.0 if of.intensity is None else of.intensity.mass


def picture(result: StepResult) -> bytes:
    return schemas.encode(dataclasses.replace(result.tracks, sent=0))


def test_targets_get_tracks_that_keep_their_ids_and_say_who_saw_them() -> None:
    one = centre()
    ids = []
    for second in range(1, 6):
        rng = np.random.default_rng(second)
        for name in ("r1", "r2", "r3"):
            order = rng.permutation(3)
            states = (moved(STATES, second) + rng.normal(size=STATES.shape) * SIGMA / 3)[order]
            give(one, intensity(name, second, states))
        result = step(one, second)
        near = np.linalg.norm(result.tracks.means[:, None, :2] - moved(STATES, second)[:, :2], axis=2)
        assert near.min(axis=0).max() < 60
        ids.append(result.tracks.ids[near.argmin(axis=0)].tolist())
    assert all(one_step == ids[0] for one_step in ids)
    assert (result.tracks.status == CONFIRMED).all()
    np.testing.assert_allclose(result.tracks.existence, 0.9)
    assert result.tracks.contributor_counts.tolist() == [3, 3, 3]
    np.testing.assert_allclose(result.tracks.contributor_influence, 1 / 3)
    assert result.status.tracks == {"tentative": 0, "confirmed": 3, "coasting": 0, "expected": 3, "components": 3}
    assert mass(one) == pytest.approx(2.7)


def test_an_intensity_is_predicted_with_its_sources_motion() -> None:
    one = centre(("r1",))
    give(one, intensity("r1", 1, STATES))
    result = step(one, 3)
    F = np.eye(4)
    F[[0, 1], [2, 3]] = 2.0
    Q = np.kron(np.array([[8 / 3, 2.0], [2.0, 2.0]]), np.eye(2))
    order = np.lexsort(result.tracks.means.T[:2])
    expected = moved(STATES, 2)[np.lexsort(moved(STATES, 2).T[:2])]
    np.testing.assert_allclose(result.tracks.means[order], expected, atol=1e-9)
    np.testing.assert_allclose(result.tracks.covariances[0], F @ np.diag(SIGMA**2) @ F.T + Q, atol=1e-9)


@pytest.mark.parametrize(("rule", "blind"), [("aa", 0.3), ("ga", 0.0), ("hybrid", 0.3)])
def test_coverage_decides_whether_silence_is_evidence(rule: str, blind: float) -> None:
    """The third target is in the disk of r3 only, or in all disks, or nobody says what it covers."""
    for radius, expected in ((6000.0, 0.9), (9000.0, blind), (None, 0.9)):
        one = centre((), intensity_rule=rule)
        for name, own in (("r1", radius), ("r2", radius), ("r3", radius and 9000.0)):
            give(one, info(name, coverage=Disk(own) if own else None))
        for name, seen in (("r1", STATES[:2]), ("r2", STATES[:2]), ("r3", STATES)):
            give(one, intensity(name, 1, seen))
        result = step(one, 1)
        assert mass(one) == pytest.approx(1.8 + expected)
        assert len(result.tracks.ids) == (3 if expected == 0.9 else 2)


def test_an_empty_intensity_says_nobody_is_there_a_stale_or_spoiled_one_nothing() -> None:
    one = centre(())
    give(one, info("r1", coverage=Disk(9000.0)), info("r2", coverage=Disk(9000.0)))
    give(one, intensity("r1", 1, STATES[:1]))
    step(one, 1)
    assert mass(one) == pytest.approx(0.9)
    give(one, intensity("r1", 2, STATES[:1]), intensity("r2", 2, []))
    step(one, 2)
    assert mass(one) == pytest.approx(0.45)
    spoiled = intensity("r2", 6, STATES[:1], np.nan)
    give(one, intensity("r1", 6, STATES[:1]), spoiled)
    step(one, 6)
    assert one.refusals() == {"weights": 1}
    give(one, intensity("r2", 7, [STATES[0], STATES[1]], [0.5, np.inf]))
    step(one, 7)
    assert mass(one) == pytest.approx(0.7), "the sound component of a message is used"


def test_states_by_threshold_and_by_rank() -> None:
    message = intensity("r1", 1, STATES, [0.4, 0.8, 0.45])
    for options, expected in (
        ({}, [5000.0]),
        ({"intensity_threshold": 0.42}, [0.0, 5000.0]),
        ({"intensity_extract": "rank"}, [0.0, 5000.0]),
    ):
        one = centre(("r1",), **options)
        give(one, message)
        assert sorted(np.abs(step(one, 1).tracks.means[:, 0]).tolist()) == expected


def test_a_track_coasts_with_the_weight_left_near_it_and_ends() -> None:
    one = centre(("r1", "r2"), coast=2.0)
    for second in (1, 2):
        give(one, *(intensity(name, second, STATES[:2]) for name in ("r1", "r2")))
        first = step(one, second).tracks
    assert (first.status == CONFIRMED).all()
    give(one, *(intensity(name, 3, STATES[:2], [0.9, 0.2]) for name in ("r1", "r2")))
    result = step(one, 3).tracks
    assert result.ids.tolist() == first.ids.tolist()
    assert sorted(zip(result.existence.round(6).tolist(), result.status.tolist(), strict=True)) == [
        (0.2, COASTING),
        (0.9, CONFIRMED),
    ]
    assert result.contributor_counts.sum() == 2
    give(one, *(intensity(name, 6, STATES[:1]) for name in ("r1", "r2")))
    result = step(one, 6).tracks
    lost = first.ids[np.abs(first.means[:, 0] - 5000) < 100]
    assert result.ended == ((int(lost[0]), "lost", None),)


def test_only_sources_that_may_start_tracks_do() -> None:
    one = centre(())
    give(one, info("r1", may_start=False), intensity("r1", 1, STATES))
    assert not len(step(one, 1).tracks.ids)
    give(one, info("r2"), intensity("r1", 2, STATES), intensity("r2", 2, STATES))
    assert len(step(one, 2).tracks.ids) == 3


@pytest.mark.parametrize("rule", ["aa", "ga", "hybrid"])
@pytest.mark.parametrize("covered", [None, "own"])
def test_two_sources_far_apart_keep_both_targets(rule: str, covered: str | None) -> None:
    one = centre((), intensity_rule=rule)
    for name, x in (("r1", 0.0), ("r2", 80_000.0)):
        give(one, info(name, position=(x, 0.0, 0.0), coverage=Disk(5000.0) if covered else None))
    targets = np.array([[0.0, 0, 10, 0], [80_000.0, 0, 0, 10]])
    for second in (1, 2, 3):
        there = moved(targets, second)
        give(one, intensity("r1", second, there[:1]), intensity("r2", second, there[1:]))
        result = step(one, second).tracks
        assert mass(one) == pytest.approx(1.8)
    assert result.status.tolist() == [CONFIRMED, CONFIRMED]
    np.testing.assert_allclose(np.sort(result.means[:, 0]), np.sort(moved(targets, 3)[:, 0]), atol=1e-6)


SITE = np.diag([1e4, 1e4, 1.0])
"""The covariance of a position known to 100 m."""


@pytest.mark.parametrize("rule", ["aa", "ga", "hybrid"])
@pytest.mark.parametrize("stated", ["info", "config", "override", "nobody"])
@pytest.mark.parametrize("error", [100.0, 300.0])
def test_a_registration_error_that_is_stated_deletes_nobody(rule: str, stated: str, error: float) -> None:
    """Two sources that cover a target see it `error` apart at sigma 30 m. Stated as 100 m (300 m is 2.1 sigma of the
    difference) it is one target with most of its number; the expected mass of ga is its formula, by hand."""
    sources: dict[str, Any] = {"r1": {"registration_sigma": 100.0}, "r2": {"registration_sigma": 100.0}}
    if stated == "override":
        sources = {name: {**one, "override": True} for name, one in sources.items()}
    one: Any = IntensityCentre({"intensity_rule": rule, "sources": sources if stated in ("config", "override") else {}})
    covariance = {"info": SITE, "override": SITE * 1e-9}.get(stated)
    for name in ("r1", "r2"):
        give(one, info(name, coverage=Disk(9000.0), position_covariance=covariance))
    for second in (1, 2):
        give(one, intensity("r1", second, [[0.0, 0, 0, 0]]), intensity("r2", second, [[error, 0, 0, 0]]))
        result = step(one, second).tracks
    variance = 900.0 + (1e4 if stated != "nobody" else 0.0)
    apart = 2 * (error / 2) ** 2 / variance
    expected = 0.9 * (np.exp(-apart / 4) if rule == "ga" else 1.0)
    if stated == "nobody" and error == 300.0:
        assert mass(one) == pytest.approx(0.0 if rule == "ga" else 0.9), "each half, denied by the other"
        assert not len(result.ids)
        return
    assert mass(one) == pytest.approx(expected)
    if expected > 0.5:
        assert result.status.tolist() == [CONFIRMED]
        np.testing.assert_allclose(result.means[0], [error / 2, 0, 0, 0], atol=1e-6)
        spread = 900.0 + (error / 2) ** 2 * (rule == "aa") + (1e4 if stated != "nobody" else 0.0)
        np.testing.assert_allclose(result.covariances[0, 0, 0], spread, rtol=1e-6)


def test_a_track_keeps_its_id_when_one_of_two_shifted_sources_falls_silent() -> None:
    one = centre((), coast=1.0)
    for name in ("r1", "r2"):
        give(one, info(name, position_covariance=SITE))
    ids = set()
    for second in range(1, 12):
        give(one, intensity("r1", second, [[0.0, 0, 0, 0]]))
        if second < 4:
            give(one, intensity("r2", second, [[350.0, 0, 0, 0]]))
        result = step(one, second).tracks
        ids |= set(result.ids.tolist())
    assert len(ids) == 1
    np.testing.assert_allclose(result.means[0, 0], 0.0, atol=1e-6)


def test_what_is_stated_of_registration_never_raises() -> None:
    odd = [
        np.diag([1e4, -1e4, 0.0]),
        np.full((3, 3), 1e300),
        np.full((3, 3), np.nan),
        np.zeros((3, 3)),
        np.ones((2, 2)),
    ]
    for covariance in odd:
        one = centre(("r2",))
        give(one, info("r1", position_covariance=covariance, frame=schemas.Enu(59.5, -55.0)))
        give(one, *(intensity(name, 1, STATES) for name in ("r1", "r2")))
        result = step(one, 1)
        assert len(result.tracks.ids) == 3
        assert not schemas.check_numbers([result.tracks])[0].any()


@pytest.mark.parametrize("p", [None, 0.0, 0.6, 1.0])
def test_a_covering_source_that_reports_nothing_denies_by_its_detection_probability(p: float | None) -> None:
    one = centre(("r1",), intensity_threshold=0.1)
    give(one, info("r2", coverage=Disk(9000.0), detection_probability=p))
    give(one, intensity("r1", 1, STATES[:1]), intensity("r2", 1, []))
    step(one, 1)
    assert mass(one) == pytest.approx((0.9 + (1 - (1.0 if p is None else p)) * 0.9) / 2)


@pytest.mark.parametrize("extract", ["threshold", "rank"])
def test_a_weight_of_two_is_two_tracks_that_do_not_flicker(extract: str) -> None:
    one = centre(("r1",), intensity_extract=extract)
    told = []
    weights = [2.0, 2.02, 1.4, 1.6, 1.5, 1.42, 1.58, 1.9, 2.3, 1.41, 1.0, 1.02, 1.6, 1.45, 1.59, 2.0]
    for second, weight in enumerate(weights, 1):
        give(one, intensity("r1", second, moved(STATES[:1], second), weight))
        told.append(step(one, second).tracks)
    standing = [set(t.ids[t.status != COASTING].tolist()) for t in told]
    assert [len(ids) for ids in standing] == [2] * 10 + [1] * 5 + [2]
    assert all(ids <= standing[0] for ids in standing)
    assert standing[10] == {min(standing[0])}, "the older stays"
    assert (told[9].status == CONFIRMED).all()
    np.testing.assert_allclose(told[4].existence, [0.75, 0.75])
    np.testing.assert_allclose(told[4].means, np.repeat(moved(STATES[:1], 5), 2, axis=0), atol=1e-6)


@pytest.mark.parametrize("extract", ["threshold", "rank"])
def test_two_in_one_component_part_with_their_ids(extract: str) -> None:
    one = centre(("r1",), intensity_extract=extract)
    for second in (1, 2, 3):
        give(one, intensity("r1", second, [[0.0, 0, 0, 0]], 2.0))
        together = step(one, second).tracks.ids.tolist()
    left = set()
    for second in range(4, 10):
        apart = 4.0 * (second - 3)
        give(one, intensity("r1", second, [[-apart, 0, -4, 0], [apart, 0, 4, 0]], [1.0, 0.95]))
        result = step(one, second).tracks
        assert result.ids.tolist() == together
        assert (result.status == CONFIRMED).all()
        left.add(int(result.ids[result.means[:, 0].argmin()]))
    assert len(left) == 1
    np.testing.assert_allclose(np.sort(result.means[:, 0]), [-24, 24], atol=1e-6)


def test_steps_without_new_data_change_no_life() -> None:
    """A track is seen once, then its source is silent while the centre steps on: neither confirmed nor forgotten; its
    number does not grow on one datum; and a source far away that declares what it sees changes nothing."""
    one = centre(("r1",), stale_periods=100.0)
    give(one, info("r9", position=(3e5, 0.0, 0.0), coverage=Disk(1000.0)))
    give(one, intensity("r1", 1, STATES[:1], 1.0))
    step(one, 1)
    give(one, intensity("r1", 1.2, STATES[:1], 1.8, seq=2))
    first = step(one, 1.2).tracks
    assert first.status.tolist() == [CONFIRMED]
    for k in range(1, 40):
        give(one, intensity("r9", 1.2 + 0.1 * k, [[3e5, 0, 0, 0]], seq=k))
        result = step(one, 1.2 + 0.1 * k).tracks
        near = np.abs(result.means[:, 0]) < 1e4
        assert result.ids[near].tolist() == first.ids.tolist()
    two = centre(("r1",), stale_periods=100.0)
    give(two, intensity("r1", 1, STATES[:1]))
    for k in range(20):
        result = step(two, 1 + 0.1 * k).tracks
        assert result.status.tolist() == [TENTATIVE]
    give(two, intensity("r1", 3, STATES[:1]))
    assert step(two, 3).tracks.status.tolist() == [CONFIRMED]


def test_a_dead_sources_report_is_evidence_once() -> None:
    """r1 has died; what it said last lies under a single report of r2 and confirms nothing more."""
    one = centre(("r1", "r2"), confirm_hits=3, confirm_sources=2, stale_periods=100.0)
    give(one, intensity("r1", 1, STATES[:1]))
    step(one, 1)
    for k in range(1, 30):
        assert step(one, 1 + 0.1 * k).tracks.status.tolist() == [TENTATIVE]
    give(one, intensity("r2", 4, STATES[:1]))
    assert step(one, 4).tracks.status.tolist() == [TENTATIVE]
    give(one, intensity("r2", 5, STATES[:1]))
    assert step(one, 5).tracks.status.tolist() == [CONFIRMED]


def test_orders_mute_a_source_and_delete_a_track() -> None:
    one = centre(())
    give(one, info("r1", coverage=Disk(2000.0)), info("r2", coverage=Disk(9000.0, 2000.0)))
    give(one, intensity("r1", 1, STATES[:1]), intensity("r2", 1, STATES[1:]))
    first = step(one, 1).tracks
    one.handle(Order("mute", "r2"), START)
    one.handle(Order("delete", track=int(first.ids[0])), START)
    give(one, intensity("r1", 2, STATES[:1]), intensity("r2", 2, STATES[1:]))
    result = step(one, 2)
    assert (int(first.ids[0]), "ordered", None) in result.tracks.ended
    assert mass(one) == pytest.approx(0.9)
    assert result.status.refused == {"muted": 1}


def test_each_kind_of_centre_refuses_what_the_other_takes() -> None:
    one, other = centre(("r1",)), FusionCentre({})
    give(one, tracks("r1", 1, STATES))
    give(other, info("r1"), intensity("r1", 1, STATES))
    assert not len(step(one, 1).tracks.ids)
    assert not len(step(other, 1).tracks.ids)
    assert (one.refusals(), other.refusals()) == ({"tracks": 1}, {"intensity": 1})


def hostile() -> list[Any]:
    n = len(STATES)
    base, indefinite = np.tile(np.diag(SIGMA**2), (n, 1, 1)), np.tile(np.diag([1.0, 1, 1, -1]), (n, 1, 1))
    needle = base * np.array([1.0, 1, 1, 1e-18])[:, None] * np.array([1.0, 1, 1, 1e-18])
    odd: list[dict[str, Any]] = [
        {"means": STATES * np.nan},
        {"means": STATES * 1e300},
        {"means": STATES * 1e8},
        {"covariances": indefinite},
        {"covariances": np.full_like(base, np.inf)},
        {"covariances": needle},
        {"covariances": base * 1e18},
        {"weights": np.array([-1.0, 0.9, 0.9])},
        {"weights": np.array([1e300, 0.9, 0.0])},
        {"weights": np.array([1000.0, 1e-300, 5e-324])},
        {"weights": np.ones(2)},
        {"means": np.ones((n, 3))},
        {"covariances": np.ones((n, 3, 3))},
        {"space": ("x", "y"), "means": STATES[:, :2], "covariances": base[:, :2, :2]},
        {"frame": schemas.Local("elsewhere")},
        {"frame": schemas.Ecef()},
        {"time": START + 10**9 * SECOND},
        {"time": START - 100 * SECOND},
        {"time": -(2**62)},
        {"epoch": 2**63 - 1},
        {"seq": 2**63, "weights": np.zeros(n)},
    ]
    rng = np.random.default_rng(3)
    crowd = np.concatenate([rng.normal(size=(4000, 4)) * 20, STATES])
    messages: list[Any] = [
        intensity("r2", 2, STATES, seq=10 + k, **change)
        if "seq" not in change
        else intensity("r2", 2, STATES, **change)
        for k, change in enumerate(odd)
        if "epoch" not in change
    ]
    messages.append(intensity("r2", 2, STATES, epoch=2**63 - 1))
    messages.append(intensity("r3", 2, crowd, 0.01))
    messages.append(intensity("r3", 2, crowd, 0.01))
    messages.append(intensity("r4", 2, [], seq=1))
    messages.append(tracks("r1", 2, STATES))
    return messages


@pytest.mark.parametrize("rule", ["aa", "ga", "hybrid"])
@pytest.mark.parametrize("cardinality", ["average", "consistent"])
def test_nothing_that_comes_in_raises_and_what_is_sound_is_fused(rule: str, cardinality: str) -> None:
    for seed in range(3):
        one = centre(intensity_rule=rule, intensity_cardinality=cardinality)
        give(one, intensity("r1", 1, STATES))
        step(one, 1)
        messages = hostile()
        for at in np.random.default_rng(seed).permutation(len(messages)).tolist():
            give(one, messages[at])
        give(one, intensity("r1", 2, STATES))
        for second in (2, 3, 4, 50):
            result = step(one, second)
            schemas.decode(schemas.encode(result.tracks))
            schemas.decode(schemas.encode(result.log))
            assert not schemas.check_numbers([result.tracks])[0].any()
            assert np.isfinite(mass(one))
            assert result.status.tracks["components"] <= one.config.intensity_components
        assert {"weights", "not-finite", "out-of-range", "not-positive-definite", "length", "space", "frame"} <= set(
            one.refusals()
        )
        assert {"future", "late", "tracks", "repeat"} <= set(one.refusals())
        assert mass(one) == 0.0, "all are stale"


@pytest.mark.parametrize("options", [{}, {"intensity_rule": "aa"}, {"intensity_extract": "rank"}])
def test_the_order_of_arrival_does_not_matter(options: dict[str, Any]) -> None:
    results: list[bytes] = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        one = centre(**options)
        made = b""
        for second in range(1, 5):
            noise = np.random.default_rng(second)
            messages: list[Any] = []
            for name in ("r1", "r2", "r3"):
                states = truth(8) + noise.normal(size=(8, 4)) * SIGMA
                messages += [intensity(name, second - 0.5, states, noise.uniform(0.1, 1.1, 8), seq=2 * second)]
                messages += [intensity(name, second, states[1:], noise.uniform(0.1, 1.1, 7), seq=2 * second + 1)]
            for at in rng.permutation(len(messages)).tolist():
                give(one, messages[at])
            result = step(one, second)
            made += picture(result) + schemas.encode(result.log)
        results.append(made + one.checkpoint())
    assert len(set(results)) == 1


@pytest.mark.parametrize("extract", ["threshold", "rank"])
def test_a_checkpoint_goes_on_bit_for_bit_and_only_in_its_own_kind(extract: str) -> None:
    def messages(second: int) -> list[Any]:
        rng = np.random.default_rng(second)
        return [intensity(n, second, STATES + rng.normal(size=(3, 4)), rng.uniform(0.3, 2, 3)) for n in ("r1", "r2")]

    one: Any = IntensityCentre(
        {"lateness": 3.0, "intensity_extract": extract, "sources": {"r2": {"registration_sigma": 20.0}}}
    )
    for second in (1, 2, 3):
        give(one, *messages(second))
        step(one, second)
    other: Any = IntensityCentre(one.config, one.checkpoint())
    assert other.time == one.time
    other._published = one._published
    for second in (4, 5, 9):
        for each in (one, other):
            give(each, *messages(second))
        assert picture(step(one, second)) == picture(step(other, second))
        assert one.checkpoint() == other.checkpoint()
    with pytest.raises(CheckpointError, match="fuses intensity, not tracks"):
        FusionCentre({"lateness": 3.0}, one.checkpoint())
    with pytest.raises(CheckpointError, match="fuses tracks, not intensity"):
        IntensityCentre({}, FusionCentre({}).checkpoint())
    again: Any = IntensityCentre(one.config, one.checkpoint(), generation=7)
    give(again, info("r9"))
    give(again, intensity("r9", 30, [[9e4, 0, 0, 0]]))
    assert (7 << 32) + 1 in step(again, 30).tracks.ids.tolist()


def test_the_evidence_for_a_number_is_in_the_checkpoint() -> None:
    """One datum of two that are needed, a restart, and the other; without what is kept it would take three."""
    weights = [1.0, 1.9, 1.9]
    told = []
    for restart in (False, True):
        one = centre(("r1",))
        for second, weight in enumerate(weights, 1):
            if restart and second == 3:
                one = IntensityCentre(one.config, one.checkpoint())
            give(one, intensity("r1", second, STATES[:1], weight))
            told.append(len(step(one, second).tracks.ids))
    assert told == [1, 1, 2] * 2


def test_names_of_sources_do_not_matter() -> None:
    """The same reports under other names, hence in another order: the same places and numbers, to rounding."""
    said = {"a": (3, Disk(9000.0), 0.7, SITE), "b": (2, None, None, None), "c": (1, Disk(6000.0), 0.9, None)}
    pictures = []
    for names in (("a", "b", "c"), ("c", "a", "b"), ("b", "c", "a")):
        one = centre(())
        for name, (count, coverage, p, covariance) in zip(names, said.values(), strict=True):
            give(one, info(name, coverage=coverage, detection_probability=p, position_covariance=covariance))
            give(one, intensity(name, 1, STATES[:count] + 10.0 * count, [0.9, 2.1, 0.8][:count]))
        result = step(one, 1).tracks
        order = np.lexsort((result.means[:, 1].round(3), result.means[:, 0].round(3)))
        pictures.append((result.means[order], result.covariances[order], result.existence[order]))
    assert len(pictures[0][0]) >= 3
    for other in pictures[1:]:
        for a, b in zip(pictures[0], other, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def test_a_place_carries_a_bounded_number_of_tracks() -> None:
    for extract in ("threshold", "rank"):
        one = centre(("r1",), intensity_extract=extract)
        for second in (1, 2, 3):
            give(one, intensity("r1", second, STATES, [1000.0, 3.0, 0.9]))
            result = step(one, second)
        assert len(result.tracks.ids) == 24
        assert (result.tracks.status == CONFIRMED).all()
        assert result.status.tracks["expected"] == 1004


def test_an_old_checkpoint_can_be_used_and_a_spoiled_one_not() -> None:
    one = centre(("r1",))
    give(one, intensity("r1", 1, STATES))
    step(one, 1)
    packed = msgpack.unpackb(one.checkpoint(), strict_map_key=False)
    del packed["own"]
    old: Any = IntensityCentre(one.config, msgpack.packb(packed))
    give(old, intensity("r1", 2, STATES))
    assert len(step(old, 2).tracks.ids) == 3
    for spoiled in (7, {}, {"memory": {}, "heard": {}, "total": 0, "total_lean": 0.0}):
        with pytest.raises(CheckpointError, match="cannot be read"):
            IntensityCentre(one.config, msgpack.packb({**packed, "own": spoiled}))


def test_a_mission_is_made_again_from_its_logs(monkeypatch: pytest.MonkeyPatch) -> None:
    config = {"lateness": 2.0, "sources": {"r1": {"registration_sigma": 50.0}}}
    one: Any = IntensityCentre(config, generation=1, epoch=100)
    recorded: list[Any] = []
    rng = np.random.default_rng(1)
    for second in range(1, 8):
        sent: list[Any] = [
            intensity(n, second, STATES + rng.normal(size=(3, 4)), rng.uniform(0, 2.2, 3)) for n in ("r1", "r2")
        ]
        sent += [info("r1", seq=second), sent[0], tracks("r2", second, STATES)]
        give(one, *sent)
        result = step(one, second)
        recorded += [*sent, result.tracks, result.log]
    monkeypatch.setattr(fuse_again, "FusionCentre", IntensityCentre)
    pairs = fuse_again.again(one.config, recorded)
    assert len(pairs) == 7
    assert not fuse_again.differing(pairs)


@lru_cache
def radars(seed: int) -> list[schemas.Message]:
    """What the three radars with a GM-PHD filter each say in 300 s."""
    out: list[schemas.Message] = []
    for name in world.RADARS:
        for k, event in enumerate(world.radar_events(name, seed, tracker="gm-phd")):
            header: dict[str, Any] = {"source": name, "epoch": 1, "seq": k, "sent": event.time, "origin": "simulated"}
            if event.kind == "info":
                out.append(schemas.SensorInfo(**header, **event.fields))
            else:
                out.append(schemas.LocalIntensity(**header, time=event.time, **event.fields))
    return out


def mean_gospa(seed: int, names: Sequence[str], **config: Any) -> tuple[float, float, float]:
    """GOSPA (c = 5 km, m) of the confirmed tracks from 50 s on, its localisation part per target held (m), and the
    expected less the true number in view of any radar."""
    one = IntensityCentre({"coast": 10.0, "frame": world.RADARS["radar1"], **config})
    for message in radars(seed):
        if message.source in names:
            one.handle(message, message.sent)
    distance, error, gap = [], [], []
    for second in range(10, 301, 10):
        result = one.step(world.START + second * SECOND)
        if second < 50:
            continue
        true = world.true_states(np.array([float(second)]))
        states = world._in_frame(true, world.RADARS["radar1"])[0, :, :2]
        confirmed = result.tracks.status == CONFIRMED
        found = gospa(states, result.tracks.means[confirmed, :2], c=5e3)
        held = max(int((found.assignment >= 0).sum()), 1)
        seen = [np.hypot(*world._in_frame(true, frame)[0, :, :2].T) < 300e3 for frame in world.RADARS.values()]
        distance.append(found.distance)
        error.append((found.localisation / held) ** 0.5)
        gap.append(mass(one) - np.any(seen, axis=0).sum())
    return float(np.mean(distance)), float(np.mean(error)), float(np.mean(gap))


@pytest.mark.parametrize("seed", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_three_radars_together_are_better_than_the_best_of_them(seed: int) -> None:
    names = list(world.RADARS)
    alone = [mean_gospa(seed, [name])[0] for name in names]
    aa, ga, hybrid = (mean_gospa(seed, names, intensity_rule=rule) for rule in ("aa", "ga", "hybrid"))
    print(f"alone {np.round(alone)}, aa {np.round(aa, 2)}, ga {np.round(ga, 2)}, hybrid {np.round(hybrid, 2)}")
    assert hybrid[0] < 0.75 * min(alone)
    assert hybrid[1] < 0.85 * aa[1], "the place of ga is better than that of aa"
    assert ga[0] > 1.3 * hybrid[0], "ga loses what one source misses"
    assert abs(hybrid[2]) < 1.0
    assert ga[2] < -2.0


def test_a_new_track_is_tentative_until_it_is_seen_again() -> None:
    one = centre(("r1",))
    give(one, intensity("r1", 1, STATES[:1]))
    assert step(one, 1).tracks.status.tolist() == [TENTATIVE]
    give(one, intensity("r1", 2, STATES[:1]))
    assert step(one, 2).tracks.status.tolist() == [CONFIRMED]


def test_many_sources_are_fused_like_few() -> None:
    """More sources than bits in a word."""
    names = [f"r{k:02}" for k in range(70)]
    one = centre(names)
    give(one, *(intensity(name, 1, STATES, np.array([0.9, 0.8, 0.7])) for name in names))
    result = step(one, 1)
    assert len(result.tracks.ids) == 3
    np.testing.assert_allclose(np.sort(result.tracks.existence), [0.7, 0.8, 0.9])


def test_the_newest_intensity_counts_whatever_came_last() -> None:
    one = centre(("r1",))
    give(one, intensity("r1", 2, STATES[:1], seq=2), intensity("r1", 1, STATES, seq=3))
    step(one, 2)
    assert mass(one) == pytest.approx(0.9)
    give(one, intensity("r1", 1.5, STATES, seq=4))
    step(one, 3)
    assert mass(one) == pytest.approx(0.9)
