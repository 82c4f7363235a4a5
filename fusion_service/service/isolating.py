"""Which of the messages of a step make it fail, found by trying: first the sources, then the messages of one.

A step should fail for no message. Should one do so by a fault of ours, what came in with it is not lost: halves are
tried until one message is left, the sources by name, the messages in the order in which they came, so that the same
messages lead to the same culprit. Where halves fail only together, both are at fault.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

__all__ = ["MOST_TRIES", "TooManyTries", "culprits"]

MOST_TRIES = 64
MOST_CULPRITS = 8
"""Messages, or groups of them, that are found one after the other."""

Item = TypeVar("Item")


class TooManyTries(Exception):
    """It is not found within `MOST_TRIES`."""


def culprits(items: Sequence[tuple[str, Item]], fails: Callable[[list[Item]], bool]) -> list[int]:
    """The places of those of `items`, (source, message) in the order in which they came, without which a step does not
    fail: fails: whether it does with some of them. Empty where it fails with none at all. Raises `TooManyTries`."""
    tries = 0

    def bad(places: Sequence[int]) -> bool:
        nonlocal tries
        tries += 1
        if tries > MOST_TRIES:
            raise TooManyTries
        return fails([items[place][1] for place in sorted(places)])

    left = list(range(len(items)))
    found: list[int] = []
    if bad([]):
        return []
    for _ in range(MOST_CULPRITS):
        if not bad(left):
            return sorted(found)
        names = sorted({items[place][0] for place in left})
        groups = [[place for place in left if items[place][0] == name] for name in names]
        guilty = _narrowed(groups, bad)
        if len(guilty) == 1:
            guilty = _narrowed([[place] for place in guilty[0]], bad)
        gone = {place for group in guilty for place in group}
        found += gone
        left = [place for place in left if place not in gone]
    if bad(left):
        raise TooManyTries
    return sorted(found)


def _narrowed(groups: list[list[int]], bad: Callable[[Sequence[int]], bool]) -> list[list[int]]:
    """As few of the groups, which fail together, as halving leaves."""
    while len(groups) > 1:
        half = len(groups) // 2
        for part in (groups[:half], groups[half:]):
            if bad([place for group in part for place in group]):
                groups = part
                break
        else:
            return groups
    return groups
