"""Sources with their health, figures of the centre, and alarms, for the page: of a status, as `hints.health` tells.

An alarm is a sentence that says what is wrong; it is the same alarm as long as only the numbers in it change.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from fusion_service.colours import source_colours
from fusion_service.hints.health import health_of
from fusion_service.source_words import state_of
from schemas import GlobalTracks, Status

__all__ = ["Alarms", "health"]

MOST_SOURCES = 300
MOST_ALARMS = 200
LONGEST = 400
NUMBER = re.compile(r"[-+]?\d[\d.,]*(e[-+]?\d+)?")
FIGURES = ("rate", "declared_period", "latency", "clock", "tracks", "linked_share", "messages", "gaps", "offset")


class Alarms:
    """The alarms that stand, each since when, ms."""

    def __init__(self) -> None:
        self._since: dict[str, int] = {}

    def of(self, wrong: list[str], now: int) -> list[dict[str, Any]]:
        """The alarms of these sentences at `now`, ms, the newest first."""
        said = {NUMBER.sub("#", line): line for line in reversed(wrong[:MOST_ALARMS])}
        self._since = {key: self._since.get(key, now) for key in said}
        found = [{"since": self._since[key], "text": line[:LONGEST]} for key, line in said.items()]
        return sorted(found, key=lambda one: -one["since"])


def health(status: Status, picture: GlobalTracks | None, now: int, alarms: Alarms) -> dict[str, Any]:
    """The message of a centre's health at `now`, ns."""
    found = health_of(status, picture, now)
    told: Mapping[str, Mapping[str, Any]] = found.data["sources"]
    names = [name for name in told if name != "*"]
    colours = source_colours(names)
    steps = status.step_time
    figures = {
        "up": status.uptime,
        "step": status.step,
        "step_ms": 1e3 * steps.get("mean", 0.0),
        "latency": steps.get("latency"),
        "waiting": status.queue.get("waiting"),
        "capacity": status.queue.get("capacity"),
        "messages": status.rates.get("messages"),
        "refused": sum(status.refused.values()),
        "dropped": sum(status.dropped.values()),
        "skipped": steps.get("skipped"),
    }
    return {
        "type": "health",
        "figures": figures,
        "notes": [note[:LONGEST] for note in (status.notes or ())[:20]],
        "sources": [_source(name, told[name], colours[name]) for name in names[:MOST_SOURCES]],
        "beyond": max(len(names) - MOST_SOURCES, 0),
        "alarms": alarms.of(found.wrong, now // 10**6),
    }


def _source(name: str, said: Mapping[str, Any], colour: str) -> dict[str, Any]:
    """A source: its state, figures, what is wrong, and its last refusal with the remedy."""
    last = said.get("last_refusal")
    refusal = None
    if isinstance(last, Mapping):
        when = last.get("time")
        refusal = {
            "reason": str(last.get("reason"))[:60],
            "count": last.get("count"),
            "said": str(last.get("said"))[:LONGEST],
            "time": when // 10**6 if isinstance(when, int) else None,
        }
    gone, stale = said.get("alive") is False, said.get("stale") is True
    state = (said.get("muted") is True and "muted") or (gone and "gone") or (stale and "silent") or "there"
    wrong = said.get("wrong")
    return {
        "name": name,
        "colour": colour,
        "state": state,
        "trust": state_of(said),
        "wrong": [str(one)[:LONGEST] for one in wrong[:10]] if isinstance(wrong, (list, tuple)) else [],
        "refusal": refusal,
        **{key: _figure(said.get(key)) for key in FIGURES},
    }


def _figure(value: Any) -> float | None:
    """A number, or nothing."""
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else None
