"""Missions without a bus give what the running processes gave, and the two studies of whole missions their claims."""

from __future__ import annotations

import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.demo import THREE_RADARS
from fusion_service.geodesy import transform
from fusion_service.process import data_folder
from fusion_service.review.evaluation import METRICS, Evaluation, evaluate
from schemas import GlobalTracks, LocalTracks, SensorInfo, Truth
from sensor_clients.scenarios.three_radars import RADARS, three_radars
from studies import missions
from studies.cli import main
from studies.experiments import autoferry
from studies.experiments import sharma_three_radars as radars
from studies.rules import fuser
from studies.study import MissingDataError, Result, Run

PAGE = Path(__file__).parents[2] / "docs" / "measurements.md"
DATA = data_folder("autoferry")
needs_data = pytest.mark.skipif(not DATA, reason="FUSION_DATA names no folder of the Autoferry recordings")


def table(head: str) -> dict[str, list[float]]:
    """A table of docs/measurements.md, which `python -m benchmarks.missions` made of missions with all processes."""
    lines = PAGE.read_text("utf-8").splitlines()
    start = next(number for number, line in enumerate(lines) if line.startswith(head))
    rows: dict[str, list[float]] = {}
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        name, *cells = (cell.strip() for cell in line.strip("|").split("|"))
        rows[name] = [float(cell) for cell in cells]
    return rows


def to_digits(value: float, digits: int) -> float:
    return float(f"{value:.{digits}g}")


@lru_cache
def mission() -> tuple[list[missions.Told], list[Truth]]:
    return missions.told(three_radars(), 1), missions.truths(three_radars())


@lru_cache
def flown(rule: str) -> list[GlobalTracks]:
    return missions.fuse(mission()[0], {**radars.SETTINGS, "rule": rule})


def score(pictures: list[GlobalTracks]) -> Evaluation:
    told, truth = mission()
    return evaluate([*told, *truth, *pictures], c=radars.CUTOFF, every=None)


def test_three_radars_score_as_in_the_running_system() -> None:
    known = table("| | GOSPA, m |")
    result = score(flown("naive"))
    ours = {**result.sources, "fused, `naive`": result.fused, "fused, `ci det`": score(flown("ci")).fused}
    ours["fused, `auto`"] = score(missions.fuse(mission()[0], {**tomllib.loads(THREE_RADARS), "lateness": 15.0})).fused
    for name, one in ours.items():
        numbers = (one.gospa, one.gospa_localisation, one.gospa_missed, one.gospa_false, one.rmse_position)
        rounded = [to_digits(value, 4 if place == 0 else 3) for place, value in enumerate(numbers)]
        assert [*rounded, round(one.anees, 2)] == known[name], name


@needs_data
def test_autoferry_scores_as_in_the_running_system() -> None:
    known = table("| scenario | lidar | radar | fused |")
    rows = []
    for number in autoferry.SCENARIOS:
        scores = autoferry.scored(Path(DATA or ""), number, {})
        fused = [getattr(scores["fused"], metric) for metric in METRICS]
        rows.append([scores["lidar"].gospa, scores["radar"].gospa, *fused[:6]])
        assert [to_digits(value, 4) for value in rows[-1]] == known[str(number)][:8]
    assert to_digits(float(np.mean(rows, axis=0)[2]), 4) == known["mean"][2] == 7.314


def test_order_among_equal_times_does_not_matter() -> None:
    told = [one for one in mission()[0] if isinstance(one, SensorInfo) or one.sent <= three_radars().start + 60e9]
    order = {name: number for number, name in enumerate(("radar3", "radar1", "radar2"))}
    other = sorted(told, key=lambda one: (one.sent, order[one.source]))
    assert [one.source for one in told] != [one.source for one in other]
    first, second = (missions.fuse(messages, radars.SETTINGS) for messages in (told, other))
    assert [one.step for one in first] == list(range(1, 8))
    assert [schemas.encode(one) for one in first] == [schemas.encode(one) for one in second]


