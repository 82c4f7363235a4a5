"""What a step may cost: components that are refused, mixtures taken by their moments, sources that rest."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
import pytest

import schemas
from fusion_service.centre import FusionCentre, Order, SourceFound, SourceLost
from fusion_service.centre.quieting import FEW
from fusion_service.centre.sparing import by_moments, pairs_of, too_costly
from fusion_service.config import CentreConfig
from fusion_service.densities import Mixture
from tests.centre.worlds import centre, give, info, step, tracks


def mixed(source: str, second: float, count: int, components: int, seq: int | None = None) -> schemas.LocalTracks:
    rng = np.random.default_rng([count, components])
    total = count * components
    places = np.repeat(np.arange(count) * 1e4, components)[:, None] * [1, 0, 0, 0]
    weights = rng.uniform(0.2, 1.0, (count, components))
    one = tracks(source, second, np.zeros((count, 4)), seq=seq)
    spread = rng.normal(size=(total, 4, 4))
    return dataclasses.replace(
        one,
        means=rng.normal(size=(total, 4)) * 100.0 + places,
        covariances=spread @ spread.swapaxes(1, 2) + np.eye(4) * 25.0,
        counts=np.full(count, components, np.uint16),
        weights=(weights / weights.sum(axis=1, keepdims=True)).ravel(),
    )


def test_a_message_of_too_many_components_is_refused_before_it_costs_anything() -> None:
    made = centre(("r1",))
    give(made, mixed("r1", 1, 1, 8000), mixed("r1", 1, 600, 90, seq=2), tracks("r2", 1, [[0, 0, 0, 0]]))
    begin = time.process_time()
    result = step(made, 1)
    assert time.process_time() - begin < 1.0  # 17.6 s without
    assert result.status.refused == {"too-many-components": 2}
    assert [entry.source for entry in result.log.taken if entry.source == "r2"] == ["r2"]
    allowed = FusionCentre({"track_components": 20, "lateness": 3.0})
    give(allowed, mixed("r1", 1, 1, 20), mixed("r1", 1, 1, 21, seq=2))
    assert step(allowed, 1).status.refused == {"too-many-components": 1}


def test_moments_are_those_of_each_mixture() -> None:
    one = mixed("a", 1, 5, 7)
    flat = by_moments(one)
    assert flat.counts is None
    for k in range(5):
        part = slice(7 * k, 7 * k + 7)
        assert one.weights is not None
        mean, covariance = Mixture(one.weights[part], one.means[part], one.covariances[part]).moments()
        np.testing.assert_allclose(flat.means[k], mean, rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(flat.covariances[k], covariance, rtol=1e-11)
    assert by_moments(mixed("a", 1, 0, 3)).means.shape == (0, 4)
    plain = tracks("a", 1, [[0, 0, 0, 0]])
    assert by_moments(plain) is plain


def test_those_with_most_pairs_are_spared_first_and_no_more_than_needed() -> None:
    config = CentreConfig(component_pairs=5000)
    messages = [mixed("a", 1, 10, 10), mixed("b", 1, 40, 12), mixed("c", 1, 10, 10), mixed("d", 1, 100, 8)]
    assert [pairs_of(one, 8) for one in messages] == [1000, 5760, 1000, 0]
    assert too_costly(messages, config) == [1]
    assert too_costly(messages, CentreConfig(component_pairs=1500)) == [0, 1]
    assert too_costly(messages, CentreConfig(component_pairs=0)) == [0, 1, 2]
    assert too_costly(messages, CentreConfig()) == []
    assert too_costly([], config) == []


def test_the_order_of_arrival_does_not_change_what_is_spared() -> None:
    messages = [mixed(name, 1, 10, 10) for name in ("r1", "r2", "r3")]
    results = []
    for order in (messages, messages[::-1]):
        made = centre(component_pairs=2000)
        give(made, *order)
        results.append(step(made, 1))
        assert [e for e in results[-1].log.events if e["kind"] == "moments"] == [
            {"kind": "moments", "source": "r1", "tracks": 10}
        ]
    assert schemas.encode(results[0].tracks) == schemas.encode(results[1].tracks)


def crowd(made: FusionCentre, count: int, second: float = 1.0) -> None:
    for k in range(count):
        give(made, info(f"n{k}"), tracks(f"n{k}", second, [[1e5 + 3e3 * k, 0, 0, 0]]))


def test_names_of_which_nothing_comes_any_more_rest_and_go() -> None:
    made = centre(("r1",), forget=30.0, coast=2.0)
    crowd(made, 20)
    counts, forgotten = {}, []
    for second in range(1, 60):
        give(made, tracks("r1", second, [[0, 0, 0, 0]]))
        result = step(made, second)
        counts[second] = len(result.status.sources), len(made._intake.sources)
        forgotten += [event["source"] for event in result.log.events if event["kind"] == "forgotten"]
        schemas.encode(result.status)
    assert counts[2] == (21, 21)
    assert counts[20] == (21, 1)
    assert counts[59] == (1, 1)
    assert sorted(forgotten) == sorted(f"n{k}" for k in range(20))


@pytest.mark.parametrize("how", ["message", "token", "order"])
def test_one_that_rests_is_awake_with_whatever_comes(how: str) -> None:
    made = centre(("r1",))
    give(made, info("n", epoch=3), tracks("n", 1, [[5e4, 0, 0, 0]], seq=7, epoch=3))
    for second in range(1, 20):
        give(made, tracks("r1", second, [[0, 0, 0, 0]]))
        said = step(made, second).status.sources["n"]
    assert said["resting"]
    assert said["stale"]
    resting = made._intake.resting["n"]
    assert resting.epoch == 3
    again = FusionCentre(made.config, made.checkpoint())
    for one in (made, again):
        event: Any = {
            "message": tracks("n", 20, [[5e4, 0, 0, 0]], seq=8, epoch=3),
            "token": SourceFound("n"),
            "order": Order("mute", "n"),
        }[how]
        give(one, event, tracks("r1", 20, [[0, 0, 0, 0]]))
        assert "n" not in one._intake.resting
        result = step(one, 20)
        assert "resting" not in result.status.sources["n"]
        assert result.status.sources["n"]["messages"] == (3 if how == "message" else 2)
        assert result.status.sources["n"]["muted"] is (how == "order")
        give(one, tracks("n", 20.5, [[5e4, 0, 0, 0]], seq=9, epoch=2))
        assert step(one, 21).status.refused.get("old-epoch", 0) == (how == "message")
    assert made.checkpoint() == again.checkpoint()


def test_one_with_a_history_or_a_name_in_the_config_does_not_rest_at_once() -> None:
    made = FusionCentre({"sources": {"named": {}}, "forget": 100.0, "lateness": 3.0})
    give(made, info("r1"), info("named"), info("old"), tracks("named", 1, [[5e4, 0, 0, 0]]))
    for second in range(1, 120):
        if second <= 2 * FEW:
            give(made, tracks("old", second, [[9e4, 0, 0, 0]]))
        give(made, tracks("r1", second, [[0, 0, 0, 0]]))
        step(made, second)
        if second == 2 * FEW + 40:
            assert "old" in made._intake.sources
    assert {*made._intake.sources} == {"named", "r1"}
    assert {*made._intake.resting} == {"old"}
    give(made, SourceLost("named"))
    step(made, 120)
    assert "named" in made._intake.sources


def test_tokens_alone_keep_nobody_out_who_speaks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fusion_service.centre.limits.MAX_SOURCES", 5)
    made = FusionCentre({"lateness": 3.0})
    give(made, *(SourceFound(f"t{k}") for k in range(8)))
    assert step(made, 1).status.refused == {"too-many-sources": 3}
    give(made, *(info(f"r{k}") for k in range(3)))
    assert step(made, 2).status.refused == {"too-many-sources": 3}
    assert sum(name.startswith("r") for name in {*made._intake.sources, *made._intake.resting}) == 3


def test_where_nothing_is_forgotten_nothing_rests() -> None:
    made = centre(("r1",), forget=0.0)
    crowd(made, 5)
    for second in range(1, 20):
        step(made, second)
    assert len(made._intake.sources) == 6


def test_resting_sources_cost_next_to_nothing() -> None:
    def cost(count: int) -> float:
        made = centre(("r1",))
        crowd(made, count)
        for second in range(1, 15):
            give(made, tracks("r1", second, [[0, 0, 0, 0]]))
            step(made, second)
        assert len(made._intake.sources) == 1
        spent = []
        for second in range(15, 30):
            give(made, tracks("r1", second, [[0, 0, 0, 0]]))
            begin = time.process_time()
            step(made, second)
            spent.append(time.process_time() - begin)
        return float(np.median(spent))

    assert (cost(400) - cost(0)) / 400 < 40e-6  # 2-3 us on an idle machine; 130-240 us were it in every table
