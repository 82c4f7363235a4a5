"""What is done when more comes than can be worked off: the newest complete scan of a source is enough of it.

Only while the service is behind, and only of what waits for it at that moment: a scan goes that a newer complete one of
the same run makes needless. Partial scans say nothing of each other's tracks and all stay.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import msgpack

from schemas import MAX_BYTES

__all__ = ["HOLD", "Overload", "overtaken"]

HOLD = 1.0
"""Seconds without a sign of it after which an overload is over."""
LEAST = 0.25
"""Seconds for which what came may wait at any period."""
SCANS = ("local_tracks", "local_intensity", "global_tracks")
WANTED = ("type", "epoch", "seq", "time", "complete", "delta")
MOST_KEYS = 64

Item = TypeVar("Item")


class Overload:
    """Whether the service is behind. patience: seconds that what came may wait for its turn; infinite: only steps that
    were skipped tell. One that was is a hiccup; skipping again within `HOLD` is not."""

    def __init__(self, patience: float) -> None:
        self._patience = max(patience, LEAST)
        self._until = float("-inf")
        self._skipped = 0
        self._skipped_at = float("-inf")
        self.since: float | None = None
        """When it began, s; None while there is none."""

    def look(self, now: float, waited: float, skipped: int) -> bool:
        """Whether it is behind at `now`, s: what waits has waited for `waited` s, `skipped` steps were skipped since
        the start."""
        again = skipped > self._skipped and now - self._skipped_at < HOLD
        if skipped > self._skipped:
            self._skipped, self._skipped_at = skipped, now
        if waited > self._patience or again:
            self._until = now + HOLD
            self.since = now if self.since is None else self.since
        if now >= self._until:
            self.since = None
        return self.since is not None


def overtaken(
    items: Sequence[tuple[str, Item]], payload: Callable[[Item], bytes | None]
) -> tuple[list[tuple[str, Item]], Counter[str]]:
    """What is left of `items`, (source, item) in the order of arrival, and how many complete scans of each source went
    because a newer complete one of it is there. payload: the bytes of an item, None for one that is no message."""
    of: dict[str, list[int]] = {}
    for index, (source, item) in enumerate(items):
        if payload(item) is not None:
            of.setdefault(source, []).append(index)
    gone: Counter[str] = Counter()
    left = [True] * len(items)
    for source, places in of.items():
        if len(places) < 2:
            continue
        ages = {index: age for index in places if (age := _age(payload(items[index][1]) or b"")) is not None}
        newest = max(ages.values(), default=None)
        for index, age in ages.items():
            if newest is not None and age[0] == newest[0] and age[1:] < newest[1:]:
                left[index] = False
                gone[source] += 1
    return [item for item, stays in zip(items, left, strict=True) if stays], gone


def _age(data: bytes) -> tuple[int, int, int] | None:
    """(epoch, time, seq) of a complete scan; None for anything else."""
    head = _head(data)
    if head.get("type") not in SCANS:
        return None
    whole = head["type"] == "local_intensity" or (
        not head.get("delta") if head["type"] == "global_tracks" else head.get("complete") is True
    )
    age = head.get("epoch"), head.get("time"), head.get("seq")
    return age if whole and all(type(one) is int for one in age) else None  # type: ignore[return-value]


def _head(data: bytes) -> dict[str, Any]:
    """The fields of a message that tell what it is; empty where it cannot be read. The columns are passed over."""
    if len(data) > MAX_BYTES:
        return {}
    unpacker = msgpack.Unpacker(max_buffer_size=MAX_BYTES)
    found: dict[str, Any] = {}
    try:
        unpacker.feed(data)
        for _ in range(min(unpacker.read_map_header(), MOST_KEYS)):
            key = unpacker.unpack()
            if key in WANTED:
                found[key] = unpacker.unpack()
            else:
                unpacker.skip()
    except (ValueError, TypeError, msgpack.exceptions.UnpackException, RecursionError):
        return {}
    return found
