"""What came of one source, or of one centre's pictures: how much, how often, and what is missing.

A sequence number of an epoch that is missing between the first and the last is a gap; a source that says nothing for
more than `SILENT` of its periods (declared, else the median interval) is silent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_service.review.snapshots import Times

__all__ = ["Silence", "Traffic"]

SILENT = 3.0
MOST = 50
"""Silent spans of a source that are kept, the longest."""


class Silence(NamedTuple):
    """A span in which a source said nothing, ns."""

    begin: int
    end: int


@dataclass(slots=True, eq=False)
class Traffic:
    """What came of one source, or of one centre's pictures: tracks and messages, the time of the first and the last,
    ns, and the median interval, s; sequence numbers missed; silent spans, the longest first, and their number."""

    messages: int = 0
    tracks: int = 0
    first: int = 0
    last: int = 0
    interval: float = 0.0
    epochs: int = 0
    missing: int = 0
    silent: int = 0
    silences: tuple[Silence, ...] = ()

    def count(self, time: Times, epoch: NDArray[np.uint64], seq: NDArray[np.uint64], period: float | None) -> None:
        """Take the numbers of all N messages: time (N,) ns, epoch (N,), seq (N,); period: declared, s."""
        times = np.unique(time)
        steps = np.diff(times)
        self.messages, self.first, self.last = len(time), int(times[0]), int(times[-1])
        self.interval = float(np.median(steps)) / 1e9 if len(steps) else 0.0
        for run in np.unique(epoch):
            numbers = np.unique(seq[epoch == run])
            self.missing += int(numbers[-1]) - int(numbers[0]) + 1 - len(numbers)
            self.epochs += 1
        wide = np.flatnonzero(steps > SILENT * 1e9 * (period or self.interval)) if len(steps) else steps
        self.silent = len(wide)
        longest = wide[np.argsort(-steps[wide], kind="stable")][:MOST]
        self.silences = tuple(Silence(int(times[at]), int(times[at + 1])) for at in longest.tolist())
