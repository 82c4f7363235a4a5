"""Scores of missions whose answer is known by hand, by statistics, or by scoring track by track."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np
import pymap3d
import pytest

from fusion_service.metrics import gospa, ospa
from fusion_service.review.evaluation import METRICS, evaluate, format_table
from schemas import Disk, Ecef, Enu, Message, Truth
from tests.helpers.missions import FRAME, START, STILL, at, info, picture, still, tracks, truth

SEED = 20250705


def missed(mission: Sequence[Message], name: str = "a", **rest: Any) -> list[int]:
    """The mission seconds at which source `name` had no track on the first target."""
    result = evaluate(mission, c=10.0, every=1.0, **rest)
    errors = result.sources[name].errors[:, 0]
    assert result.sources[name].gospa_missed == pytest.approx(50.0 * np.isnan(errors).mean())
    return [(int(t) - START) // 10**9 for t in result.times[np.isnan(errors)]]


def test_perfect_tracks_score_zero_in_any_frame() -> None:
    """The same places told in another ENU frame, in ECEF and in the centre's own: converted here by pymap3d."""
    lat, lon, zero = np.array([60.0, 60.3, 59.2]), np.array([10.1, 9.0, 12.0]), np.zeros(3)
    ids, other = [7, 8, 9], Enu(61.0, 8.0, 200.0)
    xyz = ("x", "y", "z")

    def enu(frame: Enu) -> np.ndarray[Any, Any]:
        return np.array(pymap3d.geodetic2enu(lat, lon, zero, frame.lat, frame.lon, frame.alt)).T

    ecef = np.array(pymap3d.geodetic2ecef(lat, lon, zero)).T
    mission: list[Message] = [info("other"), info("ecef"), info("flat")]
    for t in range(5):
        mission += [
            truth(t, ids, [], means=ecef, space=xyz, frame=Ecef()),
            tracks("other", t, ids, [], means=enu(other), space=xyz, frame=other),
            tracks("ecef", t, ids, [], means=ecef, space=xyz, frame=Ecef()),
            tracks("flat", t, ids, enu(other)[:, :2].tolist(), frame=other),
            picture(t, ids, enu(FRAME)[:, :2].tolist()),
        ]
    result = evaluate(mission, c=10.0, every=None)
    for scores in (*result.sources.values(), result.fused):
        assert scores.gospa < 1e-6
        assert scores.rmse_position < 1e-6
        assert scores.identity_switches == 0
    assert result.targets == (7, 8, 9)
    assert result.seen.tolist() == [[3, 3, 3]] * 5
    assert result.as_json("s", "ci", "r")["scored"]["dimension"] == 2


def test_scores_of_noisy_tracks_are_those_of_their_noise() -> None:
    """Errors drawn from the covariance the tracks state. The source reports half a second before the scored times and
    is predicted by its motion, whose noise the truth has too. Mean square error: standard error P sqrt(2 / pairs)."""
    rng = np.random.default_rng(SEED)
    targets, steps, q = 40, 50, 4.0
    start = np.stack(np.meshgrid(np.arange(8), np.arange(5)), axis=-1).reshape(-1, 2) * 1e4
    P = np.array([[100.0, 20.0], [20.0, 25.0]])
    F, Q = np.array([[1, 0.5], [0, 1]]), q * np.array([[0.5**3 / 3, 0.5**2 / 2], [0.5**2 / 2, 0.5]])
    root, root_q = np.linalg.cholesky(P), np.linalg.cholesky(Q)
    covs = np.tile(np.kron(np.eye(2), P), (targets, 1, 1))
    velocity = rng.uniform(-50, 50, (targets, 2))
    mission: list[Message] = [info("a", q=q)]
    ids = range(targets)
    for k in range(1, steps + 1):
        # Truth: x, vx per axis at k - 1/2, then its exact motion to k.
        before = np.stack([start, velocity], axis=-1)
        after = before @ F.T + rng.standard_normal((targets, 2, 2)) @ root_q.T
        estimate = before + rng.standard_normal((targets, 2, 2)) @ root.T
        mission += [
            truth(k, list(ids), after.reshape(targets, 4).tolist()),
            tracks("a", k - 0.5, list(ids), estimate.reshape(targets, 4).tolist(), covariances=covs),
            picture(k, list(ids), (after[..., 0] + 3.0 * rng.standard_normal((targets, 2))).tolist(), sigma=3.0),
        ]
    result = evaluate(mission, c=1000.0, every=1.0)
    pairs = targets * steps
    source, variance = result.sources["a"], 2 * (F @ P @ F.T + Q)[0, 0]
    assert source.rmse_position**2 == pytest.approx(variance, rel=5 / np.sqrt(pairs)), f"seed {SEED}"
    assert source.anees == pytest.approx(1.0, abs=5 / np.sqrt(pairs))
    assert result.fused.rmse_position**2 == pytest.approx(18.0, rel=5 / np.sqrt(pairs))
    assert result.fused.anees == pytest.approx(1.0, abs=5 / np.sqrt(pairs))
    assert source.gospa_localisation == pytest.approx(targets * source.rmse_position**2)
    assert source.gospa_missed == source.gospa_false == 0.0
    assert source.bounds[0] < 1 < source.bounds[1]


