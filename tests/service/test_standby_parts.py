"""What goes on between two processes of a centre, piece by piece and without a bus."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from fusion_service.centre import Order
from fusion_service.order import order_event
from fusion_service.service.deafness import APART, FEW, Deafness
from fusion_service.service.handover import NOBODY, PATIENCE, Handover
from fusion_service.service.heard import MOST, HeardOrders
from fusion_service.service.held import HeldOrders
from fusion_service.service.state import open_state


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def event(number: int, source: str = "r1") -> dict[str, Any]:
    return order_event(Order("mute", source, number=number))


def test_orders_that_no_checkpoint_has_are_given_again() -> None:
    heard = HeardOrders()
    heard.tell(100, [event(1), {"kind": "start"}, event(2)])
    assert heard.known == 2
    heard.settle(100, 2)
    assert [one.number for one in heard.since(2)] == [2]
    heard.tell(100, [event(3), {"kind": "order", "what": 7}, {"kind": "order", "what": "mute", "number": -1}])
    assert [one.number for one in heard.since(1)] == [2, 3]
    assert [one.number for one in heard.since(3)] == [3]
    # another run goes on: what it says counts, and what it does not know is forgotten with its checkpoint
    heard.tell(200, [event(2, "r2")])
    assert heard.known == 2
    assert [(one.number, one.source) for one in heard.since(1)] == [(2, "r2"), (3, "r1")]
    heard.tell(100, [event(9)])
    assert heard.known == 2, "the run that is over"
    heard.settle(200, 2)
    assert [(one.number, one.source) for one in heard.since(1)] == [(2, "r2")]
    heard.tell(200, [event(k) for k in range(1, 2 * MOST)])
    assert heard.full
    assert len(heard.since(1)) == MOST
    heard.settle(200, 2 * MOST)
    assert not heard.full
    assert heard.known == 2 * MOST - 1


@pytest.mark.parametrize("kept", [True, False])
def test_who_takes_over_has_the_orders_of_the_other_whether_it_keeps_a_state_or_not(tmp_path: Path, kept: bool) -> None:
    orders = [Order("mute", f"r{k}", number=k) for k in range(4, 7)]
    with open_state(str(tmp_path) if kept else None) as state:
        state.inherit(b"checkpoint", np.zeros(0, dtype=np.uint64), 1, 1, orders)
        assert state.held.read(5) == orders[1:]
        assert state.held.read(5) == (orders[1:] if kept else [])
    assert HeldOrders(tmp_path).read(1) == (orders if kept else [])


def test_a_handover_waits_until_one_is_in_step_and_says_why_if_none_is() -> None:
    clock, said = Clock(), list[Any]()
    handover = Handover(clock)
    order = msgpack.packb({"what": "handover", "who": "anna"})
    listed = msgpack.packb({"what": "list", "who": "handover"})
    for other in (None, b"", b"handover", msgpack.packb(["handover"]), listed):
        assert not handover.take(other, "", said.append)
    assert not handover.due({"b": ""}), "nobody asked"

    def answers() -> list[dict[str, Any]]:
        read = [msgpack.unpackb(one) for one in said]
        said.clear()
        return read

    assert handover.take(order, "", said.append)
    assert not handover.due({})
    assert said == []
    clock.now = NOBODY
    assert not handover.due({})
    assert answers() == [{"done": False, "outcome": "nobody stands by"}]
    assert handover.take(order, "", said.append)
    assert not handover.due({"b": "has none yet"})
    assert said == []
    clock.now += PATIENCE / 2
    assert handover.due({"a": "has none yet", "b": ""})
    handover.done(8, "")
    assert answers() == [{"done": True, "outcome": "the other one goes on, under term 8"}]
    assert not handover.due({"b": ""}), "it is done"
    assert handover.take(order, "", said.append)
    clock.now += PATIENCE
    assert not handover.due({"b": "has none yet"})
    [answer] = answers()
    assert not answer["done"]
    assert "b has none yet" in answer["outcome"]
    assert handover.take(order, "", said.append)
    assert handover.due({"b": ""})
    handover.done(0, "nobody took over")
    assert answers() == [{"done": False, "outcome": "nobody took over"}]
    for _ in range(100):
        assert handover.take(order, "", said.append)
    handover.done(0, "the service stops")
    assert len(said) == 100


def test_deaf_is_who_misses_many_for_long() -> None:
    clock = Clock()
    deafness = Deafness(clock)

    def live(seconds: float, age: object, every: int = 1) -> float:
        """So long with a message every tenth of a second, or every so many, and the age that the other says."""
        for k in range(round(seconds * 10)):
            clock.now += 0.1
            if k % every == 0:
                deafness.sample()
            deafness.told(age(k) if callable(age) else age)
        return deafness.seconds()

    assert live(10.0, 0.05) == 0.0, "it hears"
    assert live(10.0, None) == 0.0, "it does not say"
    assert live(10.0, APART) == 0.0, "they are on their way"
    assert live(8.0, lambda k: 0.1 * k) == pytest.approx(7.0, abs=0.3)
    assert live(0.1, 0.0) == 0.0, "it hears again"
    assert live(60.0, lambda k: 0.1 * k, every=600) == 0.0, "one was lost, and nobody speaks"
    assert live(0.9 * FEW, lambda k: 10.0 + 0.1 * k) == 0.0 or FEW > 9
