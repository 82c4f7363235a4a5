"""A clock that is set back: a new era, in which ids and tracks go on, said once and made again by replay.

Expected places are those of the target's straight line, errors are counted in the centre's own stated sigmas.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import schemas
from fusion_service.centre import ClockSet, FusionCentre, IntensityCentre, NewEra, StepResult, WallClock
from fusion_service.centre.era import FEW, margin
from fusion_service.centre.evidence import PairEvidence
from fusion_service.centre.lifecycle import newborn
from fusion_service.config import CentreConfig
from fusion_service.review.replay import run_replay
from tests.centre.worlds import SECOND, SIGMA, START, centre, give, info, seen, step, tracks
from tests.helpers.flown import Flight, record

HOUR = 3600.0
LINE = np.array([100.0, 50.0, 10.0, -5.0])


def line(second: float) -> np.ndarray:
    return LINE + second * np.array([10.0, -5.0, 0.0, 0.0])


def ns(second: float) -> int:
    return START + round(second * SECOND)


def eras(result: StepResult) -> list[dict[str, Any]]:
    return [event for event in result.log.events if event["kind"] == "era"]


def sigmas(result: StepResult, second: float) -> float:
    error = result.tracks.means[0] - line(second)
    return float(np.sqrt(error @ np.linalg.solve(result.tracks.covariances[0], error)))


def fly(made: FusionCentre, seconds: range, ahead: float, seed: int = 3) -> list[StepResult]:
    """One source, one target; all clocks, the centre's and the source's, are `ahead` of `seconds`."""
    print("seed", seed)
    rng, out = np.random.default_rng(seed), []
    for k in seconds:
        state = seen(line(k)[None], rng)
        made.handle(tracks("r1", k + ahead, state, seq=k), ns(k + ahead + 0.1))
        if ns(k + ahead) > made.time:
            out.append(step(made, k + ahead))
    return out


def test_all_clocks_are_set_back_by_an_hour_and_ids_and_places_go_on() -> None:
    made = centre(("r1",))
    before = fly(made, range(1, 21), HOUR)
    assert before[-1].tracks.status.tolist() == [1]
    after = fly(made, range(21, 60), 0.0)
    assert len(after) >= 39 - FEW
    told = [event for result in after for event in eras(result)]
    assert [(event["number"], event["before"]) for event in told] == [(1, ns(20 + HOUR))]
    assert eras(after[0]) == told
    assert ns(20) <= told[0]["time"] < after[0].tracks.time
    assert after[0].status.notes is not None
    assert "set back by about 3598" in after[0].status.notes[0] or "set back by about 36" in after[0].status.notes[0]
    for result in after:
        assert result.tracks.ids.tolist() == before[-1].tracks.ids.tolist()
        assert result.tracks.status.tolist() == [1]
        assert sigmas(result, (result.tracks.time - START) / SECOND) < 4.5  # chi2 of 4: 1e-3 a step
    assert all(result.status.refused == {} for result in after)


def test_what_is_known_is_never_predicted_back_and_no_further_than_the_new_era() -> None:
    made = centre(("r1",), coast=1e5, stale_periods=1e5)
    last = fly(made, range(1, 11), HOUR)[-1]
    made.handle(ClockSet(ns(11)), ns(11.5))
    assert made.time == ns(10)
    first = step(made, 11)
    one = schemas.Motion("cv", 1.0).q
    # the density of the last step, that now holds at 10 s, one second on
    forward = np.eye(4) + np.diag([1.0, 1.0], 2)
    noise = one * np.kron([[1 / 3, 1 / 2], [1 / 2, 1.0]], np.eye(2))
    np.testing.assert_allclose(first.tracks.means[0], forward @ last.tracks.means[0], rtol=1e-12)
    np.testing.assert_allclose(
        first.tracks.covariances[0], forward @ last.tracks.covariances[0] @ forward.T + noise, rtol=1e-12
    )


@pytest.mark.parametrize("restart", [False, True])
def test_a_centre_that_began_an_hour_ahead_shows_the_picture_soon_after(restart: bool) -> None:
    """The sources are right all along; what they said was late by an hour, and said so."""
    made = centre(("r1",))
    clock = WallClock(made.config)
    shown = None
    for k in range(1, 120):
        ahead = HOUR if k < 30 else 0.0
        made.handle(tracks("r1", k, line(k)[None]), ns(k + ahead + 0.1))
        if restart and k == 31:
            made = FusionCentre(made.config, made.checkpoint(), generation=5)
            clock = WallClock(made.config)
        due = clock.due(ns(k + ahead + 0.6))
        if due is None or due <= made.time:
            continue
        result = made.step(due)
        if k == 20:
            assert "late" in result.status.refused
            assert "older than the step" in result.status.sources["r1"]["note"]
        if k >= 30 and shown is None and result.tracks.status.tolist() == [1]:
            shown = k
            assert sigmas(result, (due - START) / SECOND) < 1e-6
    assert shown is not None
    assert shown <= 30 + FEW + 4


def test_a_set_back_within_lateness_is_waited_for() -> None:
    made = centre(("r1",))
    fly(made, range(1, 21), 0.0)
    limit = margin(made.config) / SECOND
    assert limit == 3.0 + 2.0 + 5.0
    at = made.time
    for k in range(20):
        made.handle(info("r1", seq=k + 1), ns(20 - limit))
        made.handle(ClockSet(ns(20 - limit)), ns(20 - limit + 0.5))
    assert made.time == at
    # a few messages among others that came in order prove nothing
    for k in range(20):
        made.handle(info("r1", seq=100 + k), ns(-100.0 if k % FEW else 21.0))
    assert made.time == at
    for k in range(FEW):
        made.handle(info("r1", seq=200 + k), ns(-100.0))
    assert made.time == ns(-101.5)


def test_by_the_messages_clock_it_takes_more_than_one_word() -> None:
    made = centre(("r1",), clock="message")
    fly(made, range(1, 21), HOUR)
    at = made.time
    for k in range(6):
        made.handle(ClockSet(ns(k)), ns(k))
        assert made.time == at
    made.handle(ClockSet(ns(6)), ns(6))
    assert made.time == ns(5)
    # and times of reception are nobody's clock there
    for k in range(10):
        made.handle(info("r1", seq=k + 1), ns(-1000.0))
    assert made.time == ns(5)


def test_a_run_that_began_before_the_set_back_is_followed_after_it() -> None:
    made = FusionCentre({"lateness": 3.0})
    epoch = ns(HOUR - 5.0)
    for k in range(1, 40):
        ahead = HOUR if k < 20 else 0.0
        made.handle(tracks("r1", k + ahead, line(k)[None], seq=k, epoch=epoch), ns(k + ahead + 0.1))
        if ns(k + ahead) > made.time:
            last = step(made, k + ahead)
    assert last.status.refused == {}
    assert last.tracks.contributor_epoch.tolist() == [epoch]
    give_other = tracks("r1", 40, line(40)[None], seq=0, epoch=epoch + 1)
    made.handle(give_other, ns(40.1))
    assert step(made, 40).status.refused == {"future": 1}


def test_messages_that_wait_for_a_time_of_the_old_era_are_refused() -> None:
    made = centre(("r1",))
    fly(made, range(1, 11), HOUR)
    made.handle(tracks("r1", HOUR + 12, line(12)[None], seq=50), ns(HOUR + 11))
    made.handle(ClockSet(ns(12)), ns(12.5))
    result = step(made, 12)
    assert result.status.refused == {"future": 1}
    assert "ahead of this computer's clock" in result.status.sources["r1"]["note"]


@pytest.mark.parametrize("cut", ["before", "after"])
def test_a_checkpoint_keeps_the_era(cut: str) -> None:
    one = centre(("r1",))
    fly(one, range(1, 11), HOUR)
    if cut == "after":
        one.handle(ClockSet(ns(11)), ns(11.5))
    two = FusionCentre(one.config, one.checkpoint())
    assert two.time == one.time
    if cut == "before":
        one.handle(ClockSet(ns(11)), ns(11.5))
        two.handle(ClockSet(ns(11)), ns(11.5))
    for made in (one, two):
        give(made, tracks("r1", 11, line(11)[None], seq=60))
    first, second = step(one, 11), step(two, 11)
    assert first.tracks.ids.tolist() == second.tracks.ids.tolist() != []
    np.testing.assert_array_equal(first.tracks.means, second.tracks.means)
    assert (first.log.time, first.log.step, first.log.taken) == (second.log.time, second.log.step, second.log.taken)
    assert first.status.notes == second.status.notes
    assert one.checkpoint() == two.checkpoint()


def test_replay_obeys_it_bit_for_bit(tmp_path: Path) -> None:
    """The recorder has a clock of its own, which is right all along: it cannot tell where the centre's was."""
    flight = Flight({"lateness": 2.0})
    rng = np.random.default_rng(8)
    flight.put(info("r1"), 0.0)
    for k in range(1, 30):
        ahead = HOUR if k < 12 else 0.0
        message = tracks("r1", k + ahead, seen(line(k)[None], rng), seq=k)
        flight.put(message, k, give=False)
        flight.centre.handle(message, ns(k + ahead + 0.1))
        if ns(k + ahead) > flight.centre.time:
            flight.step(k + ahead)
    assert sum(len(eras(result)) for result in flight.steps) == 1
    replay = run_replay(record(tmp_path / "a.rrd", flight.log), verify=True, say=lambda text: None)
    assert replay.verdict is not None
    assert replay.verdict.first is None
    assert replay.verdict.compared == replay.verdict.equal == len(flight.steps)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(-5000, 5000), st.integers(-8, 8), st.sampled_from(["clock", "era", "scan", "step"])),
        max_size=40,
    )
)
def test_no_clock_makes_it_raise_or_predict_back(jumps: list[tuple[int, int, str]]) -> None:
    made = FusionCentre({"lateness": 1.0, "memory": "recursive"})
    wall = 0.0
    for seq, (at, offset, what) in enumerate(jumps):
        wall = float(at) if seq % 7 == 0 else wall + 1.0
        if what == "clock":
            made.handle(ClockSet(ns(wall)), ns(wall))
        elif what == "era":
            made.handle(NewEra(ns(wall)), ns(wall))
        elif what == "scan":
            made.handle(tracks("r1", wall + offset, line(wall)[None], seq=seq, sigma=SIGMA), ns(wall))
        elif ns(wall) > made.time:
            result = step(made, wall)
            assert (schemas.check_numbers([result.tracks])[0] == 0).all()
            schemas.decode(schemas.encode(result.log))
            schemas.decode(schemas.encode(result.status))