def test_against_scoring_one_track_at_a_time() -> None:
    """A random mission, scored again by its definitions: straight-line prediction and all permutations."""
    rng, c = np.random.default_rng(SEED), 60.0
    mission: list[Message] = [info(name, period=2.0) for name in ("a", "b")]
    kept: dict[str, list[tuple[float, list[int], np.ndarray[Any, Any]]]] = {"a": [], "b": []}
    objects = rng.uniform(-100, 100, (4, 2))
    mission += [truth(t, [1, 2, 3, 4], (objects + t).tolist()) for t in range(21)]
    mission += [picture(t, [], []) for t in range(21)]
    for name, offset in (("a", 0.0), ("b", 0.7)):
        for t in np.arange(offset, 20, 2.0):
            ids = sorted(rng.choice(6, rng.integers(0, 5), replace=False).tolist())
            rows = np.column_stack([rng.uniform(-100, 120, (len(ids), 4))])
            rows[:, [1, 3]] = rng.normal(1, 2, (len(ids), 2))
            mission.append(tracks(name, float(t), ids, rows.tolist()))
            kept[name].append((float(t), ids, rows))
    result = evaluate(mission, c=c, every=1.0)
    assert len(result.times) == 21
    for name, scans in kept.items():
        distances, squares = [], []
        for t in range(21):
            last = [scan for scan in scans if scan[0] <= t][-1:]
            found = [r[[0, 2]] + r[[1, 3]] * (t - s) for s, _, rows in last for r in rows]
            cost = np.array([[min(float(np.hypot(*(o + t - f))), c) ** 2 for o in objects] for f in found])
            best = min(
                (sum(cost[i, j] for i, j in enumerate(chosen)), chosen) for chosen in permutations(range(4), len(found))
            )
            distances.append(np.sqrt(best[0] + c**2 / 2 * (4 - len(found))))
            squares += [cost[i, j] for i, j in enumerate(best[1]) if cost[i, j] < c**2]
        assert result.sources[name].gospa == pytest.approx(np.mean(distances))
        assert result.sources[name].rmse_position == pytest.approx(np.sqrt(np.mean(squares)))
    assert result.fused.gospa == pytest.approx(np.sqrt(4 * c**2 / 2))
    assert np.isnan(result.fused.rmse_position)


def test_a_source_shows_a_track_until_it_is_stale_or_gone() -> None:
    mission = still(12)
    gone = [tracks("a", 1, [5], STILL), tracks("a", 3, [], [])]
    assert missed([info("a", 2.0), *mission, *gone]) == [0, *range(3, 13)], "left out by a complete scan"
    open_scan = [tracks("a", 1, [5], STILL), tracks("a", 3, [], [], complete=False)]
    assert missed([info("a", 2.0), *mission, *open_scan]) == [0, *range(8, 13)], "older than three periods"
    assert missed([info("a", 2.0), *mission, *gone[::-1]]) == [0, *range(3, 13)], "whatever the order of arrival"
    again = [tracks("a", 1, [5], STILL), tracks("a", 4, [6], [[500.0, 0.0]], epoch=2, complete=False)]
    assert missed([info("a", 9.0), *mission, *again]) == [0, *range(4, 13)], "a new epoch drops the old tracks"
    late = [tracks("a", 2, [6], STILL, epoch=2), tracks("a", 4, [], [], epoch=1)]
    assert missed([info("a", 9.0), *mission, *late]) == [0, 1], "an old epoch says nothing any more"
    for bad in ({"means": np.full((1, 4), np.nan)}, {"covariances": -np.eye(4)[None]}):
        unsound = tracks("a", 1, [5], STILL, **bad)
        assert missed([info("a", 9.0), *mission, unsound]) == list(range(13)), "no numbers, no track"
    every_third = [tracks("a", t, [5], STILL) for t in (0, 3)]
    assert missed([*mission, *every_third]) == [], "without info: the median interval"


