"""A copy of the active process' state, whatever of the questions and answers gets lost."""

from __future__ import annotations

from typing import Any

import pytest

from fusion_service.service.copying import AGAIN, FETCH, Loaded, copied, pause

BLOB = b"0123456789"
PART = 4


class Other:
    """The active process as one that asks sees it, by a clock of its own: a question takes .01 s. lost: the numbers of
    the questions that get no answer, deaf: those that do not reach it either."""

    def __init__(self, deaf: range = range(0), lost: range = range(0), steps: int = 2) -> None:
        self.now, self.asked = 0.0, 0
        self._deaf, self._lost, self._steps = deaf, lost, steps
        self._wanted_at = float("inf")
        self.made = 0

    def over(self, wait: float) -> bool:
        self.now += wait
        return False

    def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        number, self.asked, self.now = self.asked, self.asked + 1, self.now + 0.01
        if number in self._deaf:
            return {}
        said: dict[str, Any] = {"term": 5}
        part = request.get("part")
        if part is None:
            self._wanted_at = min(self._wanted_at, self.now)
        elif self.now > self._wanted_at + 0.1:
            self.made, self._wanted_at = self.made + 1, float("inf")
        if part is not None and self.made and self._wanted_at == float("inf"):
            said |= {"of": [9, self.made], "parts": 3, "part": part, "data": BLOB[part * PART :][:PART]}
        return {} if number in self._lost else said


def test_what_is_asked_for_comes() -> None:
    other = Other()
    assert copied(other.ask, other.over, lambda: other.now) == Loaded(BLOB, 9, 1)
    assert other.now < AGAIN


@pytest.mark.parametrize("first", range(12))
@pytest.mark.parametrize("way", ["deaf", "lost"])
def test_a_question_or_answer_that_is_lost_costs_no_more_than_asking_again(first: int, way: str) -> None:
    """The one to make it, before the other can be asked at all, and each of the parts."""
    some = range(first, first + 2)
    other = Other(deaf=some) if way == "deaf" else Other(lost=some)
    assert copied(other.ask, other.over, lambda: other.now) == Loaded(BLOB, 9, other.made)
    assert other.now < 2 * AGAIN


def test_a_copy_that_is_made_anew_meanwhile_is_begun_with_again() -> None:
    other = Other()

    def ask(request: dict[str, Any]) -> dict[str, Any]:
        if request.get("part") == 2:
            other.made = 2
        return other.ask(request)

    assert copied(ask, other.over, lambda: other.now) == Loaded(BLOB, 9, 2)


def test_where_none_comes_it_is_given_up_and_soon_tried_again() -> None:
    other = Other(deaf=range(10**6))
    assert copied(other.ask, other.over, lambda: other.now) is None
    assert FETCH <= other.now < FETCH + AGAIN
    assert pause(FETCH, came=False) < 1.0, "what did not come has cost the other nothing"
    assert pause(0.01, came=True) < pause(0.1, came=True) < pause(60.0, came=True) <= 2.0


@pytest.mark.parametrize(
    "said", [{"of": None}, {"of": [1]}, {"of": ["a", 2]}, {"data": "text"}, {"parts": 1.5}, {"part": 1}, {"part": None}]
)
def test_answers_that_are_not_sound_are_none(said: dict[str, Any]) -> None:
    other = Other()
    sound = {"of": [9, 1], "parts": 1, "part": 0, "data": BLOB}

    def ask(request: dict[str, Any]) -> dict[str, Any]:
        other.ask(request)
        return sound | said

    assert copied(ask, other.over, lambda: other.now) is None
    assert copied(lambda _: sound, other.over, lambda: other.now) == Loaded(BLOB, 9, 1)
