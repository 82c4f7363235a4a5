"""`Place`: where a sensor was, as a message of its tracks says, and the few of them that tell how it moves."""

from __future__ import annotations

from typing import NamedTuple

from schemas import Frame, Platform

__all__ = ["Place", "before", "followed"]

APART = 500_000_000
"""ns between places from which a velocity is made: one of neighbours would be that of their errors."""


class Place(NamedTuple):
    """Where a sensor was at `time`, ns: its platform, in `frame`."""

    time: int
    frame: Frame
    platform: Platform


def followed(places: tuple[Place, ...], new: Place) -> tuple[Place, ...]:
    """The places to remember, in the order of time, the newest last, with one more; an older one changes nothing."""
    if places and new.time <= places[-1].time:
        return places
    if len(places) > 1 and places[-1].time - places[-2].time < APART:
        places = places[:-1]
    return (*places[-2:], new)


def before(places: tuple[Place, ...]) -> Place | None:
    """The newest of them that is `APART` before the last; None if none is."""
    return next((one for one in reversed(places) if places[-1].time - one.time >= APART), None)
