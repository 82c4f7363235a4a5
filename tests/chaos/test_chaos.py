"""The suite in short: it runs, finds nothing, and would find what there is."""

from __future__ import annotations

import random
from collections import Counter
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre, make_centre
from fusion_service.config import centre_config
from tests.centre.worlds import FRAME, SECOND, START, info
from tests.chaos import centres, decoding, kills, ordering
from tests.chaos.__main__ import PARTS
from tests.chaos.mutations import BASES, MUTATIONS, mutated
from tests.chaos.report import Report
from tests.chaos.settings import drawn

FOREVER = float("inf")


def said(report: Report) -> Report:
    assert not report.escapes, str(report)
    assert report.tried
    return report


def test_mutated_messages_are_read_or_refused() -> None:
    report = said(decoding.fuzz_decoding(random.randrange(10**6), FOREVER, 4000))
    assert {"read", "bad-field", "missing", "length", "not-msgpack", "version", "type"} <= {*str(report).split()}


def test_centres_go_on_and_keep_the_honest_targets() -> None:
    report = said(centres.fuzz_centres(random.randrange(10**6), FOREVER, 2))
    assert report.tried > 100


def test_orders_are_answered_or_refused() -> None:
    said(ordering.fuzz_orders(random.randrange(10**6), FOREVER, 400))


def test_what_is_killed_or_frozen_comes_back() -> None:
    said(kills.kill_and_freeze(3, FOREVER, 1))


def test_the_same_seed_gives_the_same_bytes_and_every_mutation_changes_some() -> None:
    def some(seed: int) -> list[bytes]:
        rng = random.Random(seed)
        return [mutated(rng, rng.choice(list(BASES.values()))) for _ in range(300)]

    assert some(4) == some(4) != some(5)
    assert len({*some(4)}) > 250
    rng = random.Random(6)
    hurt: Counter[str] = Counter()
    for mutation in MUTATIONS:
        for base in BASES.values():
            pairs = list(base.items())
            mutation(rng, pairs)
            hurt[mutation.__name__] += repr(pairs) != repr([*base.items()])
    assert min(hurt.values()) > 2, hurt


def test_drawn_settings_reach_rules_and_memories() -> None:
    rng = random.Random(7)
    some = [drawn(rng) for _ in range(80)]
    assert {one.memory for one in some} == {"auto", "restart", "recursive", "tracklet"}
    assert {one.kind for one in some} == {"tracks", "intensity"}
    assert len({one.rule for one in some}) > 10


def test_a_decoder_that_raises_something_else_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    read = schemas.decode

    def bad(data: bytes) -> Any:
        if b"\xff\xff\xff\xff" in data:
            raise ValueError("a fault")
        return read(data)

    monkeypatch.setattr(schemas, "decode", bad)
    assert decoding.fuzz_decoding(1, FOREVER, 2000).escapes


def test_a_centre_that_raises_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    step = FusionCentre.step

    def failing(self: FusionCentre, time: int) -> Any:
        result = step(self, time)
        if "a1" in result.status.sources:
            raise ZeroDivisionError
        return result

    monkeypatch.setattr(FusionCentre, "step", failing)
    assert "ZeroDivisionError" in str(centres.fuzz_centres(1, FOREVER, 2))


def test_a_centre_that_loses_honest_targets_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    handle = FusionCentre.handle

    def losing(self: FusionCentre, event: Any, received: int) -> None:
        name = getattr(event, "source", "")
        if name == "a1":
            self.__dict__["loud"] = True
        if not (name in centres.HONEST and "loud" in self.__dict__):
            handle(self, event, received)

    monkeypatch.setattr(FusionCentre, "handle", losing)
    monkeypatch.setattr(centres, "drawn", lambda _: centre_config({}))
    assert "are not in the picture" in str(centres.fuzz_centres(1, FOREVER, 2))


def test_every_part_has_a_name() -> None:
    assert {"decode", "centre", "orders", "kills", "disk", "clock", "connections", "floods"} == set(PARTS)


def test_a_sensor_whose_place_may_be_anywhere_overflows_nothing() -> None:
    for size in (1e300, 1e308, 1.7e308):
        centre = make_centre(centre_config({"frame": FRAME}))[0]
        covariance = np.full((3, 3), size / 2) + np.eye(3) * size / 2
        for second in range(1, 4):
            centre.handle(info("h1", seq=second, position_covariance=covariance.tolist()), START)
            for _, event, received in centres.honest(centre.config, second):
                if not isinstance(event, schemas.SensorInfo):
                    centre.handle(event, received)
            result = centre.step(START + second * SECOND)
        assert len(result.picture.ids) == 3
