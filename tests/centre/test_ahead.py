"""What is made of messages before their step, of the state before the next, and of who is near in a step made again:
the same bytes with it and without."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre, ahead, births, history, neighbours
from fusion_service.centre.ahead import Ahead
from fusion_service.centre.linking import Linker
from fusion_service.centre.rows import Rows
from schemas import Enu, LocalTracks
from tests.centre.test_crowds import flown

SECOND = 1_000_000_000
PERIOD = SECOND // 10
SPACE = ("x", "y", "vx", "vy")
HERE = Enu(59.0, -55.0)
TARGETS, SOURCES, STEPS = 120, 3, 18


def scan(source: int, step: int, time: int, rng: np.random.Generator) -> LocalTracks:
    """Two of three sources see a target, not always; now and then a number is none."""
    ids = np.arange(TARGETS)[np.arange(TARGETS) % SOURCES != source]
    ids = ids[rng.random(len(ids)) < 0.97]
    homes = np.stack([ids % 10 * 900.0, ids // 10 * 900.0], axis=1)
    velocity = np.array([8.0, -5.0])
    means = np.concatenate([homes + velocity * (step * PERIOD / SECOND), np.tile(velocity, (len(ids), 1))], axis=1)
    means += rng.normal(0.0, 2.0, means.shape)
    if step % 5 == 3:
        means[0, 0] = np.nan
    spread = np.diag([25.0, 25.0, 4.0, 4.0])
    return LocalTracks(
        source=f"s{source}", epoch=1, seq=step, sent=time, time=time, complete=True, space=SPACE, frame=HERE,
        ids=ids.astype(np.uint64), means=means, covariances=np.tile(spread, (len(ids), 1, 1)),
    )  # fmt: skip


def run(foresees: bool, **settings: Any) -> tuple[list[bytes], int]:
    """All that the steps of a world with late scans give, and how many steps revised others."""
    rng = np.random.default_rng(3)
    centre = FusionCentre({"period": 0.1, "frame_wait": 0.0, "lateness": 1.0, **settings})
    held: list[LocalTracks] = []
    out: list[bytes] = []
    revised = 0
    for step in range(STEPS):
        time = 1000 * SECOND + step * PERIOD
        messages = held + [scan(source, step, time, rng) for source in range(SOURCES)]
        held = [messages.pop()] if step % 4 == 2 else []
        for message in messages:
            centre.handle(message, time + 1)
        result = centre.step(time)
        revised += result.tracks.revised is not None
        if foresees:
            centre.foresee()
        out += [schemas.encode(one) for one in (result.tracks, result.log, result.status)]
    return [*out, centre.checkpoint()], revised


@pytest.mark.parametrize("settings", [{}, {"rule": "ci", "memory": "restart", "supervision": "off"}])
def test_what_is_made_ahead_changes_nothing(settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    used: Counter[str] = Counter()
    table, digest, make = Ahead.table, Ahead.digest, neighbours.Neighbours._make
    begin, states = FusionCentre._begin_step, []

    def counted_table(self: Ahead, *given: Any) -> Any:
        found = table(self, *given)
        used["table"] += found is not None
        return found

    def counted_digest(self: Ahead, message: Any) -> int:
        used["digest"] += id(message) in self._made
        return digest(self, message)

    def counted_make(self: neighbours.Neighbours, *given: Any) -> None:
        used["list"] += 1
        make(self, *given)

    def counted_begin(self: FusionCentre, *given: Any) -> Any:
        states.append(self._state is not None)
        return begin(self, *given)

    monkeypatch.setattr(Ahead, "table", counted_table)
    monkeypatch.setattr(Ahead, "digest", counted_digest)
    monkeypatch.setattr(neighbours.Neighbours, "_make", counted_make)
    monkeypatch.setattr(FusionCentre, "_begin_step", counted_begin)
    monkeypatch.setattr(ahead, "LARGE", 1)
    with_it, revised = run(foresees=True, **settings)
    assert revised > 2, "steps are made again"
    assert used["table"] > STEPS
    assert used["digest"] > STEPS
    lists, foreseen = used["list"], sum(states)
    used.clear()
    states.clear()
    monkeypatch.setattr(ahead, "LARGE", 10**9)
    monkeypatch.setattr("fusion_service.centre.fusion.Linker", lambda config, ids, _: Linker(config, ids))
    assert run(foresees=False, **settings) == (with_it, revised)
    assert (used["table"], used["digest"]) == (0, 0)
    assert lists < used["list"]
    assert foreseen > sum(states)


def after_calm(late_at: int) -> tuple[list[bytes], list[int]]:
    """The pictures of steps, one scan of which is late at `late_at`; how many steps were made again."""
    rng, out, again = np.random.default_rng(8), [], []
    centre = FusionCentre({"period": 0.1, "frame_wait": 0.0, "lateness": 5.0})
    for step in range(late_at + 3):
        time = 1000 * SECOND + step * PERIOD
        messages = [scan(source, step, time, rng) for source in range(SOURCES)]
        held = messages.pop() if step == late_at else None
        for message in messages:
            centre.handle(message, time + 1)
        result = centre.step(time)
        again += [event["steps"] for event in result.log.events if event["kind"] == "revised"]
        out.append(schemas.encode(result.tracks))
        if held is not None:
            centre.handle(held, time + 2)
    return out, again


def test_a_late_scan_of_many_tracks_after_a_calm_time_costs_one_step(monkeypatch: pytest.MonkeyPatch) -> None:
    seldom = after_calm(5)
    made: list[int] = []
    make = FusionCentre._make

    def counted(self: FusionCentre, time: int, *given: Any) -> Any:
        made.append(time)
        return make(self, time, *given)

    monkeypatch.setattr(FusionCentre, "_make", counted)
    assert after_calm(5) == seldom
    often = len(made)
    made.clear()
    monkeypatch.setattr(history, "MANY", 100)
    assert after_calm(5)[0] == seldom[0]
    assert len(made) == 8 + 1 < often


def test_messages_of_every_kind_are_the_same_made_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ahead, "LARGE", 1)
    settings = {"memory": "restart", "supervision": "off", "registration": "off"}
    small = flown(2, **settings)
    monkeypatch.setattr(ahead, "LARGE", 10**9)
    assert flown(2, **settings) == small


def test_nothing_of_a_message_is_kept_that_is_not_there_to_keep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ahead, "LARGE", 1)
    monkeypatch.setattr(ahead, "MOST", 200)
    centre = FusionCentre({"period": 0.1, "frame": {"kind": "enu", "lat": 59.0, "lon": -55.0}})
    made, rng, time = centre._intake.ahead, np.random.default_rng(4), 1000 * SECOND
    whole = [scan(source, 1, time, rng) for source in range(SOURCES)]
    wrong = replace(whole[0], source="w", means=whole[0].means[:-1])
    empty = replace(whole[0], source="e", ids=whole[0].ids[:0])
    for message in (*whole, wrong, empty):
        centre.handle(message, time)
    assert 0 < made._tracks <= 200, "there is room for two scans"
    assert len(made._made) == 2
    assert {entry.reason for entry in centre.step(time).log.refused} == {"length"}
    assert len(made._taken) == 2
    again = scan(0, 2, time + PERIOD, rng)
    for message in (again, whole[0]):  # who says it again does not make the centre work
        centre.handle(message, time + PERIOD)
    assert id(again) in made._made
    assert len(made._made) <= 2
    assert len(centre.step(time + PERIOD).log.taken) == 1


def test_the_local_tracks_of_groups_are_those_found_one_by_one() -> None:
    rng = np.random.default_rng(5)
    for count in (0, 1, 40):
        source, ids = rng.integers(0, 3, count), rng.integers(1, 99, count).astype(np.uint64)
        at = np.sort(rng.permutation(count)[: count // 2 + count % 2])
        groups = rng.integers(0, 6, len(at))
        chosen = np.unique(groups[groups % 2 == 0])
        rows = _rows(source, ids)
        found = births.locals_of(rows, ("a", "b", "c"), at, groups, chosen)
        wanted = [
            [("abc"[source[row]], 7, int(ids[row])) for row, one in zip(at, groups, strict=True) if one == group]
            for group in chosen
        ]
        assert found == wanted


def _rows(source: Any, ids: Any) -> Rows:
    class Table:
        id = ids

    class Some:
        epoch = np.full(len(ids), 7, dtype=np.uint64)
        tracks = Table()

    some: Any = Some()
    some.source = source
    rows: Rows = some
    return rows
