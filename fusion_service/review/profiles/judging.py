"""Whether a mission keeps to a profile: requirement by requirement, and target by target.

passed      the number found keeps to the number asked, and where that is a share or a rate, so does its one-sided
            confidence bound (`confidence`)
failed      the number found does not
not shown   it does, but on so few samples that a worse one is not excluded; or there is no sample at all
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from fusion_service.review.profiles import confidence as sure
from fusion_service.review.profiles.areas import rest_inside, targets_inside
from fusion_service.review.profiles.counting import COUNTING, Counted, Scene
from fusion_service.review.profiles.observing import Observed
from fusion_service.review.profiles.profile import EVERYWHERE, Profile, Requirement

__all__ = ["FAILED", "NOT_SHOWN", "PASSED", "Judged", "Verdict", "judge", "worst"]

PASSED, FAILED, NOT_SHOWN = "passed", "failed", "not shown"


@dataclass(frozen=True, slots=True)
class Verdict:
    """found: NaN without samples; bound: of a share or rate at the confidence asked, NaN where there is none."""

    verdict: str
    found: float
    samples: float
    bound: float
    words: str


@dataclass(frozen=True, slots=True)
class Judged:
    """A requirement, of one centre: its verdict, and that of each target that gave a sample."""

    requirement: Requirement
    whole: Verdict
    targets: dict[int, Verdict]

    @property
    def verdict(self) -> str:
        """With `each_target` the worst of all."""
        said = [self.whole.verdict]
        if self.requirement.each_target:
            said += [one.verdict for one in self.targets.values()]
        return next((one for one in (FAILED, NOT_SHOWN) if one in said), PASSED)

    def as_json(self) -> dict[str, Any]:
        """Plain values, None for what does not exist."""
        one = self.requirement
        return {
            "kind": one.kind,
            "name": one.name,
            "area": one.area,
            "numbers": {key: value for key, value in one.numbers.items() if value is not None},
            "source": one.source,
            "unverified": one.unverified,
            "confidence": one.confidence,
            "each_target": one.each_target,
            "verdict": self.verdict,
            "whole": _plain(self.whole),
            "targets": {str(target): _plain(found) for target, found in self.targets.items()},
        }


def judge(profile: Profile, seen: Observed, names: Mapping[int, str] = MappingProxyType({})) -> list[Judged]:
    """All requirements of a profile, in its order; names: of targets that have some. ReviewError for an area that has
    no meaning in this mission."""
    called = {one: profile.identities.get(one, profile.identities.get(names.get(one, ""))) for one in seen.targets}
    identities = {one: identity for one, identity in called.items() if identity}
    areas = {area.name: area for area in profile.areas}
    scenes: dict[str, Scene] = {}
    found = []
    for one in profile.requirements:
        if one.area not in scenes:
            area = areas.get(one.area) if one.area != EVERYWHERE else None
            scenes[one.area] = Scene(
                seen,
                targets_inside(area, seen),
                rest_inside(area, seen, seen.rest.place),
                rest_inside(area, seen, seen.pairs.place),
                identities,
            )
        counted = COUNTING[one.kind](scenes[one.area], one.numbers)
        whole = _verdict(one, counted, float(counted.sums.sum()), float(counted.samples.sum()))
        targets = {}
        if counted.by_target:
            for target, value, samples in zip(seen.targets, counted.sums, counted.samples, strict=True):
                if samples > 0:
                    targets[target] = _verdict(one, counted, float(value), float(samples))
        found.append(Judged(one, whole, targets))
    return found


def _verdict(one: Requirement, counted: Counted, value: float, samples: float) -> Verdict:
    if not samples > 0:
        why = counted.why or "there was no sample"
        return Verdict(NOT_SHOWN, math.nan, 0.0, math.nan, why)
    if counted.what == "rms":
        root = math.sqrt(value / samples)
        most = next(one.numbers[key] for key in ("rms_max_m", "rms_max_m_per_s") if one.numbers.get(key) is not None)
        return Verdict(PASSED if root <= most else FAILED, root, samples, math.nan, "")
    if counted.what == "rate":
        return _rate(one, value, samples)
    return _share(one, round(value), round(samples))


def _rate(one: Requirement, events: float, hours: float) -> Verdict:
    most = float(one.numbers["per_target_hour_max"])
    bound = sure.upper_count(round(events), one.confidence) / hours
    found = events / hours
    level = f"at {100 * one.confidence:g} % confidence"
    words = f"{level} at most {bound:.3g} an hour, by {events:g} in {hours:.3g} target hours"
    verdict = FAILED if found > most else PASSED if bound <= most or one.confidence == 0 else NOT_SHOWN
    return Verdict(verdict, found, hours, bound, words)


def _share(one: Requirement, good: int, samples: int) -> Verdict:
    found, level = good / samples, f"at {100 * one.confidence:g} % confidence"
    least, most = one.numbers.get("share_min"), one.numbers.get("share_max")
    if least is not None:
        bound = sure.lower(good, samples, one.confidence)
        kept, shown, asked, side = found >= least, bound >= least, 1.0 - least, "at least"
    else:
        assert most is not None
        bound = sure.upper(good, samples, one.confidence)
        kept, shown, asked, side = found <= most, bound <= most, most, "at most"
    words = f"{level} {side} {100 * bound:.4g} %"
    if kept and not shown:
        wanted = sure.needed(asked, one.confidence) if one.confidence else 0.0
        if math.isinf(wanted):
            words += "; no number of samples shows this rate"
        elif samples < wanted:
            words += f"; {math.ceil(wanted):,} samples without one would show it"
    verdict = FAILED if not kept else PASSED if shown or one.confidence == 0 else NOT_SHOWN
    return Verdict(verdict, found, samples, bound, words)


def _plain(one: Verdict) -> dict[str, Any]:
    numbers = {"found": one.found, "samples": one.samples, "bound": one.bound}
    return {
        "verdict": one.verdict,
        **{key: value if np.isfinite(value) else None for key, value in numbers.items()},
        "words": one.words,
    }


def worst(judged: Sequence[Judged]) -> str:
    """Of all."""
    said = [one.verdict for one in judged]
    return next((one for one in (FAILED, NOT_SHOWN) if one in said), PASSED)
