"""What a centre says of a source in its status and in the events of its step logs, in words for people.

Whatever a status holds may be shown: what is not of the right kind is left out, and texts are cut.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from fusion_service.ways import no_tracklets

__all__ = ["MOST_SIGMAS", "Bias", "biases", "consistency", "source_event", "source_health", "state_of"]

MOST_SIGMAS = 2.0
"""Bounds of a bias are so many standard deviations."""
LONGEST = 300
"""Characters of a text of the centre that are shown."""
SHOWN: dict[str, tuple[str, str, float]] = {
    "clock": ("clock", "s", 1.0),
    "x": ("x", "m", 1.0),
    "y": ("y", "m", 1.0),
    "z": ("z", "m", 1.0),
    "heading": ("heading", "°", 180.0 / math.pi),
    "range": ("range", "m", 1.0),
    "scale": ("scale", "%", 100.0),
    "drift": ("drift of the clock", "ms/s", 1000.0),
}
"""Name, unit and factor by which each part of a bias is shown."""
NO_ALARM = ("trusted", "")


class Bias(NamedTuple):
    """One part of a source's bias: key, name, unit; value and sigma in it; whether it is observable, and why not."""

    key: str
    name: str
    unit: str
    value: float
    sigma: float
    observable: bool
    why: str

    def __str__(self) -> str:
        if not self.observable:
            return f"{self.name}: not observable" + (f" ({self.why})" if self.why else "")
        return f"{self.name} {self.value:+.3g} ± {self.sigma:.2g} {self.unit}"


def biases(said: Mapping[str, Any]) -> list[Bias]:
    """The parts of the bias in a source's entry of a status."""
    told = said.get("bias")
    found = []
    for key, (name, unit, factor) in SHOWN.items():
        one = told.get(key) if isinstance(told, Mapping) else None
        if not isinstance(one, Mapping):
            continue
        value, sigma = _number(one.get("value")), _number(one.get("sigma"))
        if value is not None and sigma is not None:
            seen = bool(one.get("observable"))
            found.append(Bias(key, name, unit, factor * value, factor * sigma, seen, _text(one.get("why"))))
    return found


def state_of(said: Mapping[str, Any]) -> str:
    """How the centre treats a source: trusted, watch, inflated, union, out; "" where it does not say."""
    return _text(said.get("state"))


def consistency(said: Mapping[str, Any]) -> tuple[float, float, float] | None:
    """The mean normalised square of a source beside the others, and its bounds; None where it is not known."""
    value, low, high = (_number(said.get(f"consistency{end}")) for end in ("", "_low", "_high"))
    return None if value is None or low is None or high is None else (value, low, high)


def source_health(said: Mapping[str, Any]) -> list[str]:
    """What a source's entry in a status says of how it is trusted, sentence by sentence; nothing where all is well and
    nothing known."""
    state, why = state_of(said), _text(said.get("state_why"))
    lines = [] if state in NO_ALARM else [f"{state}: {why}" if why else state]
    seen = [str(one) for one in biases(said) if one.observable]
    if note := _text(said.get("bias_note")):
        lines.append(note)
    elif seen:
        lines.append(f"{', '.join(seen)}{', taken off' if said.get('bias_applied') is True else ''}")
    alarms = said.get("alarms")
    if isinstance(alarms, (list, tuple)):
        lines += [_text(one) for one in alarms if isinstance(one, str)]
    return [line for line in lines if line]


def source_event(event: Mapping[str, Any]) -> tuple[bool, str] | None:
    """Whether an event of a step log is bad news of its source, and what it says; None if it is not about one."""
    kind, why = event.get("kind"), _text(event.get("why"))
    if kind == "tracklets":
        return bool(why), no_tracklets(event)
    if kind == "supervision":
        state, was = _text(event.get("state")), _text(event.get("was"))
        text = f"{state}{f', was {was}' if was else ''}{f': {why}' if why else ''}"
        return state not in NO_ALARM, text
    if kind == "registration":
        taken = "its bias is taken off" if event.get("applied") is True else "its bias is not taken off"
        return bool(event.get("applied")), why or taken
    if kind in ("alarm", "alarm_over") and _text(event.get("source")):
        over = "no more: " if kind == "alarm_over" else "alarm: "
        what = _text(event.get("what"))
        return kind == "alarm", f"{over}{what}{f': {why}' if why else _rest(event)}"
    return None


def _rest(event: Mapping[str, Any]) -> str:
    shown = [f"{key} {_text(str(value))}" for key, value in event.items() if key not in ("kind", "what", "source")]
    return f" ({', '.join(shown)})" if shown else ""


def _number(value: Any) -> float | None:
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if good else None


def _text(value: Any) -> str:
    return value[:LONGEST] if isinstance(value, str) else ""
