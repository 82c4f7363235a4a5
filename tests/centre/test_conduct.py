"""Alarms about sources: what is wrong is said with its evidence, once, and what is right is not."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre, StepResult
from fusion_service.centre.journal import Journal
from fusion_service.centre.supervision.warnings import HOLD, MOST, MOST_OF_ONE, SHOWN, Warnings
from tests.centre.worlds import SECOND, START, centre, give, info, moved, seen, step, tracks

SIGMA = np.array([10.0, 10.0, 1.0, 1.0])
WORLD = np.array([[0.0, 0.0, 20.0, 0.0], [0.0, 5000.0, 0.0, -10.0], [8000.0, 0.0, 0.0, 0.0]])
Says = Callable[[float, np.ndarray], list[schemas.LocalTracks]]


def flown(says: Says, last: int, sources: tuple[str, ...] = ("a", "b"), **config: Any) -> list[StepResult]:
    made = centre(sources, **config)
    return list(steps(made, says, range(1, last + 1)))


def steps(made: FusionCentre, says: Says, seconds: Any) -> Iterator[StepResult]:
    rng = np.random.default_rng(3)
    for t in seconds:
        world = moved(WORLD, t)
        give(made, tracks("b", t, seen(world, rng, SIGMA), sigma=SIGMA), *says(t, seen(world, rng, SIGMA)))
        yield step(made, t)


def alarms(results: list[StepResult], kind: str = "alarm") -> list[tuple[int, dict[str, Any]]]:
    """(step, event), the first step being 1."""
    return [(t, event) for t, one in enumerate(results, 1) for event in one.log.events if event["kind"] == kind]


def told(results: list[StepResult]) -> list[tuple[str, str]]:
    return [(event["what"], event.get("source", "")) for _, event in alarms(results)]


def test_sound_sources_raise_none() -> None:
    results = flown(lambda t, z: [tracks("a", t, z, sigma=SIGMA)], 30)
    assert told(results) == []
    assert results[-1].status.sources["a"]["alarms"] == []


def frozen(first: int, last: int) -> Says:
    held: list[np.ndarray] = []

    def says(t: float, z: np.ndarray) -> list[schemas.LocalTracks]:
        if not first <= t < last:
            held[:] = [z]
        return [tracks("a", t, held[0], sigma=SIGMA)]

    return says


def test_a_frozen_feed_is_named_with_its_evidence_and_is_over_when_it_goes_on() -> None:
    results = flown(frozen(21, 32), 45)
    (begun, event), *_ = [(t, one) for t, one in alarms(results) if one["what"] == "stuck"]
    assert event["source"] == "a"
    assert (begun, event["id"], event["seconds"]) == (25, 1, 5.0), "five versions in a row as the one before"
    assert event["speed"] == pytest.approx(20.0, abs=4.0)
    assert "repeat to the bit" in event["why"]
    assert results[29].status.sources["a"]["alarms"] == [event["why"].replace("for 5 s", "for 10 s")]
    over = [(t, one) for t, one in alarms(results, "alarm_over") if one["what"] == "stuck"]
    assert [t for t, _ in over] == [31 + int(HOLD) + 1]
    assert [one["source"] for _, one in over] == ["a"]


def test_a_feed_of_what_stands_is_frozen_if_all_of_it_stops_at_one_moment() -> None:
    rng = np.random.default_rng(4)
    here = np.array([[0.0, 0.0, 0.0, 0.0], [3000.0, 0.0, 0.0, 0.0]])
    quiet = np.array([10.0, 10.0, 0.0, 0.0])

    def of(stops: tuple[int, int]) -> list[tuple[str, str]]:
        made, results, held = centre(("a",)), [], here
        for t in range(1, 31):
            new = here + rng.normal(size=(2, 4)) * quiet
            held = np.where(np.array([t <= one for one in stops])[:, None], new, held)
            give(made, tracks("a", t, held, sigma=SIGMA))
            results.append(step(made, t))
        return told(results)

    assert of((20, 20)) == [("stuck", "a")]
    assert of((20, 23)) == [], "one after the other, as seen by a sensor that rounds"


def test_an_anchored_ship_repeats_and_so_does_a_track_without_a_measurement() -> None:
    anchored = np.array([[0.0, 0.0, 0.0, 0.0], [500.0, 0.0, 5.0, 0.0]])
    made = centre(("ais", "held"))
    results = []
    for t in range(1, 31):
        give(made, tracks("ais", t, anchored[:1], identity=("mmsi:1",)))
        still = np.array([START + SECOND])
        give(made, tracks("held", t, anchored[1:], updated=still))
        results.append(step(made, t))
    assert told(results) == []


def jumping(first: int, last: int, rows: slice) -> Says:
    def says(t: float, z: np.ndarray) -> list[schemas.LocalTracks]:
        if first <= t < last:
            z[rows, 0] += 3000.0
        return [tracks("a", t, z, sigma=SIGMA)]

    return says


def test_a_source_that_jumps_as_a_whole() -> None:
    results = flown(jumping(21, 25, slice(None)), 26)
    assert told(results) == [("jump", "a")]
    (begun, event), *_ = alarms(results)
    assert (begun, event["count"], event["among"]) == (21, 3, 3)
    assert event["metres"] == pytest.approx(3000.0, abs=60.0)


def test_one_track_that_jumps_is_told_if_it_says_what_it_is_or_does_it_again() -> None:
    assert told(flown(jumping(21, 40, slice(0, 1)), 30)) == [], "once: its number may be another object's"

    def again(t: float, z: np.ndarray) -> list[schemas.LocalTracks]:
        z[0, 0] += 3000.0 * (t > 20 and t % 2)
        return [tracks("a", t, z, sigma=SIGMA)]

    results = flown(again, 30)
    assert ("jump", "a") in told(results)

    def named(t: float, z: np.ndarray) -> list[schemas.LocalTracks]:
        z[0, 0] += 3000.0 * (t > 20)
        return [tracks("a", t, z, sigma=SIGMA, identity=("icao:1", None, None))]

    (at, event), *_ = alarms(flown(named, 30))
    assert (at, event["what"], event["source"], event["of"]) == (21, "jump", "a", "1")


def test_a_number_used_again_after_a_pause_is_no_jump() -> None:
    def says(t: float, z: np.ndarray) -> list[schemas.LocalTracks]:
        z[0, 0] += 3000.0 * ((t // 10) % 2)
        return [tracks("a", t, z, sigma=SIGMA, complete=False)] if t % 10 < 5 else []

    assert told(flown(says, 35)) == []


def ghost(others: int, seconds: int = 26) -> list[StepResult]:
    names = tuple(f"r{k}" for k in range(others))
    made = FusionCentre({"lateness": 3.0})
    for name in names:
        give(made, info(name, coverage=schemas.Disk(100e3), detection_probability=0.9))
    give(made, info("adsb"))
    rng, results = np.random.default_rng(18), []
    for t in range(1, seconds + 1):
        world = moved(WORLD[:2], t)
        give(made, tracks("adsb", t, seen(world, rng, SIGMA), sigma=SIGMA))
        for name in names:
            give(made, tracks(name, t, seen(world[:1], rng, SIGMA), sigma=SIGMA))
        results.append(step(made, t))
    return results


def test_what_nobody_else_sees_where_two_others_should() -> None:
    results = ghost(2)
    assert told(results) == [("unseen", "adsb")]
    ((_, event),) = alarms(results)
    assert event["others"] == 2
    assert event["evidence"] <= -np.log(1e6)
    assert told(ghost(1)) == [], "one other that does not see it may be what is wrong"


def test_one_identity_twice_in_one_source() -> None:
    def says(t: float, z: np.ndarray) -> list[schemas.LocalTracks]:
        return [tracks("a", t, z, sigma=SIGMA, identity=("mmsi:1", None, "mmsi:1"))]

    results = flown(says, 20)
    assert ("identity-twice", "a") in told(results)
    event = next(one for _, one in alarms(results) if one.get("source") == "a")
    assert (event["identity"], event["ids"]) == ("mmsi:1", [1, 3])


@pytest.mark.parametrize(("epochs", "what"), [((1, 2), "older-run"), ((1, 1), "two-runs")])
def test_two_runs_under_one_name(epochs: tuple[int, int], what: str) -> None:
    made, results = centre(()), []
    for epoch in sorted(set(epochs)):
        give(made, info("u", epoch=epoch))
    for t in range(1, 26):
        for k, epoch in enumerate(epochs):
            if t > 5 * k:
                place = np.array([[5.0 * t, 20_000.0 * k, 5.0, 0.0]])
                give(made, tracks("u", t, place, seq=t - 5 * k, epoch=epoch, sigma=SIGMA))
        results.append(step(made, t))
    assert (what, "u") in told(results)
    supervisor = made._supervisor
    assert not supervisor.conduct.stuck("u"), "what is refused is in no recording, and may change no result"


def test_it_is_the_same_from_a_checkpoint_and_whatever_comes_first() -> None:
    made = centre(("a", "b"))
    whole = list(steps(made, frozen(11, 30), range(1, 14)))
    other = FusionCentre({"lateness": 3.0}, made.checkpoint())
    held = made._intake.sources["a"].tracks.mean.T
    for t in range(14, 36):
        z = seen(moved(WORLD, t), np.random.default_rng(t), SIGMA)
        pair = [tracks("a", t, held if t < 25 else z, sigma=SIGMA), tracks("b", t, z, sigma=SIGMA)]
        give(made, *pair)
        give(other, *reversed(pair))
        one, two = step(made, t), step(other, t)
        whole.append(one)
        assert schemas.encode(replace(one.tracks, seq=0)) == schemas.encode(replace(two.tracks, seq=0))
        assert one.status.sources == two.status.sources
        assert one.log.events == tuple(event for event in two.log.events if event["kind"] != "start")
    assert ("stuck", "a") in told(whole)
    assert [t for t, event in alarms(whole, "alarm_over") if event["what"] == "stuck"] == [24 + int(HOLD) + 1]


def test_off_means_off() -> None:
    results = flown(frozen(11, 60), 30, supervision="off")
    assert told(results) == []


def test_the_number_of_alarms_is_bounded() -> None:
    journal, warnings = Journal("c", "", ""), Warnings()
    for source, number in itertools.product(range(MOST), range(2 * MOST_OF_ONE)):
        warnings.raised((f"s{source:04}", "jump", str(number)), 1, {}, "it jumps", journal)
        if source * MOST_OF_ONE > 2 * MOST:
            break
    events = journal.write(0, 0, 1, 1).events
    assert len(events) == MOST
    assert len(warnings.of("s0000")) == SHOWN
    warnings.settle(1 + round((HOLD + 1) * SECOND), journal)
    assert len(journal.write(0, 1, 2, 2).events) == MOST
    assert warnings.of("s0000") == []
