"""What is kept of how the tracks of two sources differ."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from fusion_service.arrays import Floats, Ints
from fusion_service.centre.supervision.scale import BINS

__all__ = ["Sums"]


@dataclass(slots=True)
class Sums:
    """Of K pairs of sources, for the two blocks, fading: histogram (K, 2, BINS) of normalised squares; weight (K, 2),
    how many; share (K, 2), sum of the first one's share in them; updates (K, 2), steps; moved, square, moves (K, 2):
    products of successive whitened differences, squares of the same, and how many; offset (K, 3), squared (K, 3): sums
    of the differences of positions and of their squares; recent (K, 2): mean square of the last few steps. key (K,): of
    the pair, sorted."""

    key: Ints
    histogram: Floats
    weight: Floats
    share: Floats
    updates: Floats
    moved: Floats
    square: Floats
    moves: Floats
    offset: Floats
    squared: Floats
    recent: Floats

    @classmethod
    def none(cls, count: int = 0) -> Sums:
        """Nothing, of so many pairs."""
        key, histogram = np.zeros(count, dtype=np.intp), np.zeros((count, 2, BINS))
        a, b, c, d, e, f, recent = np.zeros((7, count, 2))
        offset, squared = np.zeros((2, count, 3))
        return cls(key, histogram, a, b, c, d, e, f, offset, squared, recent)

    def take(self, some: Any) -> Sums:
        """Those of some pairs."""
        return Sums(*[getattr(self, one.name)[some] for one in fields(self)])

    def join(self, other: Sums) -> Sums:
        """These, then others."""
        return Sums(*[np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)])
