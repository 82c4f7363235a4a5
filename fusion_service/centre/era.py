"""A clock that is set back begins a new era of a centre: the time of its steps starts again from there.

Ids and tracks are kept. What holds later than the new era's time keeps its density and takes that time (it is never
predicted back); sequence and lateness are judged by the new time. A set-back is seen in two ways. Steps by wall
clock lie in the past, so that whatever comes in was received after the newest of them: `FEW` messages in a row that
were received long before it show that the clock went back. And who keeps the clock says so by `ClockSet`. A set-back
within `margin` is no new era: steps wait until the clock is where it was.

What was decided stands in the step log (kind "era"), and replay obeys it by `NewEra`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fusion_service.centre.sources import Source
from fusion_service.centre.tracks import Columns
from fusion_service.config import CentreConfig
from schemas import LocalIntensity, LocalTracks, SensorInfo

__all__ = ["GLOBAL_TIMES", "ClockSet", "EraWatch", "NewEra", "margin", "rebase_sources", "rebased"]

FEW = 3
"""Messages in a row that prove a set-back."""
SLACK = 5.0
"""Seconds of set-back, beyond `lateness` and two periods, that are waited for."""
TOLD = 600
"""Seconds for which a change of era stands in the status."""
LOCAL_TIMES = ("time", "updated", "used", "judged", "weighed", "seen", "told")
GLOBAL_TIMES = ("time", "updated", "seen", "born", "due", "last_hit")


@dataclass(frozen=True, slots=True)
class ClockSet:
    """The clock wants the next step at `time`, ns, which is not after the newest one."""

    time: int


@dataclass(frozen=True, slots=True)
class NewEra:
    """A new era has begun at `time`, ns, as the log of a step says that is made again."""

    time: int


def margin(config: CentreConfig) -> int:
    """How far, ns, a clock may be set back without a new era."""
    return round((config.lateness + 2 * config.period + SLACK) * 1e9)


def rebased(columns: Columns, names: tuple[str, ...], time: int) -> Columns:
    """The same with none of the columns `names` later than `time`, ns."""
    return replace(columns, **{name: np.minimum(getattr(columns, name), time) for name in names})


def rebase_sources(sources: Iterable[Source], time: int) -> None:
    """Nothing that is known of these sources is later than `time`, ns, from now on."""
    for source in sources:
        known = source.remembered
        source.tracks = rebased(source.tracks, LOCAL_TIMES, time)
        source.remembered = known._replace(time=np.minimum(known.time, time))
        source.last, source.complete = min(source.last, time), min(source.complete, time)
        source.places = tuple(one for one in source.places if one.time <= time)
        if source.vote is not None:
            source.vote = source.vote._replace(time=min(source.vote.time, time))


class EraWatch:
    """Judges from events, in the order given, whether a new era has begun. number: of changes so far."""

    def __init__(self, config: CentreConfig) -> None:
        self._wall = config.clock == "wall"
        self._period = round(config.period * 1e9)
        self._behind_now = round((config.period + config.delay) * 1e9)
        self._margin = margin(config)
        self._patience = round((config.lateness + 3 * config.period) * 1e9)
        self._suspects = 0
        self._asked = (-1, -1)
        self.number = 0
        self._last = (-1, -1)

    def judge(self, event: object, received: int, time: int) -> int | None:
        """The time of the era that `event`, received at `received`, begins, ns, or None. time: of the newest step."""
        if time < 0:
            return None
        if isinstance(event, NewEra):
            return event.time if 0 <= event.time < time else None
        if isinstance(event, ClockSet):
            return self._clock(event.time, time)
        if not self._wall or received <= 0 or not isinstance(event, (LocalTracks, LocalIntensity, SensorInfo)):
            return None
        self._suspects = self._suspects + 1 if received < time - self._margin else 0
        return max(0, received - self._behind_now) if self._suspects >= FEW else None

    def _clock(self, due: int, time: int) -> int | None:
        """A wall clock is believed at once. The messages' own time has to go on for a while, since the first to
        speak to a service that begins again may be the one whose clock is wrong."""
        if due >= time - self._margin or due < self._period:
            return None
        if not self._wall:
            self._asked = self._asked if self._asked[0] == time else (time, due)
            if due < self._asked[1] + self._patience:
                return None
        return due - self._period

    def begin(self, time: int, before: int) -> dict[str, Any]:
        """The era begins: its event for the log. before: time of the newest step so far."""
        self.number += 1
        self._suspects, self._asked, self._last = 0, (-1, -1), (time, before)
        return {"kind": "era", "number": self.number, "time": time, "before": before}

    def notes(self, time: int) -> tuple[str, ...] | None:
        """What the status says at a step, at `time`, ns."""
        begun, before = self._last
        if not self.number or time > begun + TOLD * 10**9:
            return None
        seconds = (before - begun) / 1e9
        return (f"the clock was set back by about {seconds:.0f} s: era {self.number} began, ids and tracks are kept",)

    def pack(self) -> list[int]:
        """For a checkpoint."""
        return [self.number, *self._last, self._suspects, *self._asked]

    def unpack(self, packed: list[int]) -> None:
        """Go on with what `pack` gave."""
        self.number, begun, before, self._suspects, when, asked = packed
        self._last, self._asked = (begun, before), (when, asked)
