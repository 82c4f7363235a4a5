"""A recorded mission whose centre says of its sources what the real one may say: states, biases, events."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import schemas
from tests.helpers.flown import record
from tests.helpers.tracklets import fly

__all__ = ["CLOCK", "HEADING", "STEPS", "WHY", "mission", "said"]

STEPS = 8
CLOCK = 0.5
HEADING = 0.01
WHY = "its positions scatter 5.5 times what it says"


def said(step: int) -> dict[str, dict[str, Any]]:
    """What the centre says of two of the three sources after a step."""
    sigma = 0.4 / (step + 1)
    bias = {
        "clock": {"value": CLOCK, "sigma": sigma, "observable": True, "why": ""},
        "x": {"value": 30.0, "sigma": 100 * sigma, "observable": True, "why": ""},
        "y": {"value": -40.0, "sigma": 50 * sigma, "observable": True, "why": ""},
        "heading": {"value": HEADING, "sigma": 0.5, "observable": False, "why": "nothing moves across"},
    }
    beside = {"consistency": 1.0 + 0.5 * step, "consistency_low": 0.5, "consistency_high": 1.6}
    return {
        "r1": {"state": "trusted", "state_why": "", **beside, "consistency": 0.9, "consistency_low": 0.7},
        "r2": {"state": "inflated", "state_why": WHY, **beside, "bias": bias, "bias_applied": True,
               "alarms": ["track 4 stands still to the bit"]},
    }  # fmt: skip


EVENTS: dict[int, list[dict[str, Any]]] = {
    3: [{"kind": "supervision", "source": "r2", "state": "inflated", "was": "trusted", "why": WHY}],
    4: [{"kind": "registration", "source": "r2", "applied": True, "why": "clock +0.5 s"}],
    5: [{"kind": "alarm", "what": "stuck", "source": "r2", "why": "track 4 stands still to the bit"}],
    6: [{"kind": "alarm_over", "what": "stuck", "source": "r2"}],
}


def mission(path: Path, *, draw: bool = False) -> Path:
    """Record it: a status after each step, and the events in its logs."""
    flight = fly(STEPS)
    log = []
    step = -1
    for key, data, received in flight.log:
        message = schemas.decode(data)
        if isinstance(message, schemas.StepLog):
            step += 1
            data = schemas.encode(replace(message, events=(*message.events, *EVENTS.get(step, ()))))
        elif isinstance(message, schemas.Status):
            told = said(step)
            sources = {name: {**one, **told.get(name, {})} for name, one in message.sources.items()}
            hostile = {"state": 7, "consistency": math.nan, "bias": {"clock": {"value": "x", "sigma": 1.0}, "x": 3}}
            sources["r3"] |= hostile
            data = schemas.encode(replace(message, sources=sources))
        log.append((key, data, received))
    assert step == STEPS - 1
    return record(path, log, draw=draw)
