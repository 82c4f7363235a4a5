"""What a centre is told beside messages, and all that it may be told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from fusion_service.centre.era import ClockSet, NewEra
from fusion_service.order import Order
from schemas import Message

__all__ = ["Event", "Refused", "Skipped", "SourceFound", "SourceLost"]


@dataclass(frozen=True, slots=True)
class SourceFound:
    """The source's liveliness token is there."""

    source: str


@dataclass(frozen=True, slots=True)
class SourceLost:
    """The source's liveliness token is gone: its tracks live on until they are stale."""

    source: str


@dataclass(frozen=True, slots=True)
class Refused:
    """Something refused, or `dropped` from a full queue, before it came here: to be counted and logged."""

    source: str
    reason: str
    count: int = 0
    dropped: bool = False


@dataclass(frozen=True, slots=True)
class Skipped:
    """So many steps before the next one are not made, since the service is behind: told in the log. absent: since none
    was there, so that nobody knows what came meanwhile."""

    steps: int
    absent: bool = False


Event: TypeAlias = Message | SourceFound | SourceLost | Order | Refused | Skipped | ClockSet | NewEra
