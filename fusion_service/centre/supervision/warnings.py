"""`Warnings`: alarms about sources that stand, told when they begin and when they are over.

An alarm begins when it is raised, stands as long as it is raised again within `HOLD` seconds, and is then over; while
it stands it is told no more. Their number is bounded.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

from fusion_service.centre.journal import Journal

__all__ = ["HOLD", "MOST", "Key", "Warnings"]

HOLD = 10.0
"""Seconds for which what raised an alarm must be gone."""
MOST = 500
"""Alarms that stand at a time, ..."""
MOST_OF_ONE = 20
"""... of one source, ..."""
SHOWN = 5
"""... and of one source in the status."""

Key: TypeAlias = tuple[str, str, str]
"""The source, what it is, and of what: "" for the source as a whole."""


class _Standing(NamedTuple):
    """Since when, when it was last seen so, ns, and the sentence."""

    since: int
    last: int
    sentence: str


class Warnings:
    """The alarms that stand."""

    def __init__(self) -> None:
        self._standing: dict[Key, _Standing] = {}

    def raised(self, key: Key, time: int, numbers: Mapping[str, Any], sentence: str, journal: Journal) -> None:
        """It is so in the step at `time`, ns; numbers: the evidence."""
        old = self._standing.get(key)
        if old is None:
            if len(self._standing) >= MOST or sum(other[0] == key[0] for other in self._standing) >= MOST_OF_ONE:
                return
            event = {"kind": "alarm", "what": key[1], "source": key[0]} | ({"of": key[2]} if key[2] else {})
            journal.event(event | dict(numbers) | {"why": sentence})
        self._standing[key] = _Standing(time if old is None else old.since, time, sentence)

    def settle(self, time: int, journal: Journal) -> None:
        """End those that were not seen for long."""
        for key, one in sorted(self._standing.items()):
            if time - one.last > HOLD * 1e9:
                del self._standing[key]
                over = {"kind": "alarm_over", "what": key[1], "source": key[0]} | ({"of": key[2]} if key[2] else {})
                journal.event(over | {"seconds": (one.last - one.since) / 1e9})

    def of(self, source: str) -> list[str]:
        """The sentences of a source, the longest standing first."""
        mine = [(one.since, key, one.sentence) for key, one in self._standing.items() if key[0] == source]
        return [sentence for _, _, sentence in sorted(mine)[:SHOWN]]

    def begun(self, key: Key) -> int:
        """Since when one of them stands, ns; -1 where it does not."""
        one = self._standing.get(key)
        return -1 if one is None else one.since

    def sentence(self, key: Key) -> str:
        """What one of them says; "" where it does not stand."""
        one = self._standing.get(key)
        return "" if one is None else one.sentence

    def rebase(self, time: int) -> None:
        """A new era begins at `time`, ns: nothing was seen later."""
        self._standing = {
            key: _Standing(min(one.since, time), min(one.last, time), one.sentence)
            for key, one in self._standing.items()
        }

    def packed(self) -> list[list[Any]]:
        """As plain values."""
        return [[*key, *one] for key, one in sorted(self._standing.items())]

    def restore(self, packed: list[list[Any]]) -> None:
        """From what `packed` gave."""
        self._standing = {(str(a), str(b), str(c)): _Standing(*rest) for a, b, c, *rest in packed}
