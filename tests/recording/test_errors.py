"""Errors, NEES, counts and the log, against what the messages say."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest, chi2

from fusion_service.recording import Recorder
from fusion_service.recording.columns import Stamp
from fusion_service.recording.drawing.errors import StepErrors, TruthMatcher
from schemas import Message, encode, global_key, local_key
from tests.helpers import missions
from tests.recording.contents import entities, key_of, record, row, rows, texts
from tests.recording.mission import RADARS, SIGMA, START, TARGETS, Sent, mission, positions

SECOND = 10**9


def test_error_and_nees_per_target_are_those_of_the_messages(flown: tuple[Path, list[Sent]]) -> None:
    path, said = flown
    centre: list[Any] = [sent.message for sent in said if sent.key == global_key("main", "tracks")]
    step = 30
    apart = (centre[step].means - positions(float(step)))[:, ::2]
    for target in range(TARGETS):
        error = row(path, f"/error/main/{target + 1}", centre[step].time)["Scalars:scalars"]
        nees = row(path, f"/nees/main/{target + 1}", centre[step].time)["Scalars:scalars"]
        assert error == [pytest.approx(math.hypot(*apart[target]), rel=1e-9)]
        covariance = centre[step].covariances[target][::2, ::2]
        assert nees == [pytest.approx(apart[target] @ np.linalg.inv(covariance) @ apart[target] / 2, rel=1e-9)]
    early = [math.isnan(item["Scalars:scalars"][0]) for item in rows(path, "/error/main/1")[:4]]
    assert early == [True, True, True, False]  # tentative ones are not assessed
    limits = [rows(path, f"/nees/main/bounds/{name}")[9]["Scalars:scalars"][0] for name in ("low", "high")]
    assert limits == pytest.approx(chi2.ppf([0.025, 0.975], 2) / 2)


def test_a_consistent_centre_stays_within_the_bounds(flown: tuple[Path, list[Sent]]) -> None:
    path, _ = flown
    series = [rows(path, f"/anees/main/{name}") for name in ("bounds/low", "mean", "bounds/high")]
    values = np.array([[item["Scalars:scalars"][0] for item in part] for part in series])
    assert np.isnan(values[:, :3]).all()  # tentative
    values = values[:, 3:]
    assert np.isfinite(values).all()
    inside = int(((values[0] <= values[1]) & (values[1] <= values[2])).sum())
    assert binomtest(inside, 117, 0.95).pvalue > 1e-3
    errors = [item["Scalars:scalars"][0] for n in range(1, 6) for item in rows(path, f"/error/main/{n}")[3:]]
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(SIGMA * math.sqrt(2), rel=0.1)


def scores(*said: Message, cutoff: float | None = None) -> list[StepErrors]:
    matcher, found = TruthMatcher(cutoff), []
    for message in said:
        if message.type == "truth":
            matcher.truth(message)  # type: ignore[arg-type]
        else:
            matcher.step(message, Stamp(0, message.time))  # type: ignore[arg-type, union-attr]
        found += list(matcher.matched())
    return found


def test_truth_is_interpolated_and_waited_for() -> None:
    shown = missions.picture(1.25, [7], [(2, 5)])
    before, after = missions.truth(1, [1], [(-4, 0)]), missions.truth(2, [1], [(8, 4)])
    orders: list[list[Message]] = [[shown, before, after], [before, shown, after], [before, after, shown]]
    for order in orders:
        (score,) = scores(*order)
        assert score.ids.tolist() == [1]
        assert score.error == pytest.approx([5.0])  # (-1, 1) to (2, 5)
    assert scores(before, shown) == []
    assert scores(shown, after) == []  # nothing is known of the time before


def test_each_object_gets_the_nearest_free_track_within_the_cutoff() -> None:
    truth = missions.truth(0, [1, 2, 3], [(0, 0), (10, 0), (500, 0)])
    shown = missions.picture(0, [5, 6, 7], [(4, 0), (6, 1), (900, 0)])
    (score,) = scores(truth, shown, cutoff=100.0)
    np.testing.assert_allclose(score.error, [4.0, math.sqrt(17), math.nan])
    np.testing.assert_allclose(score.nees, [8.0, 8.5, math.nan])
    (score,) = scores(truth, replace(shown, status=np.array([0, 1, 1], dtype=np.uint8)), cutoff=100.0)
    np.testing.assert_allclose(score.error, [math.nan, math.sqrt(17), math.nan])


def test_labels_tell_the_ids_of_two_generations_apart(tmp_path: Path) -> None:
    said = [
        missions.picture(s, ids, [(0, 0), (5, 5)])
        for s, ids in ((0, (7 << 32 | 1, 7 << 32 | 2)), (1, (9 << 32 | 1, 7 << 32 | 2)))
    ]
    record(tmp_path / "a.rrd", *said)
    labels = [drawn["Points2D:labels"] for drawn in rows(tmp_path / "a.rrd", "/picture/global/centre")]
    assert labels == [["1", "2"], ["2.1", "2"]]


def test_a_status_does_not_bend_the_time_of_the_mission(tmp_path: Path) -> None:
    """A service that has not stepped yet says the time of the day; the mission may be played back."""
    path = tmp_path / "a.rrd"
    (status,) = (sent.message for sent in list(mission(1)) if sent.message.type == "status")
    with Recorder(path) as recorder:
        recorder.alive(local_key("radar", "alive"), True, START)
        recorder.handle(global_key("main", "status"), encode(status), START)
        recorder.tick()
        for message in (missions.tracks("radar", 0, [1], [(0, 0)]), missions.picture(0, [1], [(0, 0)])):
            recorder.handle(key_of(message), encode(message), START)
        recorder.handle(global_key("main", "status"), encode(status), START)
    assert abs(status.time - missions.at(0)) > 10**9 * 86400  # type: ignore[union-attr]
    shown = {item["time"] for name in entities(path) for item in rows(path, name)} - {None}
    assert shown == {missions.at(0)}
    assert any("radar is on the bus" in text for text in texts(path, "sources"))
    assert len(rows(path, "/health/main")) == 1


def test_without_truth_there_is_no_error_and_no_complaint(tmp_path: Path) -> None:
    recorder = record(tmp_path / "a.rrd", missions.picture(0, [1], [(0, 0)]), missions.tracks("a", 0, [1], [(0, 0)]))
    assert not recorder.undrawn
    assert not any(path.startswith(("/error", "/nees")) for path in entities(tmp_path / "a.rrd"))
    assert rows(tmp_path / "a.rrd", "/log/recorder") == []


def test_counts_and_influence(flown: tuple[Path, list[Sent]]) -> None:
    path, said = flown
    local: Any = next(sent.message for sent in said if sent.key == local_key("radar2", "tracks"))
    assert rows(path, "/counts/local/radar2")[0]["Scalars:scalars"] == [len(local.ids)]
    at = START + 50 * SECOND
    counted = [row(path, f"/counts/main/{s}", at)["Scalars:scalars"] for s in ("tentative", "confirmed", "coasting")]
    assert counted == [[0], [TARGETS - 1], [1]]
    shares = [row(path, f"/influence/main/{name}", at)["Scalars:scalars"][0] for name in RADARS]
    assert shares == pytest.approx([0.5, 0.3, 0.2])


def test_the_log_tells_what_happened(flown: tuple[Path, list[Sent]]) -> None:
    path, _ = flown
    told = {about: texts(path, about) for about in ("sources", "services", "tracks", "refusals")}
    assert [text.split("  ", 1)[1] for text in told["sources"] if "->" in text] == [
        "source radar2: alive -> stale",
        "source radar2: stale -> lost",
        "source radar2: lost -> alive",
    ]
    assert [text.split("  ", 1)[1] for text in told["tracks"]] == [
        "track 5 ended: merged, goes on as 9",
        "track 9 split from 4",
    ]
    assert sum("refused 2 tracks of radar3: not-finite" in text for text in told["refusals"]) == 3
    assert any("main appears" in text for text in told["services"])
    assert "| radar1 | alive |" in rows(path, "/health/main")[-1]["TextDocument:text"][0]


def test_a_restarted_source_is_told(tmp_path: Path) -> None:
    record(tmp_path / "a.rrd", *(missions.tracks("radar", s, [1], [(s, 0)], epoch=s // 2) for s in range(4)))
    told = texts(tmp_path / "a.rrd", "sources")
    assert [("started again" in text) for text in told] == [False, True]
    assert len(rows(tmp_path / "a.rrd", "/picture/local/radar/trail")) == 2  # no line from one run to the next
