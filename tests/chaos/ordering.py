"""Mutated orders through the desk of a service and a real centre: an answer, or a `ValueError` that says why not."""

from __future__ import annotations

import random
import time
import traceback
from collections import Counter
from typing import Any

import msgpack

from fusion_service.centre import Order, make_centre
from fusion_service.config import centre_config
from fusion_service.order import STATES, WHAT
from fusion_service.service.ordering import OrderDesk
from tests.centre.worlds import SECOND, START
from tests.chaos.centres import HONEST, honest, look
from tests.chaos.mutations import STRANGE, mutated
from tests.chaos.report import Report

__all__ = ["fuzz_orders"]

EACH = 40
"""Orders between two steps."""
STEPS = 60
"""Steps of one centre."""


def fuzz_orders(seed: int, until: float, most: int = 2**62) -> Report:
    """Orders until `until`, of the monotonic clock, or `most` of them."""
    report = Report("orders")
    rng = random.Random(seed)
    counts: Counter[str] = Counter()
    while report.tried < most and time.monotonic() < until:
        try:
            _mission(rng, most, report, counts)
        except Exception:
            report.escaped(f"the step failed: {traceback.format_exc(limit=-4)}")
    report.say(", ".join(f"{what} {count:,}" for what, count in counts.most_common()))
    if counts["taken by the desk"] != counts["answered"]:
        report.escaped("not every order was answered once")
    return report


def _mission(rng: random.Random, most: int, report: Report, counts: Counter[str]) -> None:
    """Some seconds of honest sources, and orders about what there is."""
    centre, _ = make_centre(centre_config({"remember": 20.0}))
    given: list[Order] = []
    desk = OrderDesk(given.append)
    ids: list[int] = []
    for second in range(1, STEPS):
        now = START + second * SECOND
        for _ in range(min(EACH if ids else 0, most - report.tried)):
            _order(rng, desk, ids, report, counts)
        for order in given:
            desk.given(order)
            centre.handle(order, now)
        counts["in a step"] += len(given)
        given.clear()
        for _, event, received in honest(centre.config, second):
            centre.handle(event, received)
        result = centre.step(now)
        look(result)
        desk.promises.settle((event for event in result.log.events if event.get("kind") == "order"), kept=True)
        desk.promises.release()
        ids = result.picture.ids.tolist()
        if second % 8 == 0:
            centre, fault = make_centre(centre.config, centre.checkpoint(), generation=second)
            assert not fault, fault
        desk.follow(centre)


def _order(rng: random.Random, desk: OrderDesk, ids: list[int], report: Report, counts: Counter[str]) -> None:
    data = mutated(rng, _sound(rng, [*ids, 1, 2**64 - 1]))
    report.tried += 1

    def reply(answer: bytes | Exception) -> None:
        counts["answered"] += 1
        if not isinstance(answer, bytes) or not isinstance(msgpack.unpackb(answer), dict):
            report.escaped(f"an answer that is none: {answer!r}", data)

    try:
        desk.answer(data, reply, rng.choice(("", "", "alice", "a b")))
    except ValueError:
        counts["refused by the desk"] += 1
    except Exception:
        report.escaped(f"the desk: {traceback.format_exc(limit=-3)}", data)
    else:
        counts["taken by the desk"] += 1


def _sound(rng: random.Random, ids: list[int]) -> dict[str, Any]:
    """An order that may be sound."""

    def local() -> list[Any]:
        return [rng.choice((*HONEST, "nobody")), rng.choice((-1, 1, None, 7)), rng.randrange(1, 6)]

    everything: dict[str, Any] = {
        "source": rng.choice((*HONEST, "nobody")),
        "track": rng.choice((*ids, "1", "1.1", "Alfa")),
        "other": rng.choice(ids),
        "local": local(),
        "against": local(),
        "name": rng.choice(("Alfa", "B 7", "x" * 200)),
        "shown": rng.randrange(100),
        "identity": rng.choice(("mmsi:257000000", "hostile", "friend")),
        "state": rng.choice((*STATES, "auto")),
        "number": rng.randrange(50),
        "withdrawn": rng.randrange(50),
        "for": rng.choice((0.5, 10, 1e9, -1.0, float("nan"))),
        "until": START + rng.randrange(100) * SECOND,
        "who": "bob",
        "why": rng.choice(("", "because", rng.choice(STRANGE))),
    }
    kept = {name: value for name, value in everything.items() if rng.random() < 0.6}
    return {"what": rng.choice((*WHAT, "list")), **kept}
