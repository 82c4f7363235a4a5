"""Sources with their health, figures of the centre, and alarms, for the page: of a status, as `hints.health` tells.

An alarm is a sentence that says what is wrong; it is the same alarm as long as only the numbers in it change.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from fusion_service.colours import source_colours
from fusion_service.hints.health import STATES, Row, health_of
from fusion_service.labels import Labels
from schemas import GlobalTracks, Status

__all__ = ["Alarms", "health"]

MOST_SOURCES = 300
MOST_ALARMS = 200
LONGEST = 400
WHOLE_ID = re.compile(r"\d{10,20}", re.ASCII)
NUMBER = re.compile(r"[-+]?\d[\d.,]*(e[-+]?\d+)?")


class Alarms:
    """The alarms that stand, each since when, ms."""

    def __init__(self) -> None:
        self._since: dict[str, int] = {}

    def of(self, wrong: list[str], now: int) -> list[dict[str, Any]]:
        """The alarms of these sentences at `now`, ms, the newest first."""
        said = {NUMBER.sub("#", line): line for line in reversed(wrong)}
        self._since = {key: self._since.get(key, now) for key in said}
        found = [{"since": self._since[key], "text": line} for key, line in said.items()]
        return sorted(found, key=lambda one: -one["since"])


def health(status: Status, picture: GlobalTracks | None, now: int, alarms: Alarms, label: Labels) -> dict[str, Any]:
    """The message of a centre's health at `now`, ns; label: the short names of its tracks."""
    found = health_of(status, picture, now)
    known = frozenset(picture.ids.tolist()) if picture is not None else frozenset()

    def brief(text: str) -> str:
        """A sentence with tracks by their short names."""
        return WHOLE_ID.sub(lambda one: label(int(one[0])) if int(one[0]) in known else one[0], text[:LONGEST])

    colours = source_colours(row.name for row in found.rows)
    rows = sorted(found.rows, key=lambda row: row.urgency)[:MOST_SOURCES]
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
        "notes": [brief(note) for note in (status.notes or ())[:20]],
        "sources": [_source(row, status.sources[row.name], colours[row.name], brief) for row in rows],
        "beyond": found.beyond + len(found.rows) - len(rows),
        "alarms": alarms.of([brief(line) for line in found.wrong[:MOST_ALARMS]], now // 10**6),
    }


def _source(row: Row, said: Mapping[str, Any], colour: str, brief: Callable[[str], str]) -> dict[str, Any]:
    """A source: its state, figures, what is wrong and what else is known, and its last refusal with the remedy."""
    last = said.get("last_refusal")
    refusal = None
    if isinstance(last, Mapping):
        when, count = last.get("time"), last.get("count")
        refusal = {
            "reason": str(last.get("reason"))[:60],
            "count": count if isinstance(count, int) else None,
            "said": str(last.get("said"))[:LONGEST],
            "time": when // 10**6 if isinstance(when, int) else None,
        }
    return {
        "name": row.name,
        "colour": colour,
        "state": row.state,
        "means": STATES[row.state],
        "trust": row.trust,
        "rate": row.rate,
        "period": row.period,
        "latency": row.latency,
        "clock": row.clock,
        "tracks": row.tracks,
        "share": row.share,
        "refused": row.refused,
        "gaps": row.gaps,
        "wrong": [brief(one) for one in row.faults[:10]],
        "more": [brief(one) for one in row.more[:10]],
        "refusal": refusal,
    }
