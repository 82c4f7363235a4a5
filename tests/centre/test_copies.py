"""A track that says it is what another one is, and misses it by what a clock or a registration error explains."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre, StepResult
from schemas.messages import TENTATIVE
from tests.centre.worlds import SIGMA, centre, give, step, tracks

NAME = ("icao:4ca7b4",)


def true(t: float, speed: float = 100.0) -> np.ndarray:
    return np.array([[speed * t, 5000.0, speed, 0.0]])


def flown(
    late: float, seconds: int = 30, across: float = 0.0, copy_name: Any = NAME, silent: int = 10**6, **config: Any
) -> tuple[list[StepResult], FusionCentre]:
    """A direct source and one that is `late`, whose places are off by `across`; the direct one ends at `silent`."""
    made, rng, results = centre(("direct", "copy"), **config), np.random.default_rng(1), []
    for t in range(1, seconds + 1):
        if t < silent:
            z = true(t) + 0.3 * rng.normal(size=(1, 4)) * SIGMA
            give(made, tracks("direct", t, z, identity=NAME))
        if t > late:
            z = true(t - late) + 0.3 * rng.normal(size=(1, 4)) * SIGMA + np.array([[0.0, across, 0.0, 0.0]])
            give(made, tracks("copy", t, z, ids=[9], identity=copy_name))
        results.append(step(made, t))
    return results, made


def shown(result: StepResult) -> int:
    return int((result.tracks.status != TENTATIVE).sum())


def events(results: list[StepResult], kind: str) -> list[dict[str, Any]]:
    return [event for one in results for event in one.log.events if event["kind"] == kind]


def test_a_late_copy_starts_no_ghost_and_is_told() -> None:
    results, _ = flown(3.0)
    assert {shown(one) for one in results[4:]} == {1}
    assert max(abs(one.tracks.means[0, 0] - 100.0 * t) for t, one in enumerate(results, 1)) < 100.0
    (event,) = events(results, "copy")
    assert (event["source"], event["id"], event["identity"]) == ("copy", 9, NAME[0])
    assert event["delay"] == pytest.approx(3.0, abs=0.5), "300 m at 100 m/s, places to some 10 m"
    assert event["behind"] == pytest.approx(300.0, abs=50.0)
    (told,) = results[-1].status.sources["copy"]["copies"]
    assert "behind along its course" in told
    assert "late?" in told
    assert not events(results, "alarm")


def test_what_no_offset_explains_is_in_two_places() -> None:
    results, _ = flown(3.0, across=5000.0)
    assert shown(results[-1]) == 2
    assert not events(results, "copy")
    assert [event["what"] for event in events(results, "alarm")] == ["identity-twice"]


def test_another_identity_or_none_is_another_object() -> None:
    for name in (("icao:000001",), (None,)):
        results, _ = flown(3.0, copy_name=name)
        assert shown(results[-1]) == 2
        assert not events(results, "copy")


def test_what_may_be_off_is_configured() -> None:
    results, _ = flown(3.0, clock_sigma=0.1, translation_sigma=5.0)
    assert shown(results[-1]) == 2
    results, _ = flown(8.0, clock_sigma=4.0)
    assert shown(results[-1]) == 1


def test_when_the_direct_one_is_silent_the_copy_is_what_there_is() -> None:
    results, _ = flown(3.0, silent=15)
    assert events(results, "copy_over")
    assert shown(results[-1]) == 1
    assert results[-1].tracks.means[0, 0] == pytest.approx(100.0 * (30 - 3.0), abs=60.0)


def test_two_that_begin_at_once_become_one() -> None:
    made, rng, results = centre(("direct", "copy")), np.random.default_rng(2), []
    for t in range(5, 25):
        for source, late in (("direct", 0.0), ("copy", 3.0)):
            give(made, tracks(source, t, true(t - late) + 0.3 * rng.normal(size=(1, 4)) * SIGMA, identity=NAME))
        results.append(step(made, t))
    assert shown(results[3]) == 2
    assert {shown(one) for one in results[10:]} == {1}
    assert sum(len(one.tracks.ended) for one in results) == 1


def test_a_copy_that_comes_to_fit_joins() -> None:
    made, rng, results = centre(("direct", "copy")), np.random.default_rng(3), []
    for t in range(5, 25):
        for source, late in (("direct", 0.0), ("copy", 3.0 if t < 15 else 0.0)):
            if source == "direct" or t > 8:
                give(made, tracks(source, t, true(t - late) + 0.3 * rng.normal(size=(1, 4)) * SIGMA, identity=NAME))
        results.append(step(made, t))
    assert shown(results[-1]) == 1
    assert results[-1].tracks.contributor_counts.tolist() == [2]
    assert len(events(results, "copy")) == len(events(results, "copy_over")) == 1


def test_a_checkpoint_holds_it_and_order_does_not_matter() -> None:
    _, made = flown(3.0, 12)
    other = FusionCentre({"lateness": 3.0}, made.checkpoint())
    rng = np.random.default_rng(4)
    for t in range(13, 30):
        pair = [
            tracks("direct", t, true(t) + 0.3 * rng.normal(size=(1, 4)) * SIGMA, identity=NAME),
            tracks("copy", t, true(t - 3.0) + 0.3 * rng.normal(size=(1, 4)) * SIGMA, ids=[9], identity=NAME),
        ]
        give(made, *pair)
        give(other, *reversed(pair))
        one, two = step(made, t), step(other, t)
        assert schemas.encode(replace(one.tracks, seq=0)) == schemas.encode(replace(two.tracks, seq=0))
        assert one.status.sources == two.status.sources
        told = [[event for event in log.events if event["kind"] != "start"] for log in (one.log, two.log)]
        assert told[0] == told[1]
    assert made._linker.copies.held == other._linker.copies.held != {}
