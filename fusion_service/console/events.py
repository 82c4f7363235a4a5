"""Events of a step log in words for an operator, those that no other room has words for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fusion_service.decision_words import made_again

__all__ = ["event_words", "local_words", "short"]

LONGEST = 120
MOST = 6
"""Values of an event that is not known that are told."""


def event_words(kind: str, event: Mapping[str, Any], at: int) -> str:
    """What an event says; at: ms, time of its step."""
    if kind == "start":
        kept = "checkpoint" in event or "left_out" in event
        return f"the service began{' anew from its checkpoint' if kept else ', without a checkpoint'}"
    if kind == "revised":
        return f"steps were {made_again(event, at * 10**6)}"
    if kind == "skipped":
        return f"{short(event.get('steps'))} steps were skipped: more comes than can be worked off"
    if kind == "era":
        return "the clock was set back: a new era began"
    if kind in ("suspended", "resumed"):
        count = len(event["tracks"]) if isinstance(event.get("tracks"), (list, tuple)) else 0
        return (
            f"{count} tracks {'suspended: all that could see them are silent' if kind == 'suspended' else 'are back'}"
        )
    if kind == "forgotten":
        return f"{short(event.get('source'))} was silent for so long that it is forgotten"
    if kind == "frame":
        return f"the picture is in the frame of {short(event.get('source'))} from now on"
    if kind == "order_ended":
        return (
            f"order {short(event.get('number'))} ({short(event.get('what'))}) stands no more: {short(event.get('why'))}"
        )
    if kind in ("copy", "copy_over") and event.get("why", kind == "copy_over"):
        return f"{short(event.get('source'))} {short(event.get('why', 'is no copy any more'))}"
    plain = [(key, value) for key, value in event.items() if key not in ("kind", "epoch")]
    told = [f"{key} {short(value)}" for key, value in plain if isinstance(value, (str, int, float))][:MOST]
    return f"{kind.replace('_', ' ')} ({', '.join(told)})" if told else kind.replace("_", " ")


def local_words(value: Any) -> str:
    """A local track as it stands in an order: its source and id."""
    return f"{short(value[0])} {short(value[2])}" if isinstance(value, (list, tuple)) and len(value) == 3 else ""


def short(value: Any) -> str:
    """Any value as a text of bounded length."""
    return f"{len(value)} bytes" if isinstance(value, bytes) else str(value)[:LONGEST]