def test_the_newest_info_counts() -> None:
    mission = [*still(6), tracks("a", 1, [5], STILL, epoch=2)]
    infos = [info("a", period=9.0, epoch=2), info("a", period=1.0, epoch=1)]
    assert missed([*infos, *mission]) == missed([*infos[::-1], *mission]) == [0]


def test_the_centre_shows_confirmed_and_coasting_tracks() -> None:
    objects = [[0.0, 0.0], [100.0, 0.0], [200.0, 0.0]]
    status = np.array([0, 1, 2], dtype=np.uint8)
    mission: list[Message] = [
        m for t in range(4) for m in (truth(t, [1, 2, 3], objects), picture(t, [1, 2, 3], objects, status=status))
    ]
    result = evaluate(mission, c=10.0, every=None)
    np.testing.assert_array_equal(np.isnan(result.fused.errors), [[True, False, False]] * 4)
    assert result.fused.gospa_missed == 50.0
    assert result.fused.tracks == 2
    assert result.sources == {}
    assert "several sources" not in format_table(result)


def test_the_centre_is_predicted_and_ages_out() -> None:
    """Pictures at 0, 2, 4 s; scored each second to 10: shown until 4 + 2 * 2 s, by cv with its source's q."""
    path = [[10.0 * t, 10.0, 0.0, 0.0] for t in range(11)]
    mission: list[Message] = [truth(t, [1], [path[t]]) for t in range(11)]
    mission += [picture(t, [1], [path[t]], sigma=2.0) for t in (0, 2, 4)]
    mission += [info("a", q=6.0), tracks("a", 0, [1], [path[0]])]
    result = evaluate(mission, c=10.0, every=1.0)
    assert np.flatnonzero(np.isnan(result.fused.errors[:, 0])).tolist() == [9, 10]
    assert result.fused.rmse_position == pytest.approx(0.0)
    off = evaluate(
        [*mission[:11], *(picture(t, [1], [[10.0 * t + 3, 10, 0, 0]], 2.0) for t in (0, 2, 4)), *mission[14:]],
        c=10.0,
        every=1.0,
    )
    variance = 4 + 4 * 1 + 6 / 3
    assert off.fused.nees[1, 0] == pytest.approx(9 / variance / 2)


def test_truth_is_interpolated_but_not_across_gaps() -> None:
    """Object 1 is told at uneven times, one object per message, out of order, with a hole from 4 to 14 s."""
    times = [0.0, 1.5, 2.5, 4.0, 14.0, 15.0, 16.0]
    mission: list[Message] = [truth(t, [1], [[10 * t, -t]]) for t in times[::-1]]
    mission += [truth(t, [2], [[500.0, 0.0]]) for t in (3.0, 5.0, 7.0, 9.0)]
    mission += [info("a"), *(tracks("a", t, [1], [[10.0 * t, 1.0 - t]]) for t in range(17))]
    mission += [picture(t, [], []) for t in range(17)]
    result = evaluate(mission, c=10.0, every=1.0)
    np.testing.assert_array_equal(np.flatnonzero(result.exists[:, 0]), [0, 1, 2, 3, 4, 14, 15, 16])
    np.testing.assert_array_equal(np.flatnonzero(result.exists[:, 1]), [3, 4, 5, 6, 7, 8, 9])
    np.testing.assert_allclose(result.sources["a"].errors[result.exists[:, 0], 0], 1.0)
    wide = evaluate(mission, c=10.0, every=1.0, gap=10.0)
    assert wide.exists[:, 0].all()
    slow: list[Message] = [*(truth(t, [1], STILL) for t in (0, 10, 20)), *(picture(t, [1], STILL) for t in range(21))]
    assert evaluate(slow, c=10.0, every=1.0).exists.all(), "three of its own intervals are no gap"


def test_scored_times() -> None:
    """Multiples of `every` in UTC, or the centre's steps; only while there is truth."""
    mission: list[Message] = [
        *(truth(t, [1], STILL) for t in (0.3, 3.3, 5.9)),
        *(picture(t, [1], STILL) for t in (0.0, 1.5, 4.5, 6.0)),
    ]
    assert evaluate(mission, c=10.0, every=None).times.tolist() == [at(1.5), at(4.5)]
    assert evaluate(mission, c=10.0, every=2.0).times.tolist() == [at(2), at(4)]


