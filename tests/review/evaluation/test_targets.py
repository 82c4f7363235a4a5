"""Why a target was missed: a mission made by hand, each target missed in a way of its own, and counted again here."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from fusion_service.review.evaluation import Evaluation, assess
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.misses import CAUSES
from fusion_service.review.evaluation.report import report
from fusion_service.review.evaluation.results import results, text
from fusion_service.review.evaluation.target_words import why
from fusion_service.review.evaluation.targets import TargetRecord
from schemas import Disk, Message, Platform
from schemas.messages import KEPT
from tests.helpers.missed import BIG, SECONDS, logged, mission
from tests.helpers.missions import START, info, picture, tracks, truth


@pytest.fixture(scope="module")
def assessed() -> Evaluation:
    return assess(Logbook(mission()), c=50.0).evaluations["centre"]


def record(evaluation: Evaluation, target: int) -> TargetRecord:
    (found,) = (one for one in evaluation.records if one.target == target)
    return found


@pytest.mark.parametrize(
    ("target", "followed", "words"),
    [
        (1, 20.0, ""),
        (2, 0.0, "never followed: outside all coverage"),
        (3, 0.0, "never followed: seen by none"),
        (4, 15.0, "until 5.0: seen, but not confirmed"),
        (5, 20.0, ""),
        (6, 14.0, "lost from 7.0 to 13.0: merged into the track of target 5"),
        (7, 9.0, "lost from 9.0: seen, but out of the centre's gate"),
        (8, 0.0, "never followed: seen, but its source was refused"),
        (9, 12.0, "lost from 6.0 to 14.0: seen by none"),
        (10, 0.0, "never followed: its track was farther off than the cut-off"),
        (11, 0.0, "never followed: seen, but in no fused track"),
    ],
)
def test_each_target_is_missed_for_its_own_reason(
    assessed: Evaluation, target: int, followed: float, words: str
) -> None:
    found = record(assessed, target)
    assert found.life == SECONDS
    assert found.followed == followed
    assert why(found, START) == words
    assert sum(gap.seconds for gap in found.gaps) == pytest.approx(found.life - found.followed)
    assert sum(seconds for _, seconds in found.causes) == pytest.approx(found.missed)


def test_what_a_target_had(assessed: Evaluation) -> None:
    assert assessed.records[-1].target in (1, 5)
    nine, eight = record(assessed, 9), record(assessed, 8)
    assert nine.tracks == (BIG + 90, BIG + 95)
    assert (nine.switches, nine.seen, nine.confirm) == (1, (START, ("a",)), 0.0)
    assert nine.gaps[0].sources == ()
    assert (eight.seen, eight.gaps[0].sources) == ((START, ("b",)), ("b",))
    assert record(assessed, 4).confirm == 5.0
    assert record(assessed, 3).seen is None
    assert np.isnan(record(assessed, 3).rmse)
    assert record(assessed, 1).rmse == 0.0
    assert sum(one.switches for one in assessed.records) == assessed.fused.identity_switches


def test_it_is_told_in_words_json_and_on_the_page() -> None:
    one = assess(Logbook(mission()), c=50.0)
    said = text([one])
    lines = said.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("target "))
    worst = [line.split()[0] for line in lines[first + 1 : first + 6]]
    assert sorted(worst) == ["10", "11", "2", "3", "8"]
    assert "outside all coverage" in said
    (row,) = results([one])["rows"]
    told = {each["target"]: each for each in row["more"]["targets"]}
    assert told["9"]["tracks"] == [str(BIG + 90), str(BIG + 95)]
    assert told["6"]["missed_because"] == {CAUSES[9]: 6.0}
    assert told["6"]["gaps"][0]["merged_into_tracks_of"] == ["5"]
    json.dumps(row, allow_nan=False)
    page = report([one])
    assert "lost from 7.0 to 13.0: merged into the track of target 5" in page


def test_gaps_of_truth_end_a_gap_and_no_time_is_counted_twice() -> None:
    """A target that is there from 0 to 4 s and from 15 to 20 s, with a track at 2 to 3 and 15 to 20 s."""
    said: list[Message] = [info("a", coverage=Disk(1000.0))]
    for second in range(SECONDS + 1):
        there = second <= 4 or second >= 15
        has = 2 <= second <= 3 or second >= 15
        said.append(truth(second, [1, 2] if there else [2], [[0.0, 0.0], [9000.0, 0.0]][0 if there else 1 :]))
        said.append(picture(second, [1] if has else [], [[0.0, 0.0]] if has else []))
    found = record(assess(Logbook(said), c=50.0).evaluations["centre"], 1)
    assert (found.life, found.followed, found.times) == (4.0 + 5.0, 1.0 + 5.0, 11)
    assert [(gap.begin - START, gap.end - START) for gap in found.gaps] == [(0, 2 * 10**9), (3 * 10**9, 4 * 10**9)]
    assert [(gap.begun, gap.ended) for gap in found.gaps] == [(True, False), (False, True)]


def test_a_track_that_was_suspended_is_told_as_the_cause() -> None:
    """From 5 to 8 s the centre does not show the track (lost from 4 to 9), whose existence is too low; a has the target
    all the time, by a track that is said to have fed it in the step before, and b not."""
    said: list[Message] = [info("a"), info("b")]
    for second in range(SECONDS + 1):
        hidden = 5 <= second < 9
        event = {5: "suspended", 9: "resumed"}.get(second)
        log = replace(
            logged(second),
            refused=(),
            events=({"kind": event, "tracks": [BIG + 70, "x", -1]},) if event else (),
            decisions=replace(logged(10).decisions, kind=np.full(1, KEPT, dtype=np.uint8)),
        )
        said += [truth(second, [1], [[0.0, 0.0]]), tracks("a", second, [7], [[0.0, 0.0]]), log]
        said.append(picture(second, [] if hidden else [BIG + 70], [] if hidden else [[0.0, 0.0]]))
    found = record(assess(Logbook(said), c=50.0).evaluations["centre"], 1)
    assert {CAUSES[code]: seconds for code, seconds in found.causes} == {
        "seen, but the existence of its track was too low": 5.0
    }


def test_what_a_source_covers_goes_along_with_its_platform() -> None:
    """A sensor that covers 100 m moves east by 50 m/s: a target at 500 m is covered from 8 to 12 s."""
    said: list[Message] = [info("a", coverage=Disk(100.0))]
    for second in range(SECONDS + 1):
        said.append(truth(second, [1], [[500.0, 0.0]]))
        said.append(tracks("a", second, [], [], platform=Platform((50.0 * second, 0.0, 0.0))))
        said.append(picture(second, [], []))
    found = record(assess(Logbook(said), c=50.0).evaluations["centre"], 1)
    unseen = sum(1 for k in range(1, SECONDS + 1) if abs(500.0 - 50.0 * k) <= 100.0)
    assert {CAUSES[code]: seconds for code, seconds in found.causes} == {
        "outside all coverage": SECONDS - unseen,
        "seen by none": unseen,
    }


def test_without_any_coverage_told_nothing_is_outside() -> None:
    said: list[Message] = [info("a", coverage=Disk(100.0)), info("b")]
    said += [truth(k, [1], [[5000.0, 0.0]]) for k in range(3)]
    said += [tracks(name, k, [], []) for k in range(3) for name in ("a", "b")]
    said += [picture(k, [], []) for k in range(3)]
    found = record(assess(Logbook(said), c=50.0).evaluations["centre"], 1)
    assert [CAUSES[code] for code, _ in found.causes] == ["seen by none"]
