"""The same missions scored by Stone Soup (the extra `oracle`), where it is installed.

Two choices of its own: its OSPA assigns by the sum of the distances, not of their p-th powers, so for p > 1 it may be
larger than the metric; its SIAP fails on an association of a single instant, so there is none here.
"""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Any

import numpy as np
import pytest

from fusion_service.arrays import Floats
from fusion_service.metrics import gospa, ospa
from fusion_service.review.evaluation import Evaluation, evaluate
from schemas import Message
from tests.helpers.missions import picture, truth

pytest.importorskip("stonesoup", reason="the extra oracle")

from stonesoup.dataassociator.tracktotrack import TrackToTruth
from stonesoup.measures import Euclidean
from stonesoup.metricgenerator.manager import MultiManager
from stonesoup.metricgenerator.ospametric import GOSPAMetric, OSPAMetric
from stonesoup.metricgenerator.tracktotruthmetrics import SIAPMetrics
from stonesoup.types.groundtruth import GroundTruthPath, GroundTruthState
from stonesoup.types.state import State
from stonesoup.types.track import Track

Lines = dict[int, tuple[int, Floats]]
"""Number -> first time, and states (L, 4): x, vx, y, vy, one a second."""
SEED = 20251126
START = datetime(2025, 1, 1)
C = 40.0


def lines(rng: np.random.Generator) -> tuple[Lines, Lines]:
    """Targets 200 m apart. Tracks: good ones, doubles, false ones, some that go over to another target."""
    steps = 30
    targets: Lines = {}
    tracks: Lines = {}
    for target in range(6):
        first = int(rng.integers(0, 8))
        count = steps - first - int(rng.integers(0, 6))
        speed = rng.normal(0, 3)
        t = np.arange(first, first + count)
        targets[target] = first, np.stack([speed * t, np.full(count, speed), 200.0 * target + 0 * t, 0 * t], axis=1)

    def follow(number: int, target: int, begin: int, end: int) -> None:
        first, states = targets[target]
        mine = states[max(begin - first, 0) : max(end - first, 0)]
        noisy = mine + rng.normal(0, [8, 1, 8, 1], mine.shape)
        if number in tracks:
            noisy = np.concatenate([tracks[number][1], noisy])
            tracks[number] = tracks[number][0], noisy
        else:
            tracks[number] = max(begin, first), noisy

    follow(0, 0, 0, 40)
    follow(1, 1, 0, 16)
    follow(2, 1, 14, 40)
    follow(3, 2, 9, 15)
    follow(3, 3, 15, 22)
    follow(4, 2, 15, 40)
    follow(5, 3, 10, 20)
    follow(6, 4, 12, 18)
    tracks[7] = 5, rng.normal([5000, 0, 0, 0], 3, (9, 4))
    tracks[8] = 11, rng.normal([-5000, 0, 0, 0], 3, (5, 4))
    return targets, tracks


def at_times(all_lines: Lines) -> list[tuple[list[int], Floats]]:
    found = []
    for k in range(30):
        here = {n: states[k - first] for n, (first, states) in all_lines.items() if 0 <= k - first < len(states)}
        found.append((list(here), np.array(list(here.values())).reshape(-1, 4)))
    return found


def ours(targets: Lines, tracks: Lines) -> Evaluation:
    mission: list[Message] = []
    for k, ((ids, states), (shown, estimates)) in enumerate(zip(at_times(targets), at_times(tracks), strict=True)):
        mission.append(truth(k, [n + 1 for n in ids], [], means=states))
        mission.append(picture(k, [n + 1 for n in shown], [], means=estimates))
    return evaluate(mission, c=C, every=1.0)


def theirs(targets: Lines, tracks: Lines) -> dict[str, Any]:
    def when(k: int) -> datetime:
        return START + timedelta(seconds=k)

    paths = {
        GroundTruthPath([GroundTruthState(state, timestamp=when(first + i)) for i, state in enumerate(states)])
        for first, states in targets.values()
    }
    tracked = {
        Track([State(state, timestamp=when(first + i)) for i, state in enumerate(states)])
        for first, states in tracks.values()
    }
    place = Euclidean((0, 2))
    manager = MultiManager(
        [
            GOSPAMetric(p=2, c=C, measure=place, generator_name="gospa"),
            OSPAMetric(p=1, c=C, measure=place, generator_name="ospa"),
            SIAPMetrics(position_measure=place, velocity_measure=Euclidean((1, 3)), generator_name="siap"),
        ],
        TrackToTruth(association_threshold=C, consec_pairs_confirm=1, consec_misses_end=1),
    )
    manager.add_data({"groundtruth_paths": paths, "tracks": tracked})
    found: dict[str, Any] = manager.generate_metrics()
    return found


@pytest.mark.parametrize("seed", [SEED, SEED + 1, SEED + 2])
def test_gospa_ospa_and_siap_of_a_mission(seed: int) -> None:
    targets, tracks = lines(np.random.default_rng(seed))
    result, other = ours(targets, tracks), theirs(targets, tracks)
    series, siap = result.fused.series, result.fused.siap
    times = len(result.times)
    gospas = [one.value for one in other["gospa"]["GOSPA Metrics"].value][:times]
    np.testing.assert_allclose(series.gospa, [one["distance"] for one in gospas], rtol=1e-9)
    np.testing.assert_allclose(series.localisation, [one["localisation"] for one in gospas], rtol=1e-9)
    np.testing.assert_allclose(series.missed, [one["missed"] for one in gospas])
    np.testing.assert_allclose(series.false, [one["false"] for one in gospas])
    found = {name: metric.value for name, metric in other["siap"].items()}
    for name, value in (
        ("Completeness", siap.completeness),
        ("Ambiguity", siap.ambiguity),
        ("Spuriousness", siap.spuriousness),
        ("Position Accuracy", siap.position_accuracy),
        ("Velocity Accuracy", siap.velocity_accuracy),
        ("Rate of Track Number Change", siap.track_number_changes),
        ("Longest Track Segment", siap.longest_segment),
    ):
        assert value == pytest.approx(found[f"SIAP {name}"], rel=1e-9), f"{name}, seed {seed}"
    for name, values in (
        ("Completeness", series.completeness),
        ("Ambiguity", series.ambiguity),
        ("Spuriousness", series.spuriousness),
    ):
        over_time = np.array([one.value for one in found[f"SIAP {name} at times"]])[:times]
        known = np.isfinite(values)
        np.testing.assert_allclose(values[known], over_time[known], rtol=1e-9, err_msg=name)
    assert siap.ambiguity > 1
    assert siap.track_number_changes > 0
    assert 0 < siap.spuriousness < 1


def test_gospa_and_ospa_of_random_sets() -> None:
    rng = np.random.default_rng(SEED)
    place = Euclidean((0, 1))
    for _ in range(60):
        a, b = (rng.uniform(0, 100, (rng.integers(1, 12), 2)) for _ in range(2))
        left, right = ([State(row, timestamp=START) for row in rows] for rows in (a, b))
        for p in (1, 2):
            generator = GOSPAMetric(p=p, c=25.0, measure=place)
            want = generator.compute_gospa_metric(right, left)[0].value
            got = gospa(a, b, 25.0, p=p)
            assert got[:4] == pytest.approx([want[name] for name in ("distance", "localisation", "missed", "false")])
            other = OSPAMetric(p=p, c=25.0, measure=place).compute_OSPA_distance(right, left).value
            assert ospa(a, b, 25.0, p=p) <= other + 1e-9
            if p == 1:
                assert ospa(a, b, 25.0, p=p) == pytest.approx(other)