def test_shared_targets_by_hand() -> None:
    """Sources err by 3 m and 4 m, the fused tracks by 1 m. Both see target 1, one target 2; none fused at 4 s."""
    mission: list[Message] = [info("a"), info("b"), info("far")]
    for t in range(5):
        mission += [
            truth(t, [1, 2], [[0.0, 0.0], [100.0, 0.0]]),
            tracks("a", t, [1, 2], [[3.0, 0.0], [100.0, 3.0]], sigma=2.0),
            tracks("b", t, [1], [[0.0, 4.0]], sigma=1.0),
            tracks("far", t, [1], [[0.0, 4000.0]]),
            picture(t, [1, 2], [[0.0, -1.0], [100.0, -5.0]]) if t < 4 else picture(t, [], []),
        ]
    result = evaluate(mission, c=10.0, every=None)
    row = result.shared["seen_by_2"]
    assert (row["pairs"], row["fused_missed"]) == (4, 1)
    assert (row["fused_rmse"], row["best_rmse"]) == pytest.approx((1.0, 3.0))
    assert (row["fused_anees"], row["best_anees"]) == pytest.approx((0.5, 9 / 4 / 2))
    assert result.shared["seen_by_2_or_more"] == row
    assert result.shared["seen_by_3"]["pairs"] == 0
    assert result.seen.tolist() == [[2, 1]] * 5
    assert result.sources["far"].gospa == pytest.approx(np.sqrt(150.0))


def test_best_single_source_is_chosen_per_target_on_the_same_pairs() -> None:
    """b is better on target 1, a on target 2; at 3 s only b and c see target 1, at 4 s nobody but a."""
    mission: list[Message] = [info(name) for name in "abc"]
    for t in range(5):
        mission += [truth(t, [1, 2], [[0.0, 0.0], [100.0, 0.0]]), picture(t, [1, 2], [[0.0, 0.0], [100.0, 0.0]])]
        mission.append(tracks("a", t, [2] if t == 3 else [1, 2], [[100.0, 2.0]] if t == 3 else [[5, 0], [100.0, 2.0]]))
        mission.append(tracks("b", t, [2] if t == 4 else [1, 2], [[100.0, 6.0]] if t == 4 else [[1, 0], [100.0, 6.0]]))
        mission.append(tracks("c", t, [1] if t == 3 else [], [[0.0, 7.0]] if t == 3 else []))
    row = evaluate(mission, c=10.0, every=None).shared["seen_by_2"]
    assert row["pairs"] == 4 + 5
    assert row["best_rmse"] == pytest.approx(np.sqrt((4 * 1 + 5 * 4) / 9))
    assert row["fused_rmse"] == 0.0


def test_identity_switches_of_source_and_centre() -> None:
    """Local ids 5, 5, then 5 of a new epoch: one switch. Global ids 1 1 2 . 2 1: two."""
    mission: list[Message] = [info("a"), *(truth(t, [1], STILL) for t in range(6))]
    mission += [tracks("a", t, [5], STILL, epoch=1 if t < 2 else 2) for t in range(6)]
    mission += [
        picture(t, [] if i is None else [i], [] if i is None else STILL) for t, i in enumerate([1, 1, 2, None, 2, 1])
    ]
    result = evaluate(mission, c=10.0, every=None)
    assert (result.sources["a"].identity_switches, result.fused.identity_switches) == (1, 2)


def test_mixtures_count_as_their_mean_and_covariance() -> None:
    """Two components at -1 and 3 with weights 1/4, 3/4: mean 2, variance 1 + 3."""
    own: dict[str, Any] = {"counts": np.array([2], dtype=np.uint16), "weights": np.array([0.25, 0.75])}
    mission: list[Message] = [
        *still(2),
        info("a"),
        *(tracks("a", t, [5], [[-1.0, 0.0], [3.0, 0.0]], **own) for t in range(3)),
    ]
    scores = evaluate(mission, c=10.0, every=None).sources["a"]
    np.testing.assert_allclose(scores.errors, 2.0)
    np.testing.assert_allclose(scores.nees, 4 / 4 / 2)


def test_order_of_messages_does_not_matter_and_json_is_plain() -> None:
    rng = np.random.default_rng(SEED)
    mission: list[Message] = [info("a"), info("b", period=2.0), *still(10)]
    mission += [tracks("a", t, [1, 2], rng.normal(0, 3, (2, 2)).tolist()) for t in range(11)]
    mission += [tracks("b", t, [1], rng.normal(0, 3, (1, 2)).tolist()) for t in range(0, 11, 2)]
    result = evaluate(mission, c=10.0, every=1.0)
    told = result.as_json("made-up", "ci", "mission.rrd")
    assert list(told)[:5] == ["scenario", "rule", "recording", "sources", "fused"]
    assert tuple(told["fused"]) == tuple(told["sources"]["a"]) == METRICS
    text = json.dumps(told, allow_nan=False)
    for _ in range(3):
        shuffled = [mission[i] for i in rng.permutation(len(mission))]
        assert json.dumps(evaluate(iter(shuffled), c=10.0, every=1.0).as_json("made-up", "ci", "mission.rrd")) == text


