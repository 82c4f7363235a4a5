"""How far sources are trusted, and what follows: the ladder trusted, watch, inflated, union, out.

trusted   as it is.
watch     told, and nothing done: a deviation below `TREATED`, or one that cannot be pinned on one of two sources.
inflated  its variances are multiplied by the factors found, for positions and for the rest.
union     it contradicts another source and it cannot be told which of them is right: where both have a target, their
          tracks are fused by covariance union, which is conservative if one of them is.
out       it cannot be made right by `MOST`, or is stuck as a whole: watched, linked, and not fused.

A source goes up as soon as a bound is passed, and down when its factor has been below `OVER` for `CALM` seconds; the
factors that are applied follow the estimate when they are off by more than `STEP`. An
operator's order settles the state instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from fusion_service.centre.supervision.honesty import BLOCKS, Opinion
from fusion_service.order import STATES

__all__ = ["State", "States", "covering", "reason"]

TREATED = 1.5
"""Factor on variances from which a source is treated."""
MOST = 1e4
"""Factor on variances beyond which it is not made right."""
FARTHEST = 1e8
"""Factor up to which tracks that are not fused are still looked for beside others."""
OVER = 1.2
CALM = 10.0
STEP = 1.25
NONE = Opinion()
NAMED = 4
"""Other sources that a reason names."""


@dataclass(frozen=True, slots=True)
class State:
    """Of one source: state, why, since (ns); inflation applied; calm: since when nothing was wrong with it, ns or -1;
    ordered: whether an operator has said so."""

    state: str = "trusted"
    why: str = ""
    since: int = -1
    inflation: tuple[float, float] = (1.0, 1.0)
    calm: int = -1
    ordered: bool = False


@dataclass(slots=True)
class States:
    """The states of all sources, by name."""

    acts: bool = True
    by_name: dict[str, State] = field(default_factory=dict)

    def settle(
        self,
        names: tuple[str, ...],
        opinions: Mapping[str, Opinion],
        orders: Mapping[str, str],
        conduct: Mapping[str, str],
        time: int,
    ) -> list[dict[str, Any]]:
        """Go on to the step at `time`, ns; orders: states that are ordered; conduct: why a source is to be out for what
        it does. What has changed, as events."""
        changed = []
        kept = {}
        for name in names:
            was = self.by_name.get(name, State(since=time))
            opinion = opinions.get(name, NONE)
            if was == State(since=was.since) and not any(opinion.wrong) and name not in conduct and name not in orders:
                kept[name] = was
                continue
            now = self._next(was, opinion, time)
            if name in conduct and self.acts:
                now = replace(now, state="out", why=conduct[name])
            now = _ordered(now, orders[name], opinion) if name in orders else replace(now, ordered=False)
            if now.state != was.state:
                now = replace(now, since=time)
                changed.append(_event(name, was, now, opinion))
            kept[name] = now
        self.by_name = kept
        return changed

    def _next(self, was: State, opinion: Opinion, time: int) -> State:
        wanted = self._wanted(opinion)
        if was.ordered:
            was = replace(was, state="trusted")
        if STATES.index(wanted) >= STATES.index(was.state) and wanted != "trusted":
            inflation = _followed(was.inflation, opinion, was.state in ("inflated", "out"))
            return replace(was, state=wanted, why=reason(opinion), inflation=inflation, calm=-1)
        if was.state == "trusted":
            return replace(was, why="", inflation=(1.0, 1.0), calm=-1)
        if wanted == "trusted" and was.state in ("inflated", "out") and max(opinion.estimate) > OVER:
            return replace(was, inflation=_followed(was.inflation, opinion, True), calm=-1)
        calm = was.calm if 0 <= was.calm <= time else time
        if time - calm < CALM * 1e9:
            return replace(was, calm=calm)
        inflation = _followed((1.0, 1.0), opinion, False) if wanted == "inflated" else (1.0, 1.0)
        return replace(
            was, state=wanted, why=reason(opinion) if wanted != "trusted" else "", inflation=inflation, calm=-1
        )

    def _wanted(self, opinion: Opinion) -> str:
        if not any(opinion.wrong):
            return "trusted"
        if not self.acts:
            return "watch"
        if not opinion.decided:
            return "union" if opinion.contradiction > TREATED else "watch"
        worst = max(opinion.factor)
        return "out" if worst > MOST else "inflated" if worst > TREATED else "watch"

    def of(self, name: str) -> State:
        """The state of a source."""
        return self.by_name.get(name, State())

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns: nothing that is known is later."""
        self.by_name = {
            name: replace(one, since=min(one.since, time), calm=min(one.calm, time))
            for name, one in self.by_name.items()
        }

    def packed(self) -> dict[str, list[Any]]:
        """As plain values."""
        plain = {}
        for name, one in sorted(self.by_name.items()):
            plain[name] = [one.state, one.why, one.since, list(one.inflation), one.calm, one.ordered]
        return plain

    def restore(self, packed: Mapping[str, list[Any]]) -> None:
        """From what `packed` gave."""
        self.by_name = {
            str(name): State(state, why, since, (inflation[0], inflation[1]), calm, ordered)
            for name, (state, why, since, inflation, calm, ordered) in packed.items()
        }


