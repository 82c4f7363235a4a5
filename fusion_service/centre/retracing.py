"""A step made again as its log says: from what the log names, and what else it says came in."""

from __future__ import annotations

from collections.abc import Iterable

from fusion_service.centre.centre import Centre
from fusion_service.centre.era import NewEra
from fusion_service.centre.events import Event, Refused, Skipped, SourceFound, SourceLost
from fusion_service.centre.inputs import Input
from fusion_service.centre.result import StepResult
from fusion_service.order import order_of
from schemas import StepLog

__all__ = ["events_of", "step_again"]


def events_of(log: StepLog) -> list[Event]:
    """What the log says came in beside messages, or was lost before it came in."""
    events: list[Event] = [Refused(one.source, one.reason, one.count, dropped=True) for one in log.dropped]
    for event in log.events:
        kind, source = event.get("kind"), event.get("source")
        if kind in ("found", "lost") and isinstance(source, str):
            events.append((SourceFound if kind == "found" else SourceLost)(source))
        elif kind == "skipped" and isinstance(event.get("steps"), int):
            events.append(Skipped(event["steps"], event.get("absent") is True))
        elif kind == "era" and isinstance(event.get("time"), int):
            events.append(NewEra(event["time"]))
        elif (order := order_of(event)) is not None:
            events.append(order)
    return events


def step_again(centre: Centre, events: Iterable[Event], inputs: Iterable[Input], at: int) -> StepResult:
    """The step at `at`, ns, with these events and inputs: none of them is refused for having come too early."""
    for event in events:
        centre.handle(event, at)
    if at <= centre.time:
        centre.handle(NewEra(at - 1), at)
    for one in inputs:
        centre.handle(one.message, max(one.received, getattr(one.message, "time", 0), one.message.epoch, at))
    return centre.step(at)