def test_tracks_are_followed_as_evaluated() -> None:
    pictures, truth = flown("ci"), mission()[1]
    result = score(pictures)
    at = {one.time: one.means[:, [one.space.index(name) for name in radars.STATE]] for one in truth}
    for k, picture in enumerate(pictures):
        shown = picture.status != 0
        found = missions.follow(at[picture.time], picture.means[shown], picture.covariances[shown], radars.CUTOFF)
        np.testing.assert_allclose(np.sqrt(found[0]), result.fused.errors[k], rtol=1e-6, atol=1e-3)
        for target in np.flatnonzero(np.isfinite(found[0])):
            error = picture.means[shown] - at[picture.time][target]
            row = int(np.argmin(np.abs((error[:, :2] ** 2).sum(axis=1) - found[0, target])))
            nees = error[row] @ np.linalg.solve(picture.covariances[shown][row], error[row]) / 4
            assert found[1, target] == pytest.approx(nees, rel=1e-6)


def test_links_name_the_tracks_that_a_picture_is_made_of() -> None:
    """Under `naive`, a picture's information is the sum of that of its links."""
    pictures = flown("naive")
    local: dict[tuple[str, int], Any] = {}
    for one in mission()[0]:
        if isinstance(one, LocalTracks):
            moved = transform(one.means, one.covariances, one.space, one.frame, RADARS["radar1"], one.height)
            local[one.source, one.time] = one, *moved
    linked = radars.links(pictures, local)
    ids = np.unique(np.concatenate([one.ids for one in pictures]))
    checked = 0
    for k, picture in enumerate(pictures):
        for row, id_ in enumerate(picture.ids):
            g = int(np.flatnonzero(ids == id_)[0])
            assert linked.shown[k, g] == (picture.status[row] != 0)
            there = np.isfinite(linked.means[k, :, 0, g])
            assert there.sum() == picture.contributor_counts[row]
            if there.any():
                information = [np.linalg.inv(linked.covariances[k, s, :, :, g]) for s in np.flatnonzero(there)]
                vector = sum(
                    I @ linked.means[k, s, :, g] for I, s in zip(information, np.flatnonzero(there), strict=True)
                )
                P = np.linalg.inv(sum(information))
                np.testing.assert_allclose(picture.covariances[row], P, rtol=1e-6, atol=1e-6 * P.max())
                np.testing.assert_allclose(picture.means[row], P @ vector, rtol=1e-7, atol=1e-3)
                checked += 1
    assert checked > 400


def test_sequential_memory_under_naive_is_a_kalman_filter() -> None:
    """With the local tracks as measurements of the whole state: an independent recursion, with gaps."""
    rng = np.random.default_rng(11)
    K, S, G, n = 6, 3, 4, 4
    q, T = 10.0, radars.PERIOD
    root = rng.normal(size=(K, S, G, n, n))
    P = root @ root.swapaxes(-1, -2) + 3 * np.eye(n)
    x = rng.normal(size=(K, S, G, n)) * 5
    gone = rng.random((K, S, G)) < 0.4
    gone[:2, :, 3] = True
    x[gone], P[gone] = np.nan, np.nan
    linked = radars.Links(np.moveaxis(x, 2, -1), np.moveaxis(P, 2, -1), np.ones((K, G), dtype=np.bool_))
    means, covariances = radars.sequential(radars.Way(fuser("naive"), "sequential", q), linked)
    F = np.kron([[1, T], [0, 1]], np.eye(2))
    Q = q * np.kron([[T**3 / 3, T**2 / 2], [T**2 / 2, T]], np.eye(2))
    for g in range(G):
        mean, C = None, np.zeros((n, n))
        for k in range(K):
            if mean is not None:
                mean, C = F @ mean, F @ C @ F.T + Q
            for s in range(S):
                if gone[k, s, g]:
                    continue
                if mean is None:
                    mean, C = x[k, s, g], P[k, s, g]
                else:
                    gain = C @ np.linalg.inv(C + P[k, s, g])
                    mean, C = mean + gain @ (x[k, s, g] - mean), C - gain @ C
            if mean is None:
                assert np.isnan(means[k, :, g]).all()
            else:
                np.testing.assert_allclose(means[k, :, g], mean, rtol=1e-6, atol=1e-6)
                np.testing.assert_allclose(covariances[k, :, :, g], C, rtol=1e-6, atol=1e-6)


