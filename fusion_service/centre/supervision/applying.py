"""Whether the error of a source is certain and matters, and is taken off its tracks.

All its errors are tested together: theta' Sigma^-1 theta against a chi-square of as many degrees, at an error rate that
`supervision_errors` follows from; and it has to matter beside what its tracks are uncertain by themselves. It is found
after some steps in a row, and no more when it falls below a much lower bound.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from fusion_service.arrays import Floats, from_bytes, to_bytes
from fusion_service.centre.supervision.bias import PARAMETERS
from fusion_service.centre.supervision.telling import Told
from fusion_service.metrics import chi2_quantile

__all__ = ["Applied", "decide"]

P = len(PARAMETERS)
LOOK = 36.0
"""Seconds between looks that are about independent."""
IN_A_ROW = 3
MATTERS, HARDLY = 0.04, 0.01
"""Mean squares of the error beside those of the tracks, to be found and to be kept."""
LOOSE = 0.1
"""Mean square of what stays uncertain beside those of the tracks, beyond which it is not neglected."""
NOTHING = 0.99
"""Of what is supposed beforehand: an error that is known no better is not taken off, and nothing is added for it."""
MOVED = 25.0
"""Square of a change in its own sigmas that is told."""


@dataclass(frozen=True, slots=True, eq=False)
class Applied:
    """found: the error of a source is certain and matters; on: it is taken off, value (7,) with covariance (7, 7).
    loose: too much of it stays uncertain to be neglected. looks: steps in a row that found it. told (7,), sigma (7,):
    what the last event said."""

    found: bool = False
    on: bool = False
    loose: bool = False
    looks: int = 0
    value: Floats = field(default_factory=lambda: np.zeros(P))
    covariance: Floats = field(default_factory=lambda: np.zeros((P, P)))
    told: Floats = field(default_factory=lambda: np.zeros(P))
    sigma: Floats = field(default_factory=lambda: np.zeros(P))

    def packed(self) -> list[object]:
        """As plain values."""
        return [
            self.found, self.on, self.loose, self.looks,
            *(to_bytes(one) for one in (self.value, self.covariance, self.told, self.sigma)),
        ]  # fmt: skip

    @classmethod
    def unpacked(cls, packed: list[Any]) -> Applied:
        """From what `packed` gave."""
        found, on, loose, looks, *parts = packed
        like = np.zeros(0)
        value, covariance, told, sigma = (from_bytes(one, like) for one in parts)
        return cls(bool(found), bool(on), bool(loose), int(looks), value, covariance.reshape(P, P), told, sigma)


def decide(before: Applied, told: Told, effect: Floats, errors: float, corrects: bool) -> tuple[Applied, bool]:
    """What holds of a source from now on, and whether that is to be told. effect (2,): mean squares of its error, and
    of what stays of that, beside those of its tracks; errors: false ones per hour that are allowed."""
    some = np.flatnonzero(told.sigma > 0)
    square, size = 0.0, len(some)
    if size and told.shares:
        scale = told.sigma[some]
        inner = told.covariance[np.ix_(some, some)] / np.outer(scale, scale)
        x = told.mean[some] / scale
        square = float(x @ np.linalg.solve(inner + 1e-12 * np.eye(size), x))
    sure, fair = 1.0 - min(errors * LOOK / 3600.0, 0.1), 0.5
    passes = size > 0 and square > _quantile(sure, size) and bool(effect[0] > MATTERS)
    looks = before.looks + 1 if passes else 0
    holds = size > 0 and square > _quantile(fair, size) and bool(effect[0] > HARDLY)
    found = (before.found and holds) or looks >= IN_A_ROW
    on = found and corrects
    loose = bool(effect[1] > (LOOSE / 2 if before.loose else LOOSE))
    known = (told.spread < NOTHING * told.sigma) & on
    value, covariance = np.where(known, told.mean, 0.0), np.where(np.outer(known, known), told.covariance, 0.0)
    after = replace(before, found=found, on=on, loose=loose, looks=looks, value=value, covariance=covariance)
    sigma = np.where(before.sigma > 0, before.sigma, np.inf)
    moved = found and bool((((told.mean - before.told) / sigma) ** 2 > MOVED).any())
    if found == before.found and on == before.on and not moved:
        return after, False
    return replace(after, told=told.mean.copy(), sigma=told.spread), True


@lru_cache(maxsize=64)
def _quantile(probability: float, size: int) -> float:
    return float(chi2_quantile(probability, size))
