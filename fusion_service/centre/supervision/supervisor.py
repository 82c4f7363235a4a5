"""`Supervisor`: watches the sources beside each other, and says how each is treated in the next step.

Who repeats itself or jumps is seen in every step. What sources say of each other is looked at once in `LOOK` seconds of
data at most, with all that came in since, so that it costs the same however often a centre steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, replace
from typing import Any

import numpy as np

from fusion_service.arrays import Floats
from fusion_service.centre.intake import Intake
from fusion_service.centre.journal import Journal
from fusion_service.centre.lifecycle import Picture
from fusion_service.centre.rows import NO_TRACK, Rows
from fusion_service.centre.supervision.comparing import labels
from fusion_service.centre.supervision.conduct import Conduct
from fusion_service.centre.supervision.honesty import Honesty, Innovations, Opinion
from fusion_service.centre.supervision.registration import Registration
from fusion_service.centre.supervision.shared import Shared, shared_pairs
from fusion_service.centre.supervision.states import States, covering
from fusion_service.centre.supervision.traffic import Traffic
from fusion_service.centre.treatment import Treatment

__all__ = ["Supervisor"]

LOOK = 0.5
"""Seconds between looks at least: what a filter says ten times a second tells hardly more than what it says twice."""
PACE = 30.0
"""Looks over which the time between them is averaged."""


class Supervisor:
    """What is known of every source of a centre, and what follows from it."""

    def __init__(self, intake: Intake) -> None:
        self._intake = intake
        self._config = intake.config
        self.registration = Registration(intake)
        self.conduct = Conduct(intake)
        self.states = States(self._config.supervision == "act")
        self.traffic = Traffic()
        self._honesty = Honesty(self._config.space)
        self._opinions: dict[str, Opinion] = {}
        self._last, self._pace, self._looks = -1, 0.0, 0
        self._names: tuple[str, ...] = ()
        self._told: dict[str, dict[str, Any]] = {}
        self._frame = intake.frame

    def observe(
        self,
        rows: Rows,
        names: tuple[str, ...],
        now: Picture,
        step: int,
        time: int,
        journal: Journal,
        own: Innovations | None = None,
    ) -> None:
        """Learn from a step, its links decided and nothing fused yet, and settle how sources are treated in the next.
        now: the picture predicted to `time`, ns; own: what is known of the sources' own innovations."""
        self.conduct.observe(rows, names, time, journal)
        jumped = {name for name in names if self.conduct.jumped(name, time)}
        for name in sorted(jumped):
            self.registration.forget(name)
        judges = self._config.supervision != "off"
        if judges:
            self.traffic.heard(names, self._intake)
        if jumped or self._is_due(names, time):
            self._look(_since(rows, self._last), names, now, time, journal, own or {}, jumped)
        if judges:
            for event in self.states.settle(names, self._opinions, self._orders(), self._stuck(names), time):
                journal.event(event)
        self._treat(names)

    def _is_due(self, names: tuple[str, ...], time: int) -> bool:
        """Whether it is time for a look; there is one at once when there is another source, or another frame."""
        waits = 0 <= self._last <= time and time - self._last < LOOK * 1e9
        return not waits or names != self._names or self._frame != self._intake.frame

    def _look(
        self, rows: Rows, names: tuple[str, ...], now: Picture, time: int, journal: Journal, own: Innovations,
        jumped: set[str],
    ) -> None:  # fmt: skip
        """Compare the sources. What is fresh in the rows came in since the last look."""
        shared = shared_pairs(rows, self._looks)
        before = [self.registration.told(name) for name in names]
        self.registration.observe(rows, names, now, time, journal)
        if self._config.supervision != "off":
            self.traffic.compare(rows, names, now, self._intake, time)
            if self._frame != self._intake.frame:
                self._honesty.rebase()
            self._honesty.observe(rows, names, self._beside(rows, names, shared), self._applied(names))
            self._opinions = self._honesty.opinions(self._chance(time), own)
            for name in filter(self.registration.told_only, names):
                opinion = self._opinions.get(name, Opinion())
                self._opinions[name] = covering(opinion, self.registration.size(name))
            if changed := self._otherwise(names, before) | dict.fromkeys(jumped, np.inf):
                self._honesty.forget(changed)
        self._frame, self._names, self._last, self._told = self._intake.frame, names, time, {}
        self._looks += 1

    def _beside(self, rows: Rows, names: tuple[str, ...], shared: Shared) -> Shared:
        """The pairs that are compared: also those of targets that errors of clock and place are too large for any link
        of, where these are told only, or what is taken off does not mend it. Unsure of itself by that much, a source is
        linked and shows nothing twice."""
        same = self.registration.same()
        if not same:
            return shared
        told_only = self._config.registration == "estimate"
        wide = shared_pairs(rows, self._looks, labels(rows, same))
        tried = np.array([told_only or self.registration.told(name)[0] for name in names], dtype=np.bool_)[rows.source]
        link = rows.tracks.link
        kept = (link[wide.first] == link[wide.second]) | tried[wide.first] | tried[wide.second]
        return Shared(wide.first[kept], wide.second[kept])

    def _otherwise(self, names: tuple[str, ...], before: list[tuple[bool, bytes]]) -> dict[str, float]:
        """The sources of which other errors are taken off from now on than `before`, and how large they are."""
        now = [self.registration.told(name) for name in names]
        return {
            name: self.registration.size(name)
            for name, was, one in zip(names, before, now, strict=True)
            if was != one and (was[0] or one[0])
        }

    def _applied(self, names: tuple[str, ...]) -> Floats:
        """By what (2, S) the covariances of the sources are multiplied in this step."""
        factors = [self._intake.treatment(name).inflation for name in names]
        return np.array(factors, dtype=np.float64).reshape(len(names), 2).T

    def _chance(self, time: int) -> float:
        """Of a false alarm about a source, at one look."""
        if 0 <= self._last < time:
            seconds = (time - self._last) / 1e9
            self._pace += (seconds - self._pace) / PACE if self._pace > 0 else seconds
        return self._config.supervision_errors * (self._pace or max(self._config.period, LOOK)) / 3600.0

    def _stuck(self, names: tuple[str, ...]) -> dict[str, str]:
        """Whose tracks stand still to the bit, and the sentence that says so."""
        return {name: said for name in names if (said := self.conduct.stuck(name))}

    def _orders(self) -> dict[str, str]:
        standing = self._intake.orders.standing.values()
        return {one.order.source: one.order.state for one in standing if one.order.what == "supervise"}

    def _treat(self, names: tuple[str, ...]) -> None:
        treatments = {name: self._treatment(name) for name in names}
        self._intake.treatments = {name: one for name, one in treatments.items() if one != Treatment()}

    def _treatment(self, name: str) -> Treatment:
        state = self.states.of(name)
        factors = state.inflation if state.state in ("inflated", "out") else (1.0, 1.0)
        out, union = state.state == "out", state.state == "union"
        lasting = factors != (1.0, 1.0) and self.registration.told_only(name) and self.registration.halves(name)
        return Treatment(*self.registration.correction(name), factors, out, union, lasting)

    def health(self, name: str) -> dict[str, Any]:
        """What the status says of a source."""
        if name not in self._told:
            self._told[name] = self.registration.health(name)
        told = self._told[name] | self.conduct.health(name)
        if self._config.supervision == "off":
            return told
        state, opinion = self.states.of(name), self._opinions.get(name)
        said: dict[str, Any] = {"state": state.state, "state_why": state.why, "state_since": state.since}
        if opinion is not None and np.isfinite(opinion.consistency):
            said |= {
                "consistency": opinion.consistency,
                "consistency_low": opinion.low,
                "consistency_high": opinion.high,
                "inflation_position": max(opinion.factor[0], state.inflation[0]),
                "inflation_velocity": max(opinion.factor[1], state.inflation[1]),
            }
        return said | self.traffic.health(name, self._intake.sources[name]) | told

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns."""
        self.registration.rebase(time)
        self.conduct.rebase(time)
        self._honesty.rebase()
        self.states.rebase(time)
        self.traffic.rebase(time)
        self._last = min(self._last, time)

    def packed(self) -> dict[str, Any]:
        """As plain values."""
        packed: dict[str, Any] = {"registration": self.registration.packed(), "conduct": self.conduct.packed()}
        packed["look"] = [self._last, self._looks, list(self._names), repr(self._frame)]
        if self._config.supervision == "off":
            return packed
        pace = [self._last, self._pace, repr(self._frame)]
        return packed | {
            "opinions": {name: astuple(one) for name, one in sorted(self._opinions.items())},
            "honesty": self._honesty.packed(),
            "states": self.states.packed(),
            "pace": pace,
            "traffic": self.traffic.packed(),
        }

    def restore(self, packed: Mapping[str, Any]) -> None:
        """From what `packed` gave."""
        self.registration.restore(packed.get("registration", {}))
        self.conduct.restore(packed.get("conduct", {}))
        self._frame = self._intake.frame
        if "look" in packed:
            self._last, self._looks, names, _ = packed["look"]
            self._names = tuple(names)
        if "honesty" in packed and self._config.supervision != "off":
            self._honesty.restore(packed["honesty"])
            self.states.restore(packed["states"])
            self.traffic.restore(packed["traffic"])
            self._opinions = {str(name): _opinion(one) for name, one in packed.get("opinions", {}).items()}
            self._last, self._pace, frame = packed["pace"]
            if frame != repr(self._frame):
                self._honesty.rebase()
        self._treat(self._intake.names())


def _since(rows: Rows, last: int) -> Rows:
    """The rows, fresh where a measurement was judged in them after the step at `last`, ns."""
    new = rows.fresh | ((rows.tracks.link != NO_TRACK) & (rows.tracks.seen > last))
    return rows if np.array_equal(new, rows.fresh) else replace(rows, fresh=new)


def _opinion(packed: list[Any]) -> Opinion:
    """From what `astuple` gave, lists for tuples."""
    values: list[Any] = [tuple(one) if isinstance(one, (list, tuple)) else one for one in packed]
    return Opinion(*values)