def test_the_wall_clock_goes_on_from_where_it_was_set() -> None:
    one = WallClock(CentreConfig(period=1.0, delay=0.5))
    assert one.due(ns(0)) is None
    assert one.due(ns(10.5)) == ns(10)
    assert one.due(ns(10.4)) is None  # a slewed clock is not one that was set
    assert one.due(ns(-3590.0)) == ns(-3591)
    assert one.due(ns(-3590.0)) is None
    assert one.due(ns(-3588.5)) == ns(-3589)


def test_evidence_for_a_merge_goes_on_from_the_data_of_the_new_era() -> None:
    """It does not wait until the clock is where it was."""
    evidence, first, second = PairEvidence(), np.array([0]), np.array([1])
    ids = newborn(np.array([3, 4], dtype=np.uint64), 4, 0)
    for time in (100, 101):
        evidence.add(first, second, np.array([1.0]), replace(ids, seen=np.array([time, time])), 10.0)
    assert evidence.sums.total.tolist() == [2.0]
    evidence.rebase(50)
    evidence.add(first, second, np.array([1.0]), replace(ids, seen=np.array([50, 50])), 10.0)
    assert evidence.sums.total.tolist() == [2.0]
    evidence.add(first, second, np.array([1.0]), replace(ids, seen=np.array([51, 51])), 10.0)
    assert evidence.sums.total.tolist() == [3.0]


def test_a_track_of_an_intensity_ends_in_the_new_era_as_in_the_old() -> None:
    """One that coasts at the set-back does not live until the clock is where it was."""
    made = IntensityCentre({"kind": "intensity", "coast": 20.0, "lateness": 1.0})
    made.handle(info("r1"), START)
    for k in range(1, 8):
        message = schemas.LocalIntensity(
            source="r1", epoch=1, seq=k, sent=0, time=ns(HOUR + k), space=("x", "y", "vx", "vy"),
            frame=tracks("r1", 0, []).frame, weights=np.array([1.0]), means=LINE[None],
            covariances=np.diag([900.0, 900.0, 4.0, 4.0])[None],
        )  # fmt: skip
        made.handle(message, ns(HOUR + k + 0.1))
        made.step(ns(HOUR + k))
    result = [made.step(ns(HOUR + k)) for k in range(8, 16)][-1]
    assert result.tracks.status.tolist() == [2]
    made.handle(ClockSet(ns(8)), ns(8))
    left = [len(made.step(ns(k)).tracks.ids) for k in range(8, 60)]
    assert left[0] == 1
    assert left[-1] == 0
