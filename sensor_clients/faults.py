"""A source made wrong on purpose: what it says of simulated or recorded targets, as a faulty sensor would.

clock=0.5     its stamps are half a second too late
delay=2       its messages come two seconds late
x=200, y=-50  what it reports lies 200 m too far east, 50 m too far south
heading=0.3   ... is turned about its place by 0.3 degrees, anticlockwise
range=100     ... is 100 m too far from its place; scale=0.01: by a hundredth of its range
sigma=0.33    its standard deviations are a third of what they should be
loss=0.2      every fifth of its messages is lost, at random
stuck=60      from a minute after its start on it repeats the last it has seen
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensor_clients.events import Event

__all__ = ["Fault", "faulty", "read_fault"]

SECOND = 10**9
Floats = NDArray[np.float64]
TRACKS = ("tracks", "intensity")


@dataclass(frozen=True, slots=True)
class Fault:
    """What is wrong with a source; the defaults are nothing. Units and signs: see the head of this module."""

    clock: float = 0.0
    delay: float = 0.0
    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    range: float = 0.0
    scale: float = 0.0
    sigma: float = 1.0
    loss: float = 0.0
    stuck: float = math.inf


def read_fault(text: str) -> Fault:
    """What `clock=0.5,x=200` says. `ValueError` says what is wrong, and what is known."""
    known = [one.name for one in fields(Fault)]
    found: dict[str, float] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or name not in known:
            raise ValueError(f"no fault {part!r}; write NAME=NUMBER, NAME one of {', '.join(known)}")
        try:
            found[name] = float(value)
        except ValueError:
            raise ValueError(f"{name}: {value!r} is no number") from None
        if not math.isfinite(found[name]):
            raise ValueError(f"{name}: {value!r} is not finite")
    fault = Fault(**found)
    if not (fault.sigma > 0 and 0 <= fault.loss < 1 and fault.delay >= 0 and fault.stuck >= 0 and fault.scale > -1):
        raise ValueError("sigma is above 0, loss in [0, 1), delay and stuck not below 0, scale above -1")
    return fault


def faulty(events: Iterator[Event], fault: Fault, seed: int = 0) -> Iterator[Event]:
    """The events of a source with the fault, in the order in which they are due."""
    rng = np.random.default_rng(seed)
    place, first, held = np.zeros(2), None, None
    for event in events:
        if event.kind == "info":
            place = np.asarray(event.fields["position"], dtype=np.float64)[:2]
            yield event
            continue
        if event.kind not in TRACKS:
            yield event
            continue
        first = event.time if first is None else first
        if event.time - first >= fault.stuck * SECOND and held is not None:
            event = _said_again(held, event.time)
        held = event
        if fault.loss == 0.0 or rng.random() >= fault.loss:
            yield _made_wrong(event, fault, place)


def _said_again(held: Event, time: int) -> Event:
    """What was said at another time, said again: its measurements count as new."""
    said = dict(held.fields)
    if said.get("updated") is not None:
        said["updated"] = np.asarray(said["updated"]) + (time - held.time)
    return held._replace(time=time, fields=said)


def _made_wrong(event: Event, fault: Fault, place: Floats) -> Event:
    said = dict(event.fields)
    space = tuple(said["space"])
    means, covariances = _moved(np.array(said["means"], dtype=np.float64), said["covariances"], space, fault, place)
    said |= {"means": means, "covariances": fault.sigma**2 * covariances}
    late = round(fault.clock * SECOND)
    if said.get("updated") is not None:
        said["updated"] = np.asarray(said["updated"]) + late
    due = event.time + round(fault.delay * SECOND)
    return event._replace(time=event.time + late, fields=said, due=due)


def _moved(
    means: Floats, covariances: Any, space: tuple[str, ...], fault: Fault, place: Floats
) -> tuple[Floats, Floats]:
    """Means (C, n) and covariances (C, n, n) shifted, turned and stretched in the plane."""
    spread = np.array(covariances, dtype=np.float64)
    turn = np.eye(len(space))
    angle = math.radians(fault.heading)
    for pair in (("x", "y"), ("vx", "vy"), ("ax", "ay")):
        if set(pair) <= set(space):
            at = [space.index(name) for name in pair]
            turn[np.ix_(at, at)] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    at = [space.index("x"), space.index("y")]
    means[:, at] -= place
    means, spread = means @ turn.T, turn @ spread @ turn.T
    reach = np.linalg.norm(means[:, at], axis=1, keepdims=True)
    means[:, at] *= 1.0 + fault.scale + fault.range / np.maximum(reach, 1.0)
    means[:, at] += place + np.array([fault.x, fault.y])
    return means, (spread + spread.swapaxes(1, 2)) / 2