def test_the_table_is_aligned_and_says_the_numbers() -> None:
    mission: list[Message] = [*still(4), info("a"), info("long-name")]
    mission += [tracks("a", t, [1], [[3.0, 0.0]]) for t in range(5)]
    mission += [tracks("long-name", t, [1, 2], [[0.0, 4.0], [900.0, 0.0]], sigma=2.0) for t in range(5)]
    lines = format_table(evaluate(mission, c=10.0, every=None)).splitlines()
    head = next(i for i, line in enumerate(lines) if "GOSPA" in line and "localis." in line)
    assert lines[head + 1].split() == ["a", *["3.000", "3.000", "9.000", "0", "0", "4.50", "0.32", "-", "2.05", "0"]]
    assert lines[head + 2].split()[:6] == ["long-name", "4.000", "8.124", "16.00", "0", "50.00"]
    assert lines[head + 3].startswith("fused (centre)")
    assert len({len(line) for line in lines[head : head + 4]}) == 1
    pairs = next(line for line in lines if line.startswith("seen by 2 "))
    assert pairs.split()[3:6] == ["5", "0", "3.000"]


def test_time_to_confirm_by_hand() -> None:
    """Target 1 is covered from the start and confirmed at 3 s; target 2 has a local track from 2 s and is confirmed at
    5 s; target 3 is tracked but never confirmed; target 4 is neither covered nor tracked, though a fused track is there
    from 4 s on; target 5 is covered and confirmed at once."""
    places = [[0.0, 0.0], [5000.0, 0.0], [6000.0, 0.0], [7000.0, 0.0], [100.0, 0.0]]
    mission: list[Message] = [info("a", coverage=Disk(1000.0)), info("b")]
    for t in range(8):
        mission.append(truth(t, [1, 2, 3, 4, 5], places))
        mission.append(tracks("b", t, [2, 3] if t >= 2 else [], places[1:3] if t >= 2 else []))
        shown = [n for n, since in ((1, 3), (2, 5), (4, 4), (5, 0)) if t >= since]
        mission.append(picture(t, shown, [places[n - 1] for n in shown]))
    result = evaluate(mission, c=50.0, every=None)
    np.testing.assert_array_equal(result.begins, [0, 2, 2, -1, 0])
    np.testing.assert_array_equal(result.confirm, [3.0, 3.0, np.nan, np.nan, 0.0])
    assert result.fused.followed == 3, "targets 1, 4 and 5; target 2 for 3 of 8 times only"


def test_ospa_and_velocity_over_time() -> None:
    rng = np.random.default_rng(SEED)
    mission: list[Message] = []
    sets = []
    for t in range(12):
        there, shown = (rng.uniform(0, 60, (rng.integers(1, 7), 4)) for _ in range(2))
        sets.append((there, shown))
        ids = [[10 * t + n for n in range(len(rows))] for rows in (there, shown)]
        mission += [truth(t, ids[0], [], means=there), picture(t, ids[1], [], means=shown)]
    result = evaluate(mission, c=20.0, every=None)
    for k, (there, shown) in enumerate(sets):
        assert result.fused.series.ospa[k] == pytest.approx(ospa(there[:, [0, 2]], shown[:, [0, 2]], 20.0))
        found = gospa(there[:, [0, 2]], shown[:, [0, 2]], 20.0)
        assert result.fused.series.gospa[k] == pytest.approx(found.distance)
        assert result.fused.series.false[k] == pytest.approx(found.false)
    squares = []
    for there, shown in sets:
        rows = np.flatnonzero((chosen := gospa(there[:, [0, 2]], shown[:, [0, 2]], 20.0).assignment) >= 0)
        squares.append(((there[rows] - shown[chosen[rows]])[:, [1, 3]] ** 2).sum(axis=1))
    assert result.fused.rmse_velocity == pytest.approx(np.sqrt(np.concatenate(squares).mean()))
    flat = [replace(m, space=("x", "y"), means=m.means[:, [0, 2]]) if isinstance(m, Truth) else m for m in mission]
    assert np.isnan(evaluate(flat, c=20.0, every=None).fused.rmse_velocity), "truth says no velocity"
    assert np.isnan(evaluate(flat, c=20.0, every=None).fused.siap.velocity_accuracy)
