"""Whether missions may be ranked against each other: only where they are of the same truth, over the same time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fusion_service.labels import utc
from fusion_service.review.evaluation.gathering import Evaluation
from fusion_service.review.snapshots import truth_positions

__all__ = ["Comparison", "compared"]

APART = 0.01
"""Of the cut-off: true places that are as near are the same; a lost message of truth does as much."""
SHARE = 0.05
"""Of the longer one: a scored time that begins or ends so much apart is another."""
MOST_NAMED = 5
GAP = 5.0


class Comparison(NamedTuple):
    """Whether rows may be ranked: against, why not, in words, empty if they may; but: what is to be known of it, if
    they may, empty if nothing."""

    against: str
    but: str

    @property
    def ranked(self) -> bool:
        return not self.against


def compared(names: Sequence[str], evaluations: Sequence[Evaluation], inputs: Sequence[int]) -> Comparison:
    """Of the rows `names` of several recordings, with what they are scored by. inputs: a digest of what the sources of
    each sent."""
    reasons: list[str] = []
    for name, one in zip(names[1:], evaluations[1:], strict=True):
        if why := _other(evaluations[0], one):
            reasons.append(f"{names[0]} and {name}: {why}")
    if reasons:
        more = f"; {len(reasons) - 1} more" if len(reasons) > 1 else ""
        return Comparison(f"Not ranked, for the truth is not the same ({reasons[0]}{more}): read each by itself.", "")
    if len(set(inputs)) > 1:
        what = "The truth is the same, but not what the sources sent (other runs, or losses)"
        return Comparison("", f"{what}: small differences are chance.")
    return Comparison("", "")


def _other(one: Evaluation, two: Evaluation) -> str:
    """How the truth of two differs; empty where it does not."""
    mine, theirs = set(one.targets), set(two.targets)
    if mine != theirs:
        alone = sorted(mine ^ theirs)
        more = f" and {len(alone) - MOST_NAMED} more" if len(alone) > MOST_NAMED else ""
        return f"other targets, {', '.join(map(str, alone[:MOST_NAMED]))}{more} in one alone"
    begin, end = max(int(one.times[0]), int(two.times[0])), min(int(one.times[-1]), int(two.times[-1]))
    longest = max(int(some.times[-1] - some.times[0]) for some in (one, two))
    if end - begin < (1 - SHARE) * longest:
        return f"other time, {_span(one)} and {_span(two)}"
    if one.frame != two.frame:
        return ""
    k = np.flatnonzero((two.times >= begin) & (two.times <= end))
    order = [two.targets.index(target) for target in one.targets]
    places = two.places[k][:, order]
    for t, target in enumerate(one.targets):
        known = np.flatnonzero(np.isfinite(one.places[:, t, 0]))
        if not len(known):
            continue
        there = truth_positions(one.times[known], one.places[known, t], two.times[k], GAP)
        same = np.isin(two.times[k], one.times[known])
        d = min(there.shape[1], places.shape[2])
        apart = np.abs(there[same, :d] - places[same, t, :d]).max(initial=0.0, where=np.isfinite(places[same, t, :d]))
        if apart > APART * one.c:
            return f"target {target} is elsewhere, by {apart:.3g} m"
    return ""


def _span(one: Evaluation) -> str:
    return f"{utc(int(one.times[0]))} to {utc(int(one.times[-1]))}"
