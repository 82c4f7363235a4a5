"""Whose local tracks are taken as tracklets, and whether their increments are what their sources say.

What a source declares decides first (`reasons`). Then its own innovations are watched: the normalised squares of those
of all its tracks, summed over some thousands, are compared with their expectation. A source whose sum is beyond its
bounds, and by more than matters, claims measurements better than they are, or a motion that is not that of its
tracker: up to `WORST` times too large, its increments are divided by as much; beyond, or too small, its tracks go by
the rule until the sum is within the bounds again.

The increments are watched beside the filters that take them, too: there they can be too large because of others, or of
the motion, but too small only if they are not measurements of their own. That shows a tracker that is fed with fused
tracks and does not say so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import numpy as np

from fusion_service.arrays import Bools, Floats, Ints
from fusion_service.centre.increments import Increments
from fusion_service.centre.intake import Intake
from fusion_service.centre.partial import AXES, PLACED
from fusion_service.centre.sources import Source
from fusion_service.centre.standing import heading_sigma_of
from fusion_service.centre.stated_registration import shift_of
from schemas import Motion

__all__ = ["INNOVATIONS", "UNTRUE", "WATCHED", "Record", "Watch", "reason_of"]

INNOVATIONS, DEPENDENT = "innovations", "dependent"
WATCHED = ("", INNOVATIONS, DEPENDENT, "increments", "registration", "covariance_floor")
"""Reasons, of those whose increments are what the tracker has measured all the same."""
UNTRUE = (INNOVATIONS, DEPENDENT, "feedback", "motion")
"""Reasons for which nothing is to be concluded from successive covariances either."""
REMEMBERED = 2000.0
"""Degrees of freedom that a sum holds about; older ones fade."""
FEW = 20
"""Versions before their soundness is judged."""
SIGMAS = 4.0
"""Of a sum's own spread, beyond which it is not by chance. It is looked at in every step: of honest sources with one
track 1 in 500 is found beyond once in an hour of steps."""
MATTERS = 0.15
"""Deviation from 1 that is left alone though it is no chance: trackers of real sensors are never exact."""
WORST = 2.0
LEAST = 0.6
FADING = 0.999
"""Of what was seen of a source that is left out as dependent, kept per step: it is tried again."""


@dataclass(slots=True)
class Record:
    """Of one source, fading: sum and freedom of its innovations, versions, and how many of them were sound and how many
    taken as tracklets; beside, beside_freedom: of its increments beside the filters of the targets. reason: why its
    tracks are not taken as tracklets, or ""."""

    sum: float = 0.0
    freedom: float = 0.0
    versions: float = 0.0
    sound: float = 0.0
    taken: float = 0.0
    beside: float = 0.0
    beside_freedom: float = 0.0
    reason: str = ""

    @property
    def ratio(self) -> float:
        """Mean normalised square of an innovation: 1 if the source is what it says; NaN where none is known."""
        return self.sum / self.freedom if self.freedom > 0 else math.nan

    @property
    def bounds(self) -> tuple[float, float]:
        """What the ratio lies within by chance (Wilson, Hilferty 1931: the cube root of a mean of squares is nearly
        Gaussian), or without mattering."""
        return _bounds(self.freedom)

    @property
    def inflation(self) -> float:
        """What its increments are to be divided by."""
        if not self.freedom > 0:
            return 1.0
        return self.ratio if self.ratio > self.bounds[1] else 1.0

    @property
    def fails(self) -> bool:
        """Whether its increments are not to be taken at all."""
        if not self.freedom > 0:
            return False
        low, high = self.bounds
        return self.ratio > max(high, WORST) or self.ratio < min(low, LEAST)

    @property
    def dependent(self) -> bool:
        """Whether its increments agree with the filters better than measurements of its own can."""
        spread = SIGMAS * math.sqrt(2.0 / max(self.beside_freedom, 1e-9))
        return self.beside < min(1.0 - spread, LEAST) * self.beside_freedom

    @property
    def unsound(self) -> bool:
        """Whether most of its increments are no measurements."""
        return self.versions >= FEW and self.sound < 0.5 * self.versions

    def add(self, innovation: float, freedom: float, versions: int, sound: int, taken: int) -> None:
        """Count one step."""
        kept = min(1.0, REMEMBERED / (self.freedom + freedom)) if freedom > 0 else 1.0
        self.sum, self.freedom = kept * (self.sum + innovation), kept * (self.freedom + freedom)
        kept = min(1.0, REMEMBERED / (self.versions + versions)) if versions > 0 else 1.0
        self.versions, self.taken = kept * (self.versions + versions), kept * (self.taken + taken)
        self.sound = kept * (self.sound + sound)


@lru_cache(maxsize=4096)
def _bounds(freedom: float) -> tuple[float, float]:
    part = 2.0 / (9.0 * max(freedom, 1.0))
    low, high = ((max(1.0 - part + side * SIGMAS * math.sqrt(part), 0.0)) ** 3 for side in (-1, 1))
    return min(low, 1.0 - MATTERS), max(high, 1.0 + MATTERS)


class Watch:
    """The records of all sources, by name."""

    def __init__(self) -> None:
        self.records: dict[str, Record] = {}

    def begin(self, intake: Intake, names: tuple[str, ...]) -> list[dict[str, Any]]:
        """Judge who is capable in a step, by what is declared and by the record; what has changed, as events."""
        self.records = {name: self.records.get(name, Record()) for name in names}
        changed = []
        for name, record in self.records.items():
            reason = reason_of(intake, intake.sources[name])
            if reason in WATCHED and record.fails:
                reason = INNOVATIONS
            elif not reason and record.unsound:
                reason = "increments"
            elif not reason and record.dependent:
                reason = DEPENDENT
            if reason == DEPENDENT:
                record.beside, record.beside_freedom = FADING * record.beside, FADING * record.beside_freedom
            if reason != record.reason and (reason or record.versions):
                changed.append({"kind": "tracklets", "source": name, "why": reason, "ratio": round(record.ratio, 4)})
            record.reason = reason
        return changed

    def add(self, names: tuple[str, ...], source: Ints, found: Increments, taken: Bools) -> None:
        """Count the versions of a step; source (K,): index into names; taken (K,): as tracklets."""
        for at in np.unique(source).tolist():
            mine = source == at
            innovation, freedom = (math.fsum(part[mine].tolist()) for part in (found.innovation, found.freedom))
            counts = (int(part[mine].sum()) for part in (mine, found.sound, taken))
            self.records[names[at]].add(innovation, freedom, *counts)

    def add_beside(self, names: tuple[str, ...], source: Ints, beside: Floats) -> None:
        """Count the innovations (2, K) of increments beside the filters that took them, and their expectations."""
        for at in np.unique(source).tolist():
            found, expected = (math.fsum(part[source == at].tolist()) for part in beside)
            record = self.records[names[at]]
            kept = min(1.0, REMEMBERED / (record.beside_freedom + expected)) if expected > 0 else 1.0
            record.beside = kept * (record.beside + found)
            record.beside_freedom = kept * (record.beside_freedom + expected)

    def health(self, name: str) -> dict[str, Any]:
        """What the status says of a source."""
        record = self.records.get(name)
        if record is None or (not record.versions and not record.reason):
            return {}
        low, high = record.bounds
        said = {"tracklets": record.taken / record.versions if record.versions else 0.0, "no_tracklets": record.reason}
        if record.freedom > 0:
            said |= {"innovation": record.ratio, "innovation_low": low, "innovation_high": high}
        return said

    def packed(self) -> dict[str, list[Any]]:
        """As plain values."""
        return {
            name: [getattr(one, field.name) for field in fields(Record)] for name, one in sorted(self.records.items())
        }

    def restore(self, packed: dict[str, list[Any]]) -> None:
        """From what `packed` gave."""
        self.records = {str(name): Record(*values) for name, values in packed.items()}


def reason_of(intake: Intake, source: Source) -> str:
    """Why tracks of a source are not taken as tracklets by what is declared of it; "" where they may be."""
    said = intake.declared(source)
    if intake.motion_said(source) is None:
        return "motion"
    if said.feedback:
        return "feedback"
    if said.covariance_floor > 0.0:
        return "covariance_floor"
    correction = intake.treatment(source.name).correction
    stated = shift_of(intake, source) is not None or bool(heading_sigma_of(source))
    if stated if correction is None else correction.loose:
        return "registration"
    if not set(source.space) <= set(intake.config.space) or _goes_unseen(source, intake.config.space, said.motion):
        return "space"
    return ""


def _goes_unseen(source: Source, space: tuple[str, ...], motion: Motion) -> bool:
    """Whether it tells places whose velocity it does not know: how these move is no tracker's prediction."""
    there = source.space
    unseen = any(place in there and speed in space and speed not in there for place, speed in AXES)
    return unseen and motion.kind not in PLACED