def test_scores_are_pooled_over_what_was_tracked() -> None:
    """Two steps, one target, two runs, by hand; the second run has no track at the second step."""
    scores = np.array([[[[1.0, 9.0]], [[4.0, np.nan]]], [[[1.0, 2.0]], [[30.0, np.nan]]]])
    one = missions.pooled(scores, 4)
    assert one.rmse.value == pytest.approx(np.sqrt(14 / 3))
    assert one.anees.value == pytest.approx(11)
    assert one.there.value == pytest.approx(0.75)
    assert one.high == 0.5  # 30 is above the interval of one run of dimension 4, (1 + 2) / 2 is not
    half = missions.less(missions.root_mean, scores, scores * 4)
    assert half.value == pytest.approx(-np.sqrt(14 / 3))


def test_the_best_source_is_the_one_of_least_error_that_tracks_for_half_the_time() -> None:
    scores = np.full((2, 3, 4, 2, 1), np.nan)
    scores[:, 0, :, 0] = 9.0
    scores[:, 1, :, 0] = 4.0
    scores[:, 2, :1, 0] = 1.0
    best = missions.best_source(scores)
    assert (best[:, :, 0] == 4.0).all()
    assert np.isnan(best[:, :, 1]).all()


@pytest.fixture(scope="module")
def quick() -> Result:
    return radars.run(Run(radars.STUDIES[0].quick, seed=1, rules=(fuser("ci:weights=uniform"),)))


def test_the_more_radars_the_less_error(quick: Result) -> None:
    rmse = {row.name: row.ours for row in quick.rows if row.quantity == "RMSE, m"}
    for way in ("ci restart", "hmd-ga recursive", "hmd-ga sequential"):
        assert rmse[f"A: {way}"] < 0.8 * rmse[f"B: {way}"] < 0.8**2 * rmse[f"C: {way}"]
    for category in "AB":
        assert rmse[f"{category}: hmd-ga sequential"] < 0.7 * rmse[f"{category}: best radar"]


def test_ci_is_the_most_conservative_where_several_radars_see(quick: Result) -> None:
    anees = {row.name: row.ours for row in quick.rows if row.quantity == "ANEES"}
    assert anees["A: ci sequential"] < anees["A: ici sequential"]
    assert anees["A: ci sequential"] < anees["A: hmd-ga sequential"]
    assert all(value < 1 for name, value in anees.items() if name.startswith(("A: ci", "B: ci")))


def test_a_rule_of_given_weights_is_fused_sequentially_only(quick: Result) -> None:
    names = {row.name for row in quick.rows}
    assert "A: ci:weights=uniform sequential" in names
    assert "A: ci:weights=uniform restart" not in names


def test_all_but_target_18_are_tracked(quick: Result) -> None:
    targets = {row.name.split(":")[0] for row in quick.rows if row.name.startswith("target")}
    assert targets == {f"target {number}" for number in range(1, 21) if number != 18}


@pytest.mark.parametrize("named", [False, True])
def test_missing_data_are_told_in_a_line(
    named: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FUSION_DATA", raising=False)
    with pytest.raises(MissingDataError, match="--data DIR or in FUSION_DATA"):
        autoferry.run(Run(5, data=tmp_path if named else None))
    assert main(["run", "autoferry", *(["--data", str(tmp_path)] if named else [])]) == 1
    told = capsys.readouterr().err.strip()
    assert "FUSION_DATA" in told
    assert "\n" not in told.split("autoferry: ")[-1]


@pytest.mark.slow
@needs_data
def test_autoferry_takes_rules_that_a_config_can_say() -> None:
    rules = (fuser("ci:criterion=trace"), fuser("ci:weights=uniform"))
    result = autoferry.run(Run(1, data=Path(DATA or ""), rules=rules))
    gospa = {row.name: row.ours for row in result.rows if row.quantity == "GOSPA, m"}
    assert {"lidar", "radar", "ci restart", "ci:criterion=trace recursive"} <= set(gospa)
    assert any("ci:weights=uniform is left out" in note for note in result.notes)
    assert gospa["ci restart"] < min(gospa["lidar"], gospa["radar"])
