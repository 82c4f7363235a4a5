"""The weights of the last step, for the next one to begin with.

Covariances change little from step to step, and so do the best weights of covariance intersection. Those of the last
step are kept while their own certificate says that the criterion could be smaller by .1 % at most (`ci.KEPT`); else the
best are sought anew, from nothing, so that what comes of it does not depend on how it was come by. Any weights give a
conservative result: nothing that the rule promises depends on them.

Of each global track that three rows or more feed, by its id: who they are need not be known, for whatever numbers stand
here are tried by the certificate.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_service.arrays import Floats, from_bytes, to_bytes

__all__ = ["KeptWeights"]

Ids = NDArray[np.uint64]
FEWEST = 3
"""Of two rows the best weights are found at once."""


class KeptWeights:
    """Weights by number of rows N: ids (G,) in their order, weights (N, G)."""

    def __init__(self) -> None:
        self._last: dict[int, tuple[Ids, Floats]] = {}
        self._next: dict[int, list[tuple[Ids, Floats]]] = {}

    def of(self, ids: Ids, count: int) -> Floats | None:
        """The weights (count, B) of global tracks (B,), NaN where there are none; None where there are none at all."""
        if count not in self._last:
            return None
        known, weights = self._last[count]
        at = np.minimum(np.searchsorted(known, ids), len(known) - 1)
        return np.where(known[at] == ids, weights[:, at], np.nan)

    def note(self, ids: Ids, weights: Floats) -> None:
        """Weights (N, B) that were used in this step."""
        if len(weights) >= FEWEST and len(ids):
            self._next.setdefault(len(weights), []).append((ids, weights))

    def turn(self) -> None:
        """A step is over: what was noted in it is what there is."""
        self._last = {count: _sorted(parts) for count, parts in self._next.items()}
        self._next = {}

    def packed(self) -> list[list[Any]]:
        """As plain values."""
        return [[count, to_bytes(ids), to_bytes(weights)] for count, (ids, weights) in sorted(self._last.items())]

    def restore(self, packed: list[list[Any]]) -> None:
        """From what `packed` gave."""
        for count, ids, weights in packed:
            names = from_bytes(ids, np.zeros(0, dtype=np.uint64))
            self._last[count] = names, from_bytes(weights, np.zeros(0)).reshape(count, len(names))


def _sorted(parts: list[tuple[Ids, Floats]]) -> tuple[Ids, Floats]:
    ids = np.concatenate([one for one, _ in parts])
    order = np.argsort(ids, kind="stable")
    return ids[order], np.concatenate([weights for _, weights in parts], axis=1)[:, order]
