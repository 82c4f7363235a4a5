"""A message that makes a step fail is found and refused; the others are taken."""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from fusion_service.centre import FusionCentre
from fusion_service.config import CentreConfig
from fusion_service.service.bounded import BoundedLog
from fusion_service.service.isolating import MOST_TRIES, TooManyTries, culprits
from fusion_service.service.ordering import OrderDesk
from fusion_service.service.state import State
from fusion_service.service.stepping import LastingCentre
from tests.centre.worlds import SECOND, START, info, tracks


@pytest.mark.parametrize("guilty", [[], [0], [7], [3, 4], [1, 5, 11]])
def test_those_at_fault_are_found_each_alone(guilty: list[int]) -> None:
    items = [(f"s{k % 4}", k) for k in range(12)]
    tries: list[int] = []

    def fails(some: list[int]) -> bool:
        tries.append(len(some))
        return bool({*some} & {*guilty})

    assert culprits(items, fails) == guilty
    assert len(tries) <= MOST_TRIES


def test_two_that_fail_together_only_are_both_at_fault_and_none_where_nothing_helps() -> None:
    items = [("a", 0), ("b", 1), ("a", 2), ("c", 3)]
    assert culprits(items, lambda some: {1, 3} <= {*some}) == [1, 3]
    assert culprits(items, lambda some: True) == []
    assert culprits([], lambda some: False) == []
    with pytest.raises(TooManyTries):
        culprits([(f"s{k}", k) for k in range(1000)], lambda some: bool(some))


def lasting(folder: Path, counts: Counter[str]) -> LastingCentre:
    desk = OrderDesk(lambda order: None)
    config = CentreConfig(lateness=3.0)
    return LastingCentre(config, State(folder), desk, BoundedLog(1.0), counts, lambda: None)


def test_a_step_that_fails_for_one_message_is_made_without_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    advance = FusionCentre._advance

    def poisoned(centre: Any, rows: Any, names: Any, time: int) -> Any:
        if any((source.tracks.id == 666).any() for source in centre._intake.sources.values()):
            raise FloatingPointError("a fault of ours")
        return advance(centre, rows, names, time)

    monkeypatch.setattr(FusionCentre, "_advance", poisoned)
    counts: Counter[str] = Counter()
    one = lasting(tmp_path, counts)
    logs = []
    with caplog.at_level(logging.ERROR):
        for second in range(1, 7):
            now = START + second * SECOND
            for name in ("r1", "r2", "r3"):
                if second == 1:
                    one.handle(info(name), now)
                bad = name == "r2" and second in (3, 4)
                ids = [666 if bad else 1]
                one.handle(tracks(name, second, [[0.0, 0, 0, 0]], ids=ids, seq=3 if bad else second), now)
            made = one.step(now)
            assert made is not None
            logs.append(made.result.log)
            assert {entry.source for entry in made.result.log.taken} >= {"r1", "r3"}
    assert [[(e.source, e.reason) for e in log.refused] for log in logs[2:4]] == [[("r2", "failed")]] * 2
    assert counts["failed_steps"] == 1, "the same message is known when it comes again"
    assert "r2" in caplog.text
    assert {entry.source for entry in logs[-1].taken} == {"r1", "r2", "r3"}
