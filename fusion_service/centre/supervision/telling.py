"""What is said of the errors of a source, in numbers and in words."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from fusion_service.arrays import Bools, Floats
from fusion_service.centre.supervision.bias import CLOCK, DRIFT, PARAMETERS, UNITS, X, Y

__all__ = ["OBSERVED", "Told", "entry", "note", "numbers", "observable"]

OBSERVED = 0.5
"""Of what is supposed beforehand: an error that is known no better than that is not observable."""
FEW = 3.0
SLOW = 1.0
"""m/s: what moves no faster says little of clocks."""
ONE_WAY = 0.02
"""Share of the squares of velocities across the main direction, below which all move in one."""


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """Of one source: mean (7,) and covariance (7, 7) of its errors, sigma (7,) supposed beforehand; seen (6,): faded
    sums over its shared targets of 1, vx, vy, vx^2, vx vy, vy^2; shares: it has any with another source."""

    mean: Floats
    covariance: Floats
    sigma: Floats
    seen: Floats
    shares: bool

    @property
    def spread(self) -> Floats:
        """Standard deviations (7,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))


def observable(told: Told) -> Bools:
    """Which errors (7,) the shared targets tell."""
    return told.shares & (told.sigma > 0) & (told.spread <= OBSERVED * told.sigma)


def entry(told: Told) -> dict[str, dict[str, Any]]:
    """Each error that is estimated: value, sigma, whether it is observable, and if not, why."""
    seen, spread = observable(told), told.spread
    return {
        name: {
            "value": float(told.mean[k]),
            "sigma": float(spread[k]),
            "observable": bool(seen[k]),
            "why": "" if seen[k] else _why(told, k),
        }
        for k, name in enumerate(PARAMETERS)
        if told.sigma[k] > 0
    }


def _why(told: Told, parameter: int) -> str:
    if not told.shares:
        return "no common targets"
    count = max(float(told.seen[0]), 1e-9)
    squares = np.array([[told.seen[3], told.seen[4]], [told.seen[4], told.seen[5]]]) / count
    values, axes = np.linalg.eigh(squares)
    if parameter in (CLOCK, DRIFT) and math.sqrt(max(float(values.sum()), 0.0)) < SLOW:
        return "its targets hardly move"
    if parameter == DRIFT:
        return "it is not seen for long enough"
    if parameter in (CLOCK, X, Y) and values[0] < ONE_WAY * values[1] and values[1] > SLOW**2:
        way = axes[:, 1]
        mean = float(told.seen[1] * way[0] + told.seen[2] * way[1]) / count
        if mean**2 > 0.3 * float(values[1]) and (parameter == CLOCK or abs(way[parameter - X]) > 0.3):
            c = np.zeros(len(PARAMETERS))
            c[CLOCK], c[X], c[Y] = -mean, *way
            known = math.sqrt(max(float(c @ told.covariance @ c), 0.0))
            return (
                "its targets move in one direction: clock and place along it cannot be told apart; "
                f"together known to {known:.3g} m"
            )
    return "too few common targets" if count < FEW else "the common targets do not tell it"


def numbers(told: Told) -> dict[str, float]:
    """For an event."""
    out: dict[str, float] = {}
    spread = told.spread
    for k, name in enumerate(PARAMETERS):
        if told.sigma[k] > 0:
            out |= {name: round(float(told.mean[k]), 6), f"{name}_sigma": round(float(spread[k]), 6)}
    return out


def note(told: Told, applied: bool, found: bool, corrects: bool) -> str:
    """A sentence on what is found and done."""
    if not told.shares:
        return "no common targets: nothing is known of its clock and place" if told.sigma.any() else ""
    if not found:
        return "no error of clock or place that is certain and matters"
    spread = told.spread
    parts = [
        _worded(name, float(told.mean[k]), float(spread[k]), unit)
        for k, (name, unit) in enumerate(zip(PARAMETERS, UNITS, strict=True))
        if told.sigma[k] > 0 and abs(told.mean[k]) > 2.0 * spread[k]
    ]
    done = "taken off" if applied else "not taken off yet" if corrects else "told only (registration = estimate)"
    return f"{', '.join(parts) or 'errors that are certain only together'}: {done}"


def _worded(name: str, value: float, sigma: float, unit: str) -> str:
    if name == "clock":
        return f"clock {abs(value):.3g} +- {sigma:.2g} s {'late' if value > 0 else 'early'}"
    if unit == "rad":
        return f"{name} {math.degrees(value):+.3g} +- {math.degrees(sigma):.2g} degrees"
    return f"{name} {value:+.3g} +- {sigma:.2g}" + (f" {unit}" if unit else "")
