"""Which missions are ranked against each other, and what a rule promises beside its rank."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from fusion_service.review.evaluation import Assessment, assess
from fusion_service.review.evaluation.logbook import Logbook
from fusion_service.review.evaluation.report import report
from fusion_service.review.evaluation.results import results, text
from fusion_service.rules import RULES
from schemas import Message
from tests.helpers.missions import info, picture, tracks, truth

END = 20


def mission(
    off: float, target: int = 1, place: float = 0.0, seconds: Sequence[int] = range(END + 1), seen: float = 0.0
) -> Assessment:
    """A target at rest, a source that sees it at `seen`, and a centre that is `off` metres off."""
    said: list[Message] = [info("a")]
    for t in seconds:
        said.append(truth(t, [target], [[place, 0.0]]))
        said.append(tracks("a", t, [3], [[place + seen, 0.0]]))
        said.append(picture(t, [1], [[place + off, 0.0]]))
    return assess(Logbook(said), c=50.0)


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (mission(1.0, target=2), "other targets, 1, 2 in one alone"),
        (mission(1.0, seconds=range(5, 26)), "other time, 2023-11-14 22:13:20Z to 2023-11-14 22:13:40Z and"),
        (mission(1.0, place=7.0), "target 1 is elsewhere, by 7 m"),
    ],
)
def test_missions_of_other_truth_are_not_ranked(other: Assessment, why: str) -> None:
    both = [mission(2.0), other]
    said = text(both)
    assert said.splitlines()[0].startswith("Not ranked, for the truth is not the same (")
    assert why in said
    assert "smallest" not in said
    assert said.count("followed 1 of 1 targets; RMSE") == 2
    assert why in report(both)
    assert 'class="best"' not in report(both)
    found = results(both)
    assert found["ranked"] is False
    assert why in found["not_ranked_because"]


def test_missions_of_one_truth_are_ranked_and_a_promise_stands_beside() -> None:
    both = [mission(2.0), mission(1.0)]
    said = text(both)
    assert "smallest GOSPA" in said.splitlines()[0]
    assert "chance" not in said
    assert f"  ci: {RULES['ci'].promise}" in said
    assert RULES["ci"].promise in report(both)
    assert results(both)["promises"] == {"ci": RULES["ci"].promise}
    assert results(both)["ranked"] is True


def test_of_one_truth_but_other_tracks_of_the_sources_is_said() -> None:
    both = [mission(2.0), mission(1.0, seen=0.5)]
    said = text(both)
    assert "smallest GOSPA" in said
    assert "not what the sources sent (other runs, or losses): small differences are chance." in said


def test_tracks_against_truth_and_tracks_against_tracks_are_told_apart() -> None:
    said: list[Message] = [info("a"), info("b")]
    for t in range(5):
        said += [truth(t, [1], [[0.0, 0.0]]), picture(t, [1], [[0.0, 0.0]])]
        said += [tracks(name, t, [1], [[0.0, 0.0]]) for name in "ab"]
    words = text([assess(Logbook(said), c=50.0)])
    assert "Tracks against the truth:" in words
    page = report([assess(Logbook(said), c=50.0)])
    assert "<h2>Tracks against the truth</h2>" in page
    assert "<h2>Tracks against tracks, without any truth</h2>" in page