def _ordered(now: State, state: str, opinion: Opinion) -> State:
    inflation = _followed(now.inflation, replace(opinion, wrong=(True, True)), True)
    inflation = inflation if state in ("inflated", "out") else (1.0, 1.0)
    return replace(now, state=state, why="ordered by an operator", inflation=inflation, calm=-1, ordered=True)


def _followed(applied: tuple[float, float], opinion: Opinion, goes_on: bool) -> tuple[float, float]:
    """The factors to be applied, where `applied` were."""
    if not opinion.decided:
        return 1.0, 1.0
    new, either = [], any(opinion.wrong)  # what is wrong in one is seldom right in the other, if less surely so
    for old, value in zip(applied, opinion.estimate, strict=True):
        found = max(value, 1.0) if either or (goes_on and old > 1.0) else 1.0
        found = min(found, FARTHEST)
        new.append(old if goes_on and old / STEP < found < old * STEP else found)
    return new[0], new[1]


def _event(name: str, was: State, now: State, opinion: Opinion) -> dict[str, Any]:
    event: dict[str, Any] = {
        "kind": "supervision",
        "source": name,
        "state": now.state,
        "was": was.state,
        "why": now.why,
    }
    if opinion.compared:
        event |= {"inflation": [round(x, 4) for x in now.inflation], "compared": round(opinion.compared)}
    return event


def covering(opinion: Opinion, size: float) -> Opinion:
    """The same, of a source whose error of clock or place is told and not taken off: `size`, mean square of it beside
    what it says. What it is certain to be wrong by is in its covariance then, unless others do not show it any more."""
    factor = 1.0 + size
    if not opinion.consistency > OVER or factor < max(TREATED, opinion.factor[0] if opinion.decided else 1.0):
        return opinion
    return replace(
        opinion,
        estimate=(factor, opinion.estimate[1]),
        factor=(factor, opinion.factor[1]),
        wrong=(True, opinion.wrong[1] and opinion.decided),
        decided=True,
        covers=True,
    )


def reason(opinion: Opinion) -> str:
    """A sentence with its numbers."""
    left = len(opinion.beside) - NAMED
    others = ", ".join(opinion.beside[:NAMED]) + (f" and {left} more" if left > 0 else "")
    count = f"over {opinion.compared:.0f} comparisons"
    if opinion.covers:
        return (
            f"errors of its clock or place, told and not taken off, are {opinion.factor[0] - 1.0:.3g} times (variance) "
            "what its positions are uncertain by themselves: see its bias"
        )
    if opinion.decided:
        values = zip(BLOCKS, opinion.wrong, opinion.factor, strict=True)
        parts = [f"{what} scatter {value:.3g}" for what, wrong, value in values if wrong]
        said = f"its {' and its '.join(parts)} times (variance) what it says, beside {others}, {count}"
    else:
        said = (
            f"its tracks differ from those of {others} by {opinion.contradiction:.3g} times (squared) what both say, "
            f"{count}: which of them is wrong cannot be told"
        )
    if opinion.constant and opinion.wrong[0]:
        said += f"; most of it is constant, {opinion.constant:.3g} m: see its bias"
    return said
