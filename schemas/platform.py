"""Where a sensor that moves is, and how it is turned, when its tracks hold."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Platform", "pack_platform", "read_platform"]

FURTHEST = 1e12
_FULL = np.array([[0, 1, 3], [1, 2, 4], [3, 4, 5]])
_LOWER = (0, 1, 1, 2, 2, 2), (0, 0, 1, 0, 1, 2)


@dataclass(frozen=True, slots=True, eq=False)
class Platform:
    """position (x, y, z), m, in the frame of the tracks; position_covariance (3, 3), m2: of an error that shifts all
    tracks alike; heading, rad, clockwise from north (+y of the frame); heading_sigma, rad: of an error that turns all
    tracks about the position alike. Raises `ValueError` for what cannot be."""

    position: tuple[float, float, float]
    position_covariance: NDArray[np.float64] | None = None
    heading: float | None = None
    heading_sigma: float | None = None

    def __post_init__(self) -> None:
        if len(self.position) != 3 or not all(abs(part) <= FURTHEST for part in self.position):
            raise ValueError(f"platform: position is {self.position}, not three numbers within {FURTHEST:g}")
        for name, low, high in (("heading", -2 * math.pi, 2 * math.pi), ("heading_sigma", 0.0, math.pi)):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ValueError(f"platform: {name} is {value}, not from {low:g} to {high:g}")
        if self.position_covariance is not None:
            _check(np.asarray(self.position_covariance))


def _check(P: NDArray[np.float64]) -> None:
    if P.shape != (3, 3) or not np.isfinite(P).all() or np.abs(P - P.T).max() > 1e-9 * np.abs(P).max():
        raise ValueError("platform: position_covariance is not a symmetric matrix (3, 3) of finite numbers")
    if np.linalg.eigvalsh(P)[0] < -1e-9 * np.abs(P).max():
        raise ValueError("platform: position_covariance is not positive semidefinite")


def pack_platform(value: Platform) -> dict[str, Any]:
    """As a map, without what is not said."""
    packed: dict[str, Any] = {"position": [float(part) for part in value.position]}
    if value.position_covariance is not None:
        packed["position_covariance"] = np.asarray(value.position_covariance, dtype="<f8")[_LOWER].tobytes()
    said = (("heading", value.heading), ("heading_sigma", value.heading_sigma))
    return packed | {name: float(one) for name, one in said if one is not None}


def read_platform(value: Any) -> Platform:
    """From the map on the wire. ValueError, TypeError if it is none."""
    if type(value) is not dict:
        raise ValueError("not a map")
    position = value.get("position")
    if type(position) is not list or len(position) != 3:
        raise ValueError("position: not a list of 3")
    x, y, z = (_number(part) for part in position)
    packed, P = value.get("position_covariance"), None
    if packed is not None:
        if type(packed) is not bytes or len(packed) != 48:
            raise ValueError("position_covariance: not 6 numbers f64")
        P = np.frombuffer(packed, "<f8")[_FULL]
        P.flags.writeable = False
    heading, sigma = (None if one is None else _number(one) for one in map(value.get, ("heading", "heading_sigma")))
    return Platform((x, y, z), P, heading, sigma)


def _number(value: Any) -> float:
    if type(value) not in (int, float):
        raise ValueError("not a number")
    return float(value)
