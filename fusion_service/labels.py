"""How a recording writes ids and times: the short names of global ids, 7 or 2.7, and UTC to the second."""

from __future__ import annotations

import re
from datetime import UTC, datetime

from schemas import GlobalTracks

__all__ = ["Labels", "utc"]

COUNTERS = 1 << 32
MAX_GENERATIONS = 1000
"""Runs of services that are numbered; those beyond are called by their generation."""


def utc(time: int, between: str = " ") -> str:
    """`time`, ns UTC, as ISO 8601 to the second, with `between` date and time."""
    return datetime.fromtimestamp(time // 10**9, UTC).strftime(f"%Y-%m-%d{between}%H:%M:%SZ")


class Labels:
    """Names a global id by its lower half, a counter; from the second generation (upper half) seen on, after the
    number of its generation: 7, 2.7."""

    def __init__(self) -> None:
        self._generations: dict[int, int] = {}

    def __call__(self, track: int) -> str:
        generation, counter = divmod(int(track), COUNTERS)
        if generation not in self._generations and len(self._generations) >= MAX_GENERATIONS:
            return f"{generation}.{counter}"
        number = self._generations.setdefault(generation, len(self._generations) + 1)
        return f"{number}.{counter}" if number > 1 else str(counter)

    def see(self, message: GlobalTracks) -> None:
        """Note the generations of a picture, in the order in which its tracks are drawn."""
        for track, _, heir in message.ended:
            self(track)
            if heir is not None:
                self(heir)
        for pair in message.split_from:
            self(pair[0])
            self(pair[1])
        generations = message.ids // COUNTERS
        if not {int(one) for one in set(generations.tolist())} <= set(self._generations):
            for track in message.ids.tolist():
                self(track)

    def find(self, text: str) -> int | None:
        """The id that `text` names: a label, or the whole id; None for a label of a generation that was not seen yet.
        ValueError for another text."""
        match = re.fullmatch(r"(?:(\d{1,9})\.)?(\d{1,20})", text.strip())
        if match is None or int(match[2]) >= 2**64:
            raise ValueError(text)
        number, counter = int(match[1] or 1), int(match[2])
        if counter >= COUNTERS:
            return counter
        known = {order: generation for generation, order in self._generations.items()}
        return known[number] * COUNTERS + counter if number in known else None
