"""Global ids: (generation, counter), 32 bits each in one u64; an id is given once and never again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["Ids"]


class Ids:
    """The ids that are given from now on, in order. next: the first of them."""

    def __init__(self) -> None:
        self.next = 1

    def begin(self, generation: int) -> None:
        """Go on with the ids of a generation that was never used."""
        self.next = (generation << 32) + 1

    def allot(self, count: int) -> NDArray[np.uint64]:
        """So many new ids."""
        first, self.next = self.next, self.next + count
        return np.arange(first, self.next, dtype=np.uint64)
